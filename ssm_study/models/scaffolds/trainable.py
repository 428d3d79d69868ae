"""Interface of static maps that are trained: free parameters, explicit parameters, the map."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds.scaffold import Free, Pieces, Scaffold


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Data that a model gives its static maps: width, sector, and samples of the signal that each
    will receive, `(N, m)`."""

    width: int
    slopes: tuple[float, float]
    samples: Float[np.ndarray, "N m"]


class Trainable(ABC):
    """Base class of static maps that are trained. Free parameters -> explicit parameters -> `S(v)`:
    the constraint lives in the first map, and only there.

    A choice of scaffolding: `build` returns a `TorchScaffold` with all slopes in the frame's
    sector. The paper's perceptron with free weights is the exception, and says so.
    """

    fixed: ClassVar[
        tuple[str, ...]
    ] = ()  # Names, or beginnings of names, of parameters that are not trained

    @abstractmethod
    def start(self, frame: Frame, rng: np.random.Generator) -> dict[str, Float[np.ndarray, "..."]]:
        """Initial values of the free parameters."""

    @abstractmethod
    def explicit(self, free: Free, slopes: tuple[float, float]) -> Any:
        """Explicit parameters for any values of the free ones, with slopes in the sector."""

    @abstractmethod
    def evaluate(self, explicit: Any, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]:
        """Evaluate the map, `S(v)`."""

    @abstractmethod
    def frozen(self, explicit: Any, slopes: tuple[float, float]) -> Scaffold:
        """Trained static map as explicit numbers in float64."""

    def pieces(self, explicit: Any) -> Pieces | None:  # noqa: ARG002
        """Pieces of a one-channel piecewise-linear map. None for others."""
        return None

    def roughness(self, explicit: Any) -> Float[Tensor, ""]:  # noqa: ARG002
        """Total variation of the slopes (`roughness` below). Zero where slopes are not explicit."""
        return torch.zeros((), dtype=torch.float64)

    def build(self, frame: Frame, rng: np.random.Generator) -> Any:
        """Torch module of the map with its initial values."""
        from ssm_study.models.torch_scaffold import TorchScaffold

        return TorchScaffold(self, self.start(frame, rng), frame.slopes)
