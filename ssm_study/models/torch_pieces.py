"""Piecewise-linear maps of one channel: sorted kinks, the slope of each piece, and the offset that makes S(0) = 0."""

import torch
from jaxtyping import Float
from torch import Tensor

Pieces = tuple[Float[Tensor, "*models h"], Float[Tensor, "*models h1"], Float[Tensor, "*models h1"]]
"""`(points (h,), slopes (h + 1,), offsets (h + 1,))`: `S(v) = slopes_j v + offsets_j` from point j - 1 to j."""


def home_offsets(points: Float[Tensor, "*c h"], slopes: Float[Tensor, "*c h1"]) -> Float[Tensor, "*c h1"]:
    """Offsets of the pieces, exactly zero for the one that holds v = 0; continuity gives the others one by one."""
    jumps = (slopes[..., :-1] - slopes[..., 1:]) * points
    beyond = torch.where(points > 0, jumps, 0.0).cumsum(-1)
    before = torch.where(points <= 0, jumps, 0.0).flip(-1).cumsum(-1).flip(-1)
    zero = torch.zeros_like(jumps[..., :1])
    return torch.cat([zero, beyond], -1) - torch.cat([before, zero], -1)


def evaluate(pieces: Pieces, v: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`S(v)` for every number of the batch; pieces `(members, h)` go with `v (members, ...)`."""
    points, slopes, offsets = pieces
    flat = v.flatten(points.dim() - 1).contiguous()
    piece = torch.searchsorted(points.detach(), flat.detach(), right=True)
    return (slopes.gather(-1, piece) * flat + offsets.gather(-1, piece)).view(v.shape)


def roughness(slopes: Float[Tensor, "*c h1"]) -> Float[Tensor, "*c"]:
    """Total variation of the slope along v, relative to the largest slope; rounded off at one percent of it.

    A step from flat to steep costs the same however many pieces it takes; spikes between two levels of the data, which
    fit noise and widen the slope interval that a certificate must cover, cost extra.
    """
    relative = slopes / slopes.detach().amax(-1, keepdim=True)
    return (torch.sqrt(relative.diff() ** 2 + ROUNDING**2) - ROUNDING).sum(-1)


ROUNDING = 0.01
