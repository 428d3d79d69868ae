"""From a gain and metric on the fast modes to a metric for the whole model: the slow modes contract by themselves.

Derivation: docs/theory.md, "The gain in closed form".
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.synthesis.modes import Modes
from ssm_study.synthesis.problem import NoSolution, Problem, Solution, margin, theorem_matrix

# The slow modes enter the metric with a weight that is searched: from dominating to negligible beside the fast ones.
SLOW_WEIGHTS = np.geomspace(1e4, 1e-14, 19)
GOOD_SHARE = 0.3


@dataclass(frozen=True, kw_only=True)
class FastGain:
    """The minimum-energy gain and its metric on the fast modes: `k (m, n)` in x, `p (k, k)` on `z_fast`, sigma = 1."""

    k: Float[np.ndarray, "m n"]
    p: Float[np.ndarray, "k k"]


def with_slow_modes(problem: Problem, modes: Modes, fast: FastGain) -> Float[np.ndarray, "n n"]:
    """`P = right diag(P_fast, P_slow / w) right^T`, w the largest weight with `GOOD_SHARE` of the best margin: a
    smaller one would only spread the entries of P over more digits than floats have.

    `P_slow` is the inverse of the Lyapunov metric of the slow modes, `S = Ah^T S Ah + D`, D normalising them.
    """
    if modes.fast == len(modes.left):
        return _symmetric(modes.right @ fast.p @ modes.right.T)
    slow = _slow_metric(modes, problem.contraction)
    k, a, b = fast.k @ modes.right, modes.left @ problem.a @ modes.right, modes.left @ problem.b
    candidates = [scipy.linalg.block_diag(fast.p, slow / weight) for weight in SLOW_WEIGHTS]
    margins = [
        margin(theorem_matrix(a, b, problem.ball, problem.rate, Solution(p=p, y=p, k=k, sigma=1.0, status="")))
        for p in candidates
    ]
    if not max(margins) > 0:
        raise NoSolution("no metric of this form holds in floats")
    chosen = next(p for p, reached in zip(candidates, margins, strict=True) if reached >= max(margins) * GOOD_SHARE)
    return _symmetric(modes.right @ chosen @ modes.right.T)


def _slow_metric(modes: Modes, contraction: float) -> Float[np.ndarray, "s s"]:
    """`P` with `P^{-1} - Ah^T P^{-1} Ah` = I, for the modes the input need not touch."""
    ah = modes.a_slow / contraction
    if not np.abs(np.linalg.eigvals(ah)).max() < 1:
        raise NoSolution("a slow mode lies on the circle |lambda| = r")
    s = scipy.linalg.solve_discrete_lyapunov(ah.T, np.eye(len(ah)))
    return _symmetric(np.linalg.inv(s))


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return (matrix + matrix.T) / 2
