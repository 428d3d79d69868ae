"""Interface of static maps that are trained."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds.scaffold import Free, Pieces, Scaffold


@dataclass(frozen=True, kw_only=True)
class MapContext:
    """Data that a model passes to its trainable static maps: hidden-layer width, slope bounds and
    input samples."""

    width: int
    slopes: tuple[float, float]
    samples: Float[np.ndarray, "N m"]


class Trainable(ABC):
    """Base class of static maps whose parameters are trained. Free parameters give explicit
    parameters, which give `S(v)`; the constraint is in the first step only.

    A choice of scaffolding: `build` returns a `TorchScaffold` with all slopes in the frame's
    sector. The paper's perceptron with free weights is the exception, and says so.
    """

    fixed: ClassVar[
        tuple[str, ...]
    ] = ()  # Names, or beginnings of names, of parameters that are not trained

    @abstractmethod
    def initial_values(
        self, frame: MapContext, rng: np.random.Generator
    ) -> dict[str, Float[np.ndarray, "..."]]:
        """Initial values of a static map's unconstrained parameters."""

    @abstractmethod
    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> Any:
        """Parameters of a static map that respect its slope bounds, computed from unconstrained
        parameters."""

    @abstractmethod
    def evaluate(self, explicit: Any, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]:
        """Evaluate a trainable static map at every vector of a batch."""

    @abstractmethod
    def to_numpy(self, explicit: Any, slopes: tuple[float, float]) -> Scaffold:
        """Copy of a trained static map with NumPy float64 arrays as parameters, independent of
        torch."""

    def affine_pieces(self, explicit: Any) -> Pieces | None:  # noqa: ARG002
        """Affine pieces of a piecewise-linear static map with one channel; None for any other
        map."""
        return None

    def roughness(self, explicit: Any) -> Float[Tensor, ""]:  # noqa: ARG002
        """Total variation of a static map's slope, used in a training penalty; zero for a map
        without slope parameters."""
        return torch.zeros((), dtype=torch.float64)

    def build(self, frame: MapContext, rng: np.random.Generator) -> Any:
        """Build the torch module of a trainable static map."""
        from ssm_study.models.torch_scaffold import TorchScaffold

        initial_values = self.initial_values(frame, rng)
        return TorchScaffold(self, initial_values, frame.slopes)
