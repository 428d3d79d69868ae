"""Minimum-energy gain, a certified controller for every rate below the exact limit, computed
without iteration.

Problem. As in `state_feedback` (and, transposed, `observer`): a gain at the asked rate, with the
least effort.

Hypotheses. Those of `state_feedback`; the modes of A with `|lambda| > r` are in the input's reach,
and none lies on the circle of radius r. With `Ah = A/r`, `Bh = B/r` and `S = Ah^T (S^{-1} + Bh
Bh^T)^{-1} Ah`, the ball is inside the frontier: `delta = beta/alpha < 1 / sqrt(1 + lambda_max(Bh^T
S Bh))`.

Statement. `K = K0 / ((1 - delta^2) alpha)` with `K0 = -(I + Bh^T S Bh)^{-1} Bh^T S Ah` satisfies

    [ r^2 P - B B^T   (A + alpha B K) P   0           ]
    [ *               P                   beta P K^T  ]  >= 0,        P = (1/delta^2 - 1) S^{-1},
    sigma = 1
    [ *               *                   I           ]

on the modes with `|lambda| > r`, which it mirrors at the circle; the others it leaves. At a
slightly faster rate and a wider ball the inequality is strict at the asked ones, and what room
there is pays for the slow modes.

When not to use it. Where the plant differs from the model: no weight says what matters
(`guaranteed_cost`). Close to the frontier the gain is as large as it has to be.

Reference. [Z26] Theorem 1, eq. (11), solved: docs/theory.md, "The gain in closed form"; for one
input cf. Elia & Mitter 2001, Fu & Xie 2005 (the coarsest quantiser that stabilises).

Example. `x+ = 2 x + S_u(u)`, slopes in [0.8, 1.2]: at r = 1 the mode is mirrored to 1/2, `K0 =
-1.5`.

>>> import numpy as np
>>> from ssm_study.systems import JacobianBall
>>> modes = split_modes(np.array([[2.0]]), np.ones((1, 1)), 1.0)
>>> ball = JacobianBall.from_slopes(0.8, 1.2)
>>> gain = minimum_energy_gain(modes, ball, contraction=1.0, widen=False).k
>>> print(f"{gain[0, 0]:.4f} = -1.5 / (1 - 0.2^2)")
-1.5625 = -1.5 / (1 - 0.2^2)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import ClassVar

import numpy as np
import scipy

from ssm_study.certificates.frontier import (
    Frontier,
    contraction_frontier,
    inverse_time_gramian_root,
)
from ssm_study.certificates.problem import Problem, Solution
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.modes import (
    FastGain,
    Modes,
    full_metric,
    split_modes,
    weighted_block_metric,
)
from ssm_study.systems import JacobianBall

# where no frontier is above r = 0 (no radius, or all modes slow): how much faster to design at most
FASTEST = 0.5
# Of the room (in log r) to the frontier at which the gain is built, in order.
SHARES = (0.5, 0.2, 0.8, 0.05, 0.95)
# The same with the metric of the whole model, where the block-diagonal one needs more digits than
# floats have. The theorem is homogeneous in (P, Y, X, sigma): each scale rounds the same matrices
# to other floats, and where one in five of these is positive definite, the exact verdict picks it.
WHOLE_SHARES = (0.5, 0.8, 0.35, 0.65, 0.9)
SCALES = (1.0, 1.1, 1.25, 1.4, 1.6, 1.8)


def minimum_energy_gain(
    modes: Modes, ball: JacobianBall, contraction: float, widens_ball: bool = True
) -> FastGain:
    """Gain of minimum input energy that moves all modes into the circle whose radius is the
    contraction factor. The gain is zero if there are none.

    `widens_ball` designs for a ball between the asked one and the widest possible at this r.
    """
    m = modes.b_fast.shape[1]
    if modes.fast_mode_count == 0:
        p = np.zeros((0, 0))
        fast_mode_count = len(modes.left)
        return FastGain(k=np.zeros((m, fast_mode_count)), p=p)
    ah = modes.a_fast / contraction
    bh = modes.b_fast / contraction
    root = inverse_time_gramian_root(ah, bh)
    b_balanced = scipy.linalg.solve_triangular(root, bh, lower=True)
    energy = b_balanced.T @ b_balanced
    a_balanced = scipy.linalg.solve_triangular(root, ah, lower=True)
    coupling = b_balanced.T @ a_balanced
    curvature = np.eye(m) + energy
    gain_at_root = np.linalg.solve(curvature, coupling)
    k0_root = -gain_at_root
    delta = ball.relative_radius
    eigenvalues = np.linalg.eigvalsh(energy)
    largest_energy = eigenvalues[-1]
    widest = 1 / np.sqrt(1 + largest_energy)
    if widens_ball:
        delta = max(np.sqrt(delta * widest), widest / 2)
    fast_coordinates = modes.left[: modes.fast_mode_count]
    remaining = 1 - delta**2
    divisor = remaining * ball.alpha
    k = k0_root @ fast_coordinates / divisor
    if not delta > 0:
        metric = root @ root.T
        return FastGain(k=k, p=metric)
    scale = 1 / delta**2 - 1
    scaled_metric = scale * root @ root.T
    return FastGain(k=k, p=scaled_metric)


def minimum_energy_attempts(problem: Problem) -> list[Callable[[], Solution]]:
    """Functions that solve a synthesis problem by minimum-energy gains at several contraction
    rates, in the order to try them."""
    attempts: list[Callable[[], Solution]] = []
    for share in SHARES:
        attempt = partial(minimum_energy_solution, problem, share)
        attempts.append(attempt)
    for scale, share in product(SCALES, WHOLE_SHARES):
        attempt_with_metric = partial(solution_with_full_metric, problem, share, scale)
        attempts.append(attempt_with_metric)
    return attempts


def minimum_energy_solution(problem: Problem, rate_fraction: float = SHARES[0]) -> Solution:
    """Minimum-energy gain and its contraction metric, at a rate between the requested and the
    largest provable one.

    At the faster rate and wider ball the fast part of the inequality is an equality; the room in
    between makes it strict, and pays for the slow modes. Raises `NoSolution` near an eigenvalue
    with `|lambda| = r`, or where floats run out.
    """
    modes, fast, faster = _gain_at_intermediate_rate(problem, rate_fraction)
    p = weighted_block_metric(problem, modes, fast)
    status = f"minimum energy at rate {1 - faster**2:.6g}"
    return Solution(p=p, y=p, k=fast.k, sigma=1.0, status=status)


def solution_with_full_metric(
    problem: Problem, rate_fraction: float, metric_factor: float
) -> Solution:
    """Minimum-energy gain with a multiple of the smallest contraction metric that is computed for
    the fast and slow modes of the model together.

    `rate_fraction` places the rate between the requested and the largest provable one;
    `metric_factor` is the multiple.
    """
    modes, fast, faster = _gain_at_intermediate_rate(problem, rate_fraction)
    smallest_metric = full_metric(problem, modes, fast, faster)
    p = metric_factor * smallest_metric
    status = f"minimum energy at rate {1 - faster**2:.6g}, metric of the whole model"
    return Solution(p=p, y=p, k=fast.k, sigma=metric_factor, status=status)


def _gain_at_intermediate_rate(
    problem: Problem, rate_fraction: float
) -> tuple[Modes, FastGain, float]:
    """Modes, minimum-energy gain and contraction factor at a rate between the requested and the
    largest provable one."""
    ball = problem.ball
    r = problem.contraction_factor
    frontier = contraction_frontier(problem.a, problem.b, ball)
    contraction_limit = frontier.contraction_limit
    limit = max(contraction_limit, FASTEST * r)
    rate_step = (limit / r) ** rate_fraction
    faster = float(r * rate_step)
    modes = split_modes(problem.a, problem.b, faster)
    fast_gain = minimum_energy_gain(modes, ball, faster)
    return modes, fast_gain, faster


@dataclass(frozen=True, kw_only=True)
class ClosedFormSynthesis(Synthesis):
    """Synthesis of minimum-energy gains, which reach a contraction rate with the least effort and
    need no weights."""

    method: ClassVar[str] = "closed_form"

    def solve(self, problem: Problem) -> Solution:
        return minimum_energy_solution(problem)

    def solution_attempts(
        self,
        problem: Problem,
        frontier: Frontier,  # noqa: ARG002
    ) -> list[Callable[[], Solution]]:
        return minimum_energy_attempts(problem)
