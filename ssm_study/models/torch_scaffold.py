"""What every trainable scaffolding answers: forward on tensors, and its explicit numbers."""

from abc import ABC, abstractmethod

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.scaffold import Scaffold
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.models.torch_pieces import Pieces


class TorchScaffold(nn.Module, ABC):
    """Free parameters -> explicit parameters -> `S(v)`; `freeze()` returns the explicit parameters in float64."""

    @abstractmethod
    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]: ...

    @abstractmethod
    def freeze(self) -> Scaffold: ...

    def pieces(self) -> Pieces | None:
        """The pieces of a one-channel piecewise-linear map; None for others."""
        return None

    def roughness(self) -> Float[Tensor, "*models"]:
        """Total variation of the slopes, see `torch_pieces.roughness`; zero where slopes are not explicit."""
        return torch.zeros((), dtype=torch.float64)


class TorchIdentity(TorchScaffold):
    """`S(v) = v`: the linear scaffolding; its gain would only repeat what B or C already hold."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        return v

    def freeze(self) -> LinearScaffold:
        return LinearScaffold.identity(self.channels)


class Sector(nn.Module):
    """Slopes of leaky ReLUs held in `[lower, upper]`: fixed at the two ends, or trained inside by a logistic map."""

    def __init__(self, shape: tuple[int, ...], lower: float, upper: float, trained: bool, ends: bool = True) -> None:
        super().__init__()
        self.lower, self.upper, self.trained = lower, upper, trained
        start = torch.full(shape, 2.0, dtype=torch.float64)
        self.free_negative = nn.Parameter(-start if ends else torch.zeros_like(start), requires_grad=trained)
        self.free_positive = nn.Parameter(start if ends else torch.zeros_like(start), requires_grad=trained)

    def forward(self) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
        """Negative and positive slopes."""
        if not self.trained:
            ones = torch.ones_like(self.free_negative)
            return self.lower * ones, self.upper * ones
        return self._inside(self.free_negative), self._inside(self.free_positive)

    def _inside(self, free: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return self.lower + (self.upper - self.lower) * torch.sigmoid(free)


def leaky(
    z: Float[Tensor, "*batch h"], negative: Float[Tensor, "h"], positive: Float[Tensor, "h"]
) -> Float[Tensor, "*batch h"]:
    """`phi(z) = positive z` for `z >= 0`, `negative z` below."""
    return torch.where(z >= 0, positive, negative) * z


def numbers(values: Float[Tensor, "..."]) -> Float[np.ndarray, "..."]:
    """A tensor's explicit numbers in float64."""
    return values.detach().cpu().to(torch.float64).numpy().copy()
