"""Contraction metrics (matrices P) of a minimum-energy gain: for the fast modes, the slow modes and
all modes together.

Only the modes with `|lambda| > r` need the input; the slow ones, which contract already, join
through a Lyapunov equation. Derivation: docs/theory.md, "The gain in closed form".
"""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.frontier import inverse_time_gramian_root
from ssm_study.certificates.problem import NoSolution, Problem, symmetric_part
from ssm_study.certificates.riccati import least_metric
from ssm_study.certificates.theorem import smallest_eigenvalue
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall

# Of the slow modes' metric: from dominating to negligible beside the fast.
Square = Float[np.ndarray, "n n"]

SLOW_WEIGHTS = np.geomspace(1e4, 1e-14, 19)
GOOD_SHARE = 0.3
# the inequality is solved this share of the way (in log r) from the gain's rate to the asked one
BETWEEN = 0.3
# Directions of the slow modes that the input hardly reaches keep this share of the mean.
SLOW_FLOOR = 1e-8
ON_CIRCLE = "a slow mode lies on the circle |lambda| = r"


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Fast and slow modes of a linear system in decoupled coordinates."""

    right: Square
    left: Square
    a_fast: Float[np.ndarray, "k k"]
    b_fast: Float[np.ndarray, "k m"]
    a_slow: Float[np.ndarray, "s s"]
    b_slow: Float[np.ndarray, "s m"]

    @property
    def fast_mode_count(self) -> int:
        """Number of fast modes of a system, the modes outside a circle of given radius."""
        return len(self.a_fast)


@dataclass(frozen=True, kw_only=True)
class FastGain:
    """Minimum-energy gain of the fast modes of a system, with its contraction metric."""

    k: Float[np.ndarray, "m n"]
    p: Float[np.ndarray, "k k"]


def split_modes(a: Square, b: Float[np.ndarray, "n m"], contraction: float) -> Modes:
    """Separate the modes of a linear system outside a circle (fast) from those inside it (slow), in
    decoupled coordinates.

    Raises `NoSolution` where an eigenvalue is so close to the circle of radius r that the parts
    cannot be told apart.
    """
    # LAPACK asks a lambda for its two arguments; of a wrapped function it knows none.
    is_fast = lambda real, imaginary: np.hypot(real, imaginary) > contraction  # noqa: E731
    try:
        t, z, k = scipy.linalg.schur(a.T, output="real", sort=is_fast)
    except np.linalg.LinAlgError as error:
        raise NoSolution("fast and slow modes cannot be separated") from error
    lower = t.T  # z^T A z, block lower triangular
    a_fast = lower[:k, :k]
    a_slow = lower[k:, k:]
    coupling = lower[k:, :k]
    left = z.T.copy()
    right = z.copy()  # orthogonal so far; the Sylvester solution shears them
    if 0 < k < len(a):
        x = scipy.linalg.solve_sylvester(a_slow, -a_fast, -coupling)
        fast_rows = left[:k]
        left[k:] -= x @ fast_rows
        slow_columns = right[:, k:]
        right[:, :k] += slow_columns @ x
    b_z = left @ b
    b_fast = b_z[:k]
    b_slow = b_z[k:]
    return Modes(right=right, left=left, a_fast=a_fast, b_fast=b_fast, a_slow=a_slow, b_slow=b_slow)


def weighted_block_metric(problem: Problem, modes: Modes, fast_gain: FastGain) -> Square:
    """Contraction metric of a whole system, as a weighted block diagonal of the metrics of fast and
    slow modes.

    `P_slow` is the inverse of the Lyapunov metric of the slow modes, `S = Ah^T S Ah + I`.
    """
    if modes.fast_mode_count == len(modes.left):
        fast_columns = modes.right @ fast_gain.p
        matrix = fast_columns @ modes.right.T
        return symmetric_part(matrix)
    ah = modes.a_slow / problem.contraction_factor
    eigenvalues = np.linalg.eigvals(ah)
    spectral_radius = np.abs(eigenvalues).max()
    if not spectral_radius < 1:
        raise NoSolution(ON_CIRCLE)
    slow_count = len(ah)
    lyapunov_metric = scipy.linalg.solve_discrete_lyapunov(ah.T, np.eye(slow_count))
    inverse_metric = np.linalg.inv(lyapunov_metric)
    slow = symmetric_part(inverse_metric)
    k = fast_gain.k @ modes.right
    decoupled = modes.left @ problem.a
    a = decoupled @ modes.right
    b = modes.left @ problem.b
    candidates = [scipy.linalg.block_diag(fast_gain.p, slow / weight) for weight in SLOW_WEIGHTS]
    ball = problem.ball
    numbers = {"alpha": ball.alpha, "beta": ball.beta, "rate": problem.rate, "sigma": 1.0}
    margins = []
    for p in candidates:
        conditions = StateFeedbackOfBall.float_conditions(a=a, b=b, k=k, p=p, y=p, **numbers)
        margins.append(smallest_eigenvalue(conditions["inequality"]))
    best = max(margins)
    if not best > 0:
        raise NoSolution("no metric of this form holds in floats")
    metrics_and_margins = zip(candidates, margins, strict=True)
    good = [p for p, reached in metrics_and_margins if reached >= best * GOOD_SHARE]
    metric = modes.right @ good[0] @ modes.right.T
    return symmetric_part(metric)


def full_metric(
    problem: Problem, modes: Modes, fast_gain: FastGain, faster_contraction: float
) -> Square:
    """Smallest contraction metric P of a minimum-energy gain, for fast and slow modes in one
    matrix.

    The equation is that of `least_metric`; docs/theory.md, "When digits run out", says why. Raises
    `NoSolution` without fast modes, or without a solution in floats.
    """
    if modes.fast_mode_count == 0:
        raise NoSolution("no fast modes: nothing to couple")
    scale = _state_scales(problem, modes, faster_contraction)
    ratio_step = (problem.contraction_factor / faster_contraction) ** BETWEEN
    between = float(faster_contraction * ratio_step)
    right = modes.right @ scale
    left = np.linalg.solve(scale, modes.left)
    return least_metric(problem, fast_gain.k, between, right, left)


def _state_scales(problem: Problem, modes: Modes, faster_contraction: float) -> Square:
    """Matrix that scales the fast and slow modes of a system by their control energies."""
    a = modes.a_fast / faster_contraction
    root = inverse_time_gramian_root(a, modes.b_fast / faster_contraction)
    slow = len(modes.left) - modes.fast_mode_count
    if slow == 0:
        return root
    reach = modes.b_slow @ modes.b_slow.T
    size_of_reach = np.trace(reach) or 1.0
    identity = np.eye(slow)
    reach += SLOW_FLOOR * size_of_reach * identity
    try:
        scaled_slow = modes.a_slow / problem.contraction_factor
        gramian = scipy.linalg.solve_discrete_lyapunov(scaled_slow, reach)
        slow_root = np.linalg.cholesky(gramian)
        return scipy.linalg.block_diag(root, slow_root)
    except np.linalg.LinAlgError as error:
        raise NoSolution(ON_CIRCLE) from error
