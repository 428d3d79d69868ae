"""A trainable piecewise-linear map whose slopes are its parameters."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.scaffold_monotone import MonotoneScaffold
from ssm_study.models.torch_pieces import Pieces, home_offsets, roughness
from ssm_study.models.torch_rows import apart
from ssm_study.models.torch_scaffold import TorchScaffold, numbers


class TorchMonotone(TorchScaffold):
    """`S_c(v) = int_0^v s_c(t) dt`, slopes `lower + (upper - lower) sigmoid(free)` between sorted break points.

    One such map per channel, so the Jacobian is diagonal and the sector is the ball. The break points move with
    training: when two cross, the piece between them has zero width and the map stays continuous in its parameters.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, inputs: Float[np.ndarray, "N m"], pieces: int, slopes: tuple[float, float]) -> None:
        super().__init__()
        ranks = (np.arange(pieces) + 0.5) / pieces
        self.points = nn.Parameter(torch.from_numpy(np.quantile(inputs, ranks, axis=0).T.copy()))
        self.free = nn.Parameter(torch.zeros(inputs.shape[1], pieces + 1, dtype=torch.float64))
        for name, end in zip(("lower", "upper"), slopes, strict=True):
            self.register_buffer(name, torch.tensor([[end]], dtype=torch.float64), persistent=False)

    def explicit(self) -> tuple[Float[Tensor, "*models m h"], Float[Tensor, "*models m h1"]]:
        """Sorted break points and the slopes between them."""
        return self.points.sort(dim=-1).values, self.lower + (self.upper - self.lower) * torch.sigmoid(apart(self.free))

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        points, slopes = self.explicit()
        offsets = home_offsets(points, slopes)
        flat = v.flatten(points.dim() - 2, -2).mT.contiguous()
        piece = torch.searchsorted(points.detach(), flat, right=True)
        return (slopes.gather(-1, piece) * flat + offsets.gather(-1, piece)).mT.reshape(v.shape)

    def pieces(self) -> Pieces | None:
        points, slopes = self.explicit()
        if points.shape[-2] > 1:
            return None
        return points[..., 0, :], slopes[..., 0, :], home_offsets(points, slopes)[..., 0, :]

    def roughness(self) -> Float[Tensor, "*models"]:
        return roughness(self.explicit()[1]).sum(-1)

    def freeze(self) -> MonotoneScaffold:
        points, slopes = self.explicit()
        return MonotoneScaffold(breakpoints=numbers(points), slopes=numbers(slopes))
