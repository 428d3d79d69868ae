"""Levenberg-Marquardt for the simulation error, its Jacobian by forward differentiation."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jvp, vmap

Residual = Callable[[Float[Tensor, "P"]], Float[Tensor, "N"]]

TRIES = 8  # dampings tried before a step counts as failed
GROW, SHRINK = 4.0, 0.3
DAMPING_RANGE = (1e-12, 1e12)
WEAKEST = 1e-6  # relative: curvatures below this are damped as if they had it


class LevenbergMarquardt(torch.optim.Optimizer):
    """`(J^T J + damping diag(J^T J)) step = -J^T r`; the damping falls after a good step and grows after a bad one.

    Parameters that sit in exponentials (`nu`, `theta`) move by at most `longest_step` at once, where the linear model
    holds. `residual(flat parameters)` and `seen(loss)`, told of the loss before each step, are set by the training;
    `step` takes one accepted step, or none.
    Source: Nocedal & Wright (2006), section 10.3; Marquardt (1963) for the scaling.
    """

    def __init__(self, named: list[tuple[str, torch.nn.Parameter]], damping: float, longest_step: float) -> None:
        super().__init__([parameter for _, parameter in named], {"damping": damping})
        self.residual: Residual | None = None
        self.seen: Callable[[float], object] = float
        limits = [
            torch.full((p.numel(),), longest_step if n.endswith(("nu", "theta")) else torch.inf) for n, p in named
        ]
        self.limits = torch.cat(limits).double()

    @torch.no_grad()
    def step(self, closure: Any = None) -> float:  # type: ignore[override]  # noqa: ARG002 - needs residuals, not a loss
        assert self.residual is not None, "the training sets the residual"
        group = self.param_groups[0]
        flat = torch.cat([p.detach().flatten() for p in group["params"]])
        r, j = self.residual(flat), jacobian(self.residual, flat)
        loss, gradient, normal = float(r @ r), j.T @ r, j.T @ j
        self.seen(loss)
        scale = normal.diagonal().clamp(min=WEAKEST * float(normal.diagonal().max()))
        for _ in range(TRIES):
            step = torch.linalg.solve(normal + torch.diag(group["damping"] * scale), -gradient)
            step = torch.maximum(torch.minimum(step, self.limits), -self.limits)
            trial = self.residual(flat + step)
            gained = loss - float(trial @ trial)
            expected = -float(2 * gradient @ step + step @ normal @ step)
            if gained > 0:
                group["damping"] *= SHRINK if gained > 0.75 * expected else 1.0 if gained > 0.25 * expected else 2.0
                group["damping"] = min(max(group["damping"], DAMPING_RANGE[0]), DAMPING_RANGE[1])
                torch.nn.utils.vector_to_parameters(flat + step, group["params"])
                break
            group["damping"] = min(group["damping"] * GROW, DAMPING_RANGE[1])
        return loss


def jacobian(residual: Residual, at: Float[Tensor, "P"]) -> Float[Tensor, "N P"]:
    """All columns at once, one tangent per parameter: P forward passes in one batch."""
    tangents = torch.eye(len(at), dtype=at.dtype, device=at.device)
    return vmap(lambda tangent: jvp(residual, (at,), (tangent,))[1])(tangents).T
