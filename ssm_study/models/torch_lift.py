"""Passing the training input through `S_u` cheaply: it is the same in every step, so its order is prepared once."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ssm_study.models.torch_scaffold import TorchScaffold

FEW_LEVELS = 8  # mean hold from which evaluating once per level beats the sorted evaluation


class Lift(nn.Module):
    """`S_u(u)` for one fixed `u (e, T, m)`, by the cheapest of three exact ways; all may have a leading axis of models.

    Held inputs repeat: once per distinct input vector, copied to where it occurs. One channel and a piecewise-linear
    map with h kinks: the sorted samples fall into h + 1 runs, each an affine map, so the cost does not grow with h.
    Else directly. `sorts=False` leaves out the second, which has no forward-mode derivative.
    """

    values: Tensor
    where: Tensor
    order: Tensor
    back: Tensor

    def __init__(self, u: Float[Tensor, "e T m"], sorts: bool = True) -> None:
        super().__init__()
        self.register_buffer("u", u, persistent=False)
        values, where = torch.unique(u.flatten(0, 1), dim=0, return_inverse=True)
        self.levels = FEW_LEVELS * len(values) <= where.numel()
        self.sorts = sorts and not self.levels and u.shape[2] == 1
        if self.levels:
            self.register_buffer("values", values, persistent=False)
            self.register_buffer("where", where.view(u.shape[:2]), persistent=False)
        if self.sorts:
            ranked, order = u.flatten().sort()
            self.register_buffer("values", ranked, persistent=False)
            self.register_buffer("order", order, persistent=False)
            self.register_buffer("back", order.argsort(), persistent=False)

    def forward(self, scaffold: TorchScaffold) -> Float[Tensor, "*models e T k"]:
        if self.levels:
            if self.where.dim() == 2:
                return scaffold(self.values)[self.where]
            first = torch.arange(len(self.where), device=self.where.device) * self.values.shape[1]
            return scaffold(self.values).flatten(0, 1)[self.where + first[:, None, None]]
        pieces = scaffold.pieces() if self.sorts else None
        if pieces is None:
            return scaffold(self.u)
        points, slopes, offsets = pieces
        inner = torch.searchsorted(self.values, points.detach())
        cuts = torch.nn.functional.pad(torch.nn.functional.pad(inner, (1, 0)), (0, 1), value=self.values.shape[-1])
        counts, order, back = cuts.diff().flatten(), self._joined(self.order), self._joined(self.back)
        y = _AffineRuns.apply(slopes.flatten(), offsets.flatten(), counts, self.values.flatten(), order, back)
        return y.view(self.u.shape)

    def _joined(self, positions: Int[Tensor, "*models N"]) -> Int[Tensor, "MN"]:
        """Positions within each model to positions in all of them, one after the other."""
        if positions.dim() == 1:
            return positions
        models, count = positions.shape
        return (positions + torch.arange(models, device=positions.device)[:, None] * count).flatten()


class _AffineRuns(torch.autograd.Function):
    """`y = slope_j u + offset_j` for sorted `u` in run j, put back into the order of time."""

    @staticmethod
    def forward(
        ctx: Any,
        slopes: Float[Tensor, "h1"],
        offsets: Float[Tensor, "h1"],
        counts: Int[Tensor, "h1"],
        ranked: Float[Tensor, "N"],
        order: Int[Tensor, "N"],
        back: Int[Tensor, "N"],
    ) -> Float[Tensor, "N"]:
        ctx.save_for_backward(counts, ranked, order)
        slope = torch.repeat_interleave(slopes, counts, output_size=len(ranked))
        offset = torch.repeat_interleave(offsets, counts, output_size=len(ranked))
        return torch.addcmul(offset, slope, ranked).index_select(0, back)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        counts, ranked, order = ctx.saved_tensors
        sorted_upstream = upstream[0].index_select(0, order)
        slopes = torch.segment_reduce(sorted_upstream * ranked, "sum", lengths=counts, initial=0.0)
        offsets = torch.segment_reduce(sorted_upstream, "sum", lengths=counts, initial=0.0)
        return slopes, offsets, None, None, None, None
