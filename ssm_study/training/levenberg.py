"""Levenberg-Marquardt method for least-squares problems, also as a torch optimiser.

    (J'J + R + damping diag(J'J + R)) step = -(J'r + R theta),    R the weights of a quadratic
    penalty, if any

Source: Nocedal & Wright (2006), section 10.3; Marquardt (1963) for the scaling.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd

Residual = Callable[[Float[Tensor, "P"]], Float[Tensor, "N"]]
# Below the first a step is Gauss-Newton's up to rounding; above the second it is shorter than
# rounding.
DAMPING_RANGE = (1e-12, 1e12)


class DampingRule(NamedTuple):
    """Settings of the damping in the Levenberg-Marquardt method for least-squares problems. `tries`
    dampings before a step counts as failed, each `grow` times the last; curvatures below `weakest`,
    relative to the largest, are damped as if they had it."""

    tries: int
    grow: float
    weakest: float


FORWARD = DampingRule(tries=8, grow=4.0, weakest=1e-6)
WRITTEN_OUT = DampingRule(tries=10, grow=3.0, weakest=1e-8)


def levenberg_marquardt_step(
    rule: DampingRule, loss: float, gradient: Any, normal: Any, damping: float,
    solve_damped: Callable[[float], Any], loss_at: Callable[[Any], float],
) -> tuple[Any, float, float]:  # fmt: skip
    """Take one accepted step of the Levenberg-Marquardt method for least-squares problems. Returns
    the first step that gains (None if all fail), the loss there, and the damping of the next step.

    The damping falls after a step that gains what the quadratic model expects, and grows after
    others. `solve_damped` gives the step of a damping, or None; arrays are NumPy's or torch's.
    """
    for _ in range(rule.tries):
        step = solve_damped(damping)
        value = np.inf if step is None else loss_at(step)
        gained = loss - value  # not above zero where the trial is not finite
        if gained > 0:
            # What the quadratic model promises.
            model_change = 2 * gradient @ step + step @ normal @ step
            expected = -float(model_change)
            damping *= damping_update_factor(gained, expected)
            least, most = DAMPING_RANGE
            limited_damping = max(damping, least)
            return step, value, min(limited_damping, most)
        larger_damping = damping * rule.grow
        damping = min(larger_damping, DAMPING_RANGE[1])
    return None, loss, damping


def damping_update_factor(actual_decrease: float, expected_decrease: float) -> float:
    """Factor that updates the Levenberg-Marquardt damping after a step, from the actual and the
    expected decrease of the loss."""
    if actual_decrease > 0.75 * expected_decrease:
        return 0.3
    return 1.0 if actual_decrease > 0.25 * expected_decrease else 2.0


class LevenbergMarquardt(torch.optim.Optimizer):
    """Levenberg-Marquardt method for least-squares problems as a torch optimiser. `step` takes one
    accepted step, or none; there is no penalty.

    Parameters that sit in exponentials (`nu`, `theta`) move by at most `longest_step` at once,
    where the linear model holds. `residual` takes all parameters in a row.
    """

    def __init__(
        self,
        named: list[tuple[str, torch.nn.Parameter]],
        residual: Residual,
        damping: float,
        longest_step: float,
    ) -> None:
        parameters = [parameter for _, parameter in named]
        defaults = {"damping": damping}
        super().__init__(parameters, defaults)
        self.residual = residual
        most = {
            name: longest_step if name.endswith(("nu", "theta")) else torch.inf for name, _ in named
        }
        limits = [torch.full_like(p.detach(), most[name]).flatten() for name, p in named]
        self.limits = torch.cat(limits)

    @torch.no_grad()
    def step(self, closure: Any = None) -> float:  # type: ignore[override]  # noqa: ARG002 - needs residuals, not a loss
        """Take one Levenberg-Marquardt step."""
        residual = self.residual
        group = self.param_groups[0]
        flat_parts = [p.detach().flatten() for p in group["params"]]
        flat = torch.cat(flat_parts)
        r = residual(flat)
        j = jacfwd(residual)(flat)  # P + 1 forward passes, those of the Jacobian in one batch
        loss = float(r @ r)
        gradient = j.T @ r
        normal = j.T @ j
        diagonal = normal.diagonal()
        largest = normal.diagonal().max()
        weakest = FORWARD.weakest * float(largest)
        scale = diagonal.clamp(min=weakest)

        def solve_damped(damping: float) -> Tensor:
            """Solve the damped normal equations for a step of limited length."""
            damping_matrix = torch.diag(damping * scale)
            step = torch.linalg.solve(normal + damping_matrix, -gradient)
            below = torch.minimum(step, self.limits)
            lowest = -self.limits
            return torch.maximum(below, lowest)

        def loss_at(step: Tensor) -> float:
            """Training loss after a given step from the current parameters."""
            trial = residual(flat + step)
            return float(trial @ trial)

        step, _, group["damping"] = levenberg_marquardt_step(
            FORWARD, loss, gradient, normal, group["damping"], solve_damped, loss_at
        )
        if step is not None:
            torch.nn.utils.vector_to_parameters(flat + step, group["params"])
        return loss
