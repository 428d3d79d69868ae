"""The least metric of a gain, fast and slow modes together: for requests where a block-diagonal one needs more digits.

Given K, Theorem 1 with `Y = P`, `sigma = 1` is bounded-real for `beta K (zI - Ah_K)^{-1} Bh`; in dual form

    P = Ah_K (P^{-1} - beta^2 K^T K)^{-1} Ah_K^T + Bh Bh^T + E,      Ah_K = Ah + alpha Bh K,

whose slack is `E`. Its least solution couples what the input reaches of both parts; condition numbers fall by several
orders of magnitude against `diag(P_fast, P_slow / w)` when slow modes lie just inside the circle or are hard to reach.
Derivation: docs/theory.md, "The gain in closed form".
"""

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.synthesis.doubling import doubled
from ssm_study.synthesis.modes import Modes, energy_root
from ssm_study.synthesis.problem import NoSolution, Problem
from ssm_study.synthesis.slow_modes import FastGain

# E in coordinates where the reachable metric is about the identity; the slack itself comes from the faster rate.
SLACK = 1e-6
# The inequality is solved this share of the way (in log r) from the gain's rate to the asked one.
BETWEEN = 0.3
# Directions of the slow modes that the input hardly reaches keep this share of the mean.
SLOW_FLOOR = 1e-8


def whole_metric(problem: Problem, modes: Modes, fast: FastGain, faster: float) -> Float[np.ndarray, "n n"]:
    """`P` for the gain built at `r = faster`. Raises `NoSolution` if no fast modes or no solution in floats."""
    if modes.fast == 0:
        raise NoSolution("no fast modes: nothing to couple")
    scale = _scale(problem, modes, faster)
    right, left = modes.right @ scale, np.linalg.solve(scale, modes.left)
    between = float(faster * (problem.contraction / faster) ** BETWEEN)
    b, k = left @ problem.b / between, fast.k @ right
    a_closed = left @ problem.a @ right / between + problem.ball.alpha * b @ k
    noise = b @ b.T + SLACK * np.eye(len(b))
    p = doubled(np.ascontiguousarray(a_closed.T), -(problem.ball.beta**2) * k.T @ k, noise)
    if p is None:
        raise NoSolution("the bounded-real equation has no solution in floats")
    whole = right @ p @ right.T
    return (whole + whole.T) / 2


def _scale(problem: Problem, modes: Modes, faster: float) -> Float[np.ndarray, "n n"]:
    """Roots of what the input reaches: the minimum energy of the fast modes, the Gramian of the slow ones."""
    root = energy_root(modes.a_fast / faster, modes.b_fast / faster)
    slow = len(modes.left) - modes.fast
    if slow == 0:
        return root
    reach = modes.b_slow @ modes.b_slow.T
    reach += SLOW_FLOOR * (np.trace(reach) or 1.0) * np.eye(slow)
    try:
        gramian = scipy.linalg.solve_discrete_lyapunov(modes.a_slow / problem.contraction, reach)
        return scipy.linalg.block_diag(root, np.linalg.cholesky(gramian))
    except np.linalg.LinAlgError as error:
        raise NoSolution("a slow mode lies on the circle |lambda| = r") from error
