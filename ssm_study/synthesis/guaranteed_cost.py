"""Gains with a guaranteed cost from Riccati equations, in O(n^3). Their weights select a good one
among the certified gains.

Problem. As in `state_feedback` (and, transposed, `observer`): among the certified gains, the one
for which `sum r^{-2k} (x^T Q_x x + u^T R u)` is small whatever S_u does.

Hypotheses. Those of `state_feedback`, `Q_x >= 0`, `R > 0`; for some `tau > 0`, `kappa = alpha^2/Rt
- 1/tau > 0` with
`Rt = R + tau beta^2`, and the stabilising solution of `S = Ah^T (S^{-1} + kappa Bh Bh^T)^{-1} Ah +
Q_x` has
`Bh^T S Bh < tau I`, where `Ah = A/r`, `Bh = B/r`.

Statement. `K = -(alpha/Rt) Bh^T (I + kappa S Bh Bh^T)^{-1} S Ah` satisfies, with `P = S^{-1}` and
`sigma = 1/tau`,

    [ r^2 P - sigma B B^T   (A + alpha B K) P   0           ]
    [ *                     P                   beta P K^T  ]  > 0,
    [ *                     *                   sigma I     ]

and `x0^T S x0` bounds the cost for every S_u in the ball. All is divided by tau, so that large tau
is harmless.

When not to use it. Within a share of a percent of the frontier the weights have no room:
`minimum_energy`.

Reference. [Z26] Theorem 1, eq. (11), solved with a cost: docs/theory.md; cf. Petersen & Hollot
1986.

Example. Without a radius it is the linear-quadratic regulator: `x+ = x + u`, `Q_x = R = 1`, r near
one: golden ratio.

>>> import numpy as np
>>> from ssm_study.systems import JacobianBall
>>> one, ball = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> problem = Problem(a=one, b=one, ball=ball, rate=1e-9, state_weight=one, input_weight=1.0)
>>> found = guaranteed_cost(problem)
>>> print(f"{found.k[0, 0]:.6f}, {(1 - 5**0.5) / 2:.6f}")
-0.618034, -0.618034
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.frontier import Frontier
from ssm_study.certificates.problem import (
    NoSolution,
    Problem,
    Solution,
    linear_algebra_failures_as_no_solution,
    symmetric_part,
)
from ssm_study.certificates.riccati import solve_riccati
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.minimum_energy import minimum_energy_attempts

# tau = tau_min (1 + s): s from barely admissible to where the state and input weights no longer
# matter.
TAU_SPAN = (1e-3, 1e9)
COARSE_STEPS = 9
LOG_TAU_TOLERANCE = (
    0.01  # the cost is flat at its minimum: tau to one percent changes it by far less
)
WEIGHTED_ATTEMPTS = (
    3  # the asked rate and two faster ones; a request that needs more room is the closed form's
)
FAR = 1e300  # the cost of an inadmissible tau: finite, so that the line search can compare


@dataclass(frozen=True, kw_only=True)
class GuaranteedCost:
    """Gain and scaled Riccati solution for one value of the multiplier tau of the Riccati equation.
    The solution is divided by tau."""

    s_over_tau: Float[np.ndarray, "n n"]
    k: Float[np.ndarray, "m n"]
    tau: float

    @property
    def cost(self) -> float:
        """Guaranteed quadratic cost summed over unit initial states, `trace(S)`."""
        trace = np.trace(self.s_over_tau)
        return float(self.tau * trace)


@linear_algebra_failures_as_no_solution()
def guaranteed_cost(problem: Problem) -> Solution:
    """Gain with the smallest guaranteed quadratic cost, minimised over the multiplier tau of the
    Riccati equation. Raises `NoSolution` if no tau is admissible."""
    alpha = problem.ball.alpha
    beta = problem.ball.beta
    if abs(alpha) <= beta:
        raise NoSolution("the slopes include zero, so no input is sure to have an effect")
    slope_margin = alpha**2 - beta**2
    tau_min = problem.input_weight / slope_margin  # kappa > 0 above it
    best = (
        solve_at_tau(problem, tau_min * TAU_SPAN[1]) if beta == 0 else None
    )  # the cost only falls with tau
    best = best or _minimise_over_tau(problem, tau_min)
    # of S/tau: Theorem 1 is homogeneous in (P, Y, X, sigma), so sigma becomes one
    matrix = np.linalg.inv(best.s_over_tau)
    p = symmetric_part(matrix)
    return Solution(p=p, y=p, k=best.k, sigma=1.0, status=f"tau {best.tau:.6g}")


def solve_at_tau(problem: Problem, tau: float) -> GuaranteedCost | None:
    """Riccati solution and gain at one value of the multiplier tau; None if tau is inadmissible."""
    ball = problem.ball
    ah = problem.a_hat
    bh = problem.b_hat
    squared_radius = ball.beta**2
    rt_over_tau = problem.input_weight / tau + squared_radius  # all over tau, see the statement
    kappa_times_tau = ball.alpha**2 / rt_over_tau - 1
    if not kappa_times_tau > 0:
        return None
    try:
        q = problem.state_weight / tau
        kappa_ratio = float(kappa_times_tau)
        s = solve_riccati(ah, bh, q, kappa_ratio)
    except NoSolution:
        return None
    m = bh.shape[1]
    energy = bh.T @ s @ bh
    eigenvalues = np.linalg.eigvalsh(energy)
    if not eigenvalues[-1] < 1:  # Bh^T S Bh < tau I, the hypothesis
        return None
    scaled_slope = ball.alpha / rt_over_tau
    curvature = np.eye(m) + kappa_times_tau * energy
    coupling = bh.T @ s @ ah
    k = -scaled_slope * np.linalg.solve(curvature, coupling)
    return GuaranteedCost(s_over_tau=s, k=k, tau=tau)


def _minimise_over_tau(problem: Problem, tau_min: float) -> GuaranteedCost:
    """Riccati solution and gain with the smallest guaranteed cost over the multiplier tau."""
    tried: list[tuple[float, GuaranteedCost | None]] = []

    def cost_at(log_step: float) -> float:
        """Guaranteed cost as a function of the search variable, the logarithm of `tau / tau_min -
        1`."""
        tau_step = np.exp(log_step)
        tau = tau_min * (1 + tau_step)
        point = solve_at_tau(problem, tau)
        cost = FAR if point is None else point.cost
        tried.append((cost, point))
        return tried[-1][0]

    tau_steps = np.geomspace(*TAU_SPAN, COARSE_STEPS)
    grid = np.log(tau_steps)
    costs = [cost_at(step) for step in grid]
    index = int(np.argmin(costs))
    if tried[index][1] is None:
        raise NoSolution("no admissible tau")
    lower_index = max(index - 1, 0)
    upper_index = min(index + 1, COARSE_STEPS - 1)
    span = float(grid[lower_index]), float(grid[upper_index])
    scipy.optimize.minimize_scalar(
        cost_at, bounds=span, method="bounded", options={"xatol": LOG_TAU_TOLERANCE}
    )
    _, best = min(tried, key=lambda point: point[0])
    if best is None:  # costs beyond floats, which no comparison orders
        raise NoSolution("no admissible tau")
    return best


@dataclass(frozen=True, kw_only=True)
class RiccatiSynthesis(Synthesis):
    """Synthesis of the certified gains with the smallest guaranteed quadratic cost for given
    weights.

    With neurons the search starts from what is `near`: a neighbour's solution for the controller
    (under False) or for the observer (under True).
    """

    near: Mapping[bool, Solution] = field(default_factory=dict, repr=False, compare=False)

    method: ClassVar[str] = "riccati"

    def solve(self, problem: Problem) -> Solution:
        if problem.neurons is None:
            return guaranteed_cost(problem)
        from ssm_study.synthesis.structured_riccati import (
            least_guaranteed_cost,
        )  # compiles: only where there are neurons

        observes = problem.neurons.observes
        near = self.near.get(observes)
        return least_guaranteed_cost(problem, near)

    def solution_attempts(
        self, problem: Problem, frontier: Frontier
    ) -> list[Callable[[], Solution]]:
        """Functions that solve a synthesis problem by the guaranteed-cost gain for the given
        weights and, near the largest rate, by the minimum-energy gain."""
        all_attempts = super().solution_attempts(problem, frontier)
        weighted = all_attempts[:WEIGHTED_ATTEMPTS]
        if problem.neurons is not None:
            from ssm_study.synthesis.structured_lmi import StructuredLmi

            return [
                *weighted,
                lambda: StructuredLmi(problem=problem, objective="largest_margin").solve(
                    problem.rate
                ),
            ]
        return [*weighted, *minimum_energy_attempts(problem)]
