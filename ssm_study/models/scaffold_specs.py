"""What a yaml of the group `scaffold` says, and how it becomes a trainable scaffolding."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.torch_mlp import TorchFreeMlp, TorchMlp
from ssm_study.models.torch_monotone import TorchMonotone
from ssm_study.models.torch_residual import TorchResidual
from ssm_study.models.torch_scaffold import TorchIdentity, TorchScaffold
from ssm_study.models.torch_scalar_mlp import TorchScalarMlp
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What the model gives its scaffoldings: width, sector, and samples of the signal each will see `(N, m)`."""

    width: int
    slopes: tuple[float, float]
    samples: Float[np.ndarray, "N m"]


class ScaffoldSpec(ABC):
    """A choice of scaffolding; `build` returns it with all slopes in the frame's sector, unless it says otherwise."""

    @abstractmethod
    def build(self, frame: Frame, rng: np.random.Generator) -> TorchScaffold: ...


@dataclass(frozen=True, kw_only=True)
class Linear(ScaffoldSpec):
    """`S(v) = v`."""

    def build(self, frame: Frame, rng: np.random.Generator) -> TorchScaffold:  # noqa: ARG002 - nothing to draw
        return TorchIdentity(frame.samples.shape[1])


@dataclass(frozen=True, kw_only=True)
class Mlp(ScaffoldSpec):
    """The paper's perceptron: `depth` hidden layers of leaky ReLU, slopes fixed at the sector's ends or trained in it.

    `certified` keeps every Jacobian in the sector by construction; without it the weights are free, as in [Z26], and
    the exact slopes may be negative. One certified channel always has leaky slopes at the ends: there the slopes of the
    whole map are trained, and `train_slopes` makes no difference.
    """

    depth: int
    train_slopes: bool
    certified: bool

    def __post_init__(self) -> None:
        require(self.depth >= 1, "scaffold.depth", self.depth, "a perceptron has a hidden layer", "use 1 (the paper's)")

    def build(self, frame: Frame, rng: np.random.Generator) -> TorchScaffold:
        if self.certified and frame.samples.shape[1] == 1:
            return TorchScalarMlp(frame.samples, frame.width, self.depth, frame.slopes)
        kind = TorchMlp if self.certified else TorchFreeMlp
        return kind(frame.samples, frame.width, self.depth, frame.slopes, self.train_slopes, rng)


@dataclass(frozen=True, kw_only=True)
class Monotone(ScaffoldSpec):
    """Piecewise linear per channel with `hidden_width` break points; its parameters are the slopes themselves."""

    def build(self, frame: Frame, rng: np.random.Generator) -> TorchScaffold:  # noqa: ARG002 - nothing to draw
        return TorchMonotone(frame.samples, frame.width, frame.slopes)


@dataclass(frozen=True, kw_only=True)
class Residual(ScaffoldSpec):
    """`alpha v + beta (G(v) - G(0))`, G 1-Lipschitz with `depth` sandwich layers: couples the channels."""

    depth: int

    def __post_init__(self) -> None:
        require(self.depth >= 1, "scaffold.depth", self.depth, "G has at least one hidden layer", "use 1 or 2")

    def build(self, frame: Frame, rng: np.random.Generator) -> TorchScaffold:
        return TorchResidual(frame.samples, [frame.width] * self.depth, frame.slopes, rng)
