"""Guaranteed-cost gains from Riccati equations: O(n^3), and the weights choose a good one among the certified.

For `tau > 0`, `Rt = R + tau beta^2`, `kappa = alpha^2/Rt - 1/tau > 0`, the stabilising solution of
`S = Ah^T (S^{-1} + kappa Bh Bh^T)^{-1} Ah + Q_x` with `Bh^T S Bh < tau I` gives, with
`K = -(alpha/Rt) Bh^T (I + kappa S Bh Bh^T)^{-1} S Ah`, the matrices `P = Y = S^{-1}`, `sigma = 1/tau` of Theorem 1,
with slack `Q_x + K^T R K`. `x0^T S x0` bounds `sum r^{-2k} (x^T Q_x x + u^T R u)` for every S_u in the ball.
Derivation: docs/theory.md; cf. Petersen & Hollot 1986 (guaranteed cost), THEORY section 4.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ssm_study.synthesis.closed_form import minimum_energy_attempts
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.doubling import solve_riccati
from ssm_study.synthesis.frontier import Frontier
from ssm_study.synthesis.problem import NoSolution, Problem, Solution

# tau = tau_min (1 + s): s from barely admissible to where the state and input weights no longer matter.
TAU_SPAN = (1e-3, 1e9)
COARSE_STEPS = 9
# The cost is flat at its minimum: tau to one percent changes it by far less.
LOG_TAU_TOLERANCE = 0.01
# The weights at the asked rate and two faster ones; a request that needs more room is the closed form's.
WEIGHTED_ATTEMPTS = 3
FAR = 1e300  # the cost of an inadmissible tau: finite, so that the line search can compare


@dataclass(frozen=True, kw_only=True)
class GuaranteedCost:
    """One point of the tau search: the Riccati solution divided by tau, and the gain."""

    s_over_tau: Float[np.ndarray, "n n"]
    k: Float[np.ndarray, "m n"]
    tau: float

    @property
    def cost(self) -> float:
        """`trace(S)`: the guaranteed cost summed over unit initial states."""
        return float(self.tau * np.trace(self.s_over_tau))


def guaranteed_cost(problem: Problem) -> Solution:
    """The certified gain with the least guaranteed cost over tau. Raises `NoSolution` if no tau is admissible."""
    tau_min = _tau_min(problem)
    best = at_tau(problem, tau_min * TAU_SPAN[1]) if problem.ball.beta == 0 else None  # the cost only falls with tau
    best = best or _search(lambda tau: at_tau(problem, tau), tau_min)
    inverse = np.linalg.inv(best.s_over_tau)
    p = (inverse + inverse.T) / 2  # of S/tau: Theorem 1 is homogeneous in (P, Y, X, sigma), so sigma becomes one
    return Solution(p=p, y=p, k=best.k, sigma=1.0, status=f"tau {best.tau:.6g}")


def at_tau(problem: Problem, tau: float) -> GuaranteedCost | None:
    """The Riccati solution at one tau, divided by tau so that large tau is harmless; None if inadmissible."""
    ball, ah, bh = problem.ball, problem.a_hat, problem.b_hat
    rt = problem.input_weight / tau + ball.beta**2
    kappa = ball.alpha**2 / rt - 1
    if not kappa > 0:
        return None
    try:
        s = solve_riccati(ah, bh, problem.state_weight / tau, float(kappa))
    except NoSolution:
        return None
    m, energy = bh.shape[1], bh.T @ s @ bh
    if not np.linalg.eigvalsh(energy)[-1] < 1:
        return None
    k = -(ball.alpha / rt) * np.linalg.solve(np.eye(m) + kappa * energy, bh.T @ s @ ah)
    return GuaranteedCost(s_over_tau=s, k=k, tau=tau)


def _tau_min(problem: Problem) -> float:
    """`kappa > 0` iff `tau > R / (alpha^2 - beta^2)`."""
    return problem.input_weight / (problem.ball.alpha**2 - problem.ball.beta**2)


def _search(solve: Callable[[float], GuaranteedCost | None], tau_min: float) -> GuaranteedCost:
    """Coarse logarithmic grid, then Brent's method between the neighbours of the best point."""
    tried: list[GuaranteedCost | None] = []

    def cost(log_step: float) -> float:
        tried.append(solve(tau_min * (1 + np.exp(log_step))))
        return _cost(tried[-1])

    grid = np.log(np.geomspace(*TAU_SPAN, COARSE_STEPS))
    index = int(np.argmin([cost(step) for step in grid]))
    if tried[index] is None:
        raise NoSolution("no admissible tau")
    span = float(grid[max(index - 1, 0)]), float(grid[min(index + 1, COARSE_STEPS - 1)])
    scipy.optimize.minimize_scalar(cost, bounds=span, method="bounded", options={"xatol": LOG_TAU_TOLERANCE})
    return min((point for point in tried if point is not None), key=_cost)


def _cost(point: GuaranteedCost | None) -> float:
    return FAR if point is None else point.cost


@dataclass(frozen=True, kw_only=True)
class RiccatiSynthesis(Synthesis):
    """The certified gains of least guaranteed cost for the given weights."""

    method: ClassVar[str] = "riccati"

    def solve(self, problem: Problem) -> Solution:
        return guaranteed_cost(problem)

    def attempts(self, problem: Problem, frontier: Frontier) -> list[Callable[[], Solution]]:
        """The weights first; where the frontier leaves them no room, the minimum-energy gain."""
        weighted = super().attempts(problem, frontier)[:WEIGHTED_ATTEMPTS]
        return [*weighted, *minimum_energy_attempts(problem)]
