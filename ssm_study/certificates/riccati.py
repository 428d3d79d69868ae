"""Riccati equations solved by doubling, and the smallest contraction metric of a given gain.

Derivation: docs/theory.md, "The gain in closed form".
"""

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.frontier import MOST_STEPS
from ssm_study.certificates.problem import NoSolution, Problem, symmetric_part

# quadratically: after a step that changes H by less than this share the next would change nothing
CONVERGED = 1e-10
RESIDUAL_SHARE = (
    1e-6  # the equation holds to this share of an accepted S; exact arithmetic judges what follows
)
# E in coordinates where the reachable metric is about the identity; the faster rate gives the slack
# itself.
SLACK = 1e-6
Square = Float[np.ndarray, "n n"]


def solve_riccati(a: Square, b: Float[np.ndarray, "n m"], q: Square, input_factor: float) -> Square:
    """Stabilising solution S of the discrete Riccati equation `S = A^T (S^{-1} + kappa B B^T)^{-1}
    A + Q`. The stabilising `S` of `S = A^T (S^{-1} + kappa B B^T)^{-1} A + Q`, by doubling, else by
    SciPy's QZ.

    Raises `NoSolution` when neither gives one.
    """
    s = solve_riccati_by_doubling(a, input_factor * b @ b.T, q)
    if s is not None:
        sb = s @ b
        input_cost = np.eye(b.shape[1]) + input_factor * b.T @ sb
        inner = s - input_factor * sb @ np.linalg.solve(input_cost, sb.T)
        size = max(np.abs(s).max(), np.finfo(float).tiny)
        residual = np.abs(s - a.T @ inner @ a - q)
        if residual.max() / size < RESIDUAL_SHARE:
            return s
    input_weight = np.eye(b.shape[1]) / input_factor
    try:
        s = scipy.linalg.solve_discrete_are(a, b, q, input_weight)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise NoSolution(f"no stabilising Riccati solution: {error}") from error
    return symmetric_part(s)


def solve_riccati_by_doubling(a: Square, g: Square, q: Square) -> Square | None:
    """Stabilising solution of a discrete Riccati equation by structure-preserving doubling; None
    where the iteration does not converge. The stabilising S of `S = A^T (S^{-1} + G)^{-1} A + Q`.

    From `H = Q` each step squares the closed-loop matrix: `A' = A (I + G H)^{-1} A`, `G' = G + A (I
    + G H)^{-1} G A^T`, `H' = H + A^T H (I + G H)^{-1} A`; H converges to S, quadratically. A few
    matrix products a step instead of a QZ decomposition. Source: Chu, Fan, Lin & Wang 2004,
    Algorithm 2.1.
    """
    n = len(a)
    identity = np.eye(n)
    h = q
    for _ in range(MOST_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            right_side = np.hstack([a, g])
            try:
                solved = np.linalg.solve(identity + g @ h, right_side)
            except np.linalg.LinAlgError:
                return None
            solved_a = solved[:, :n]
            solved_g = solved[:, n:]
            step = a.T @ h @ solved_a
            h = h + symmetric_part(step)
            if not np.isfinite(h).all():  # diverged: no stabilising solution in floats
                return None
            if np.abs(step).max() <= CONVERGED * np.abs(h).max():
                return h
            g = g + a @ solved_g @ a.T
            a = a @ solved_a
        g = symmetric_part(g)
    return None


def least_metric(
    problem: Problem,
    k: Float[np.ndarray, "m n"],
    contraction: float,
    right: Square,
    left: Square,
    slack: float = SLACK,
) -> Square:
    """Smallest metric in which a closed loop with a given gain contracts by a given factor. The
    least `P = Ah_K (P^{-1} - beta^2 K^T K)^{-1} Ah_K^T + Bh Bh^T + E` at `r = contraction`.

    Solved for `z`, where `x = right z`, `z = left x`; `Ah_K = Ah + alpha Bh K`, `E = slack I`.
    Raises `NoSolution` if floats find none.
    """
    ball = problem.ball
    b = left @ problem.b / contraction
    k = k @ right
    a = left @ problem.a @ right / contraction
    closed_loop_matrix = a + ball.alpha * b @ k
    noise = b @ b.T + slack * np.eye(len(b))
    slope_term = -(ball.beta**2) * k.T @ k
    dual_matrix = np.ascontiguousarray(closed_loop_matrix.T)
    p = solve_riccati_by_doubling(dual_matrix, slope_term, noise)
    if p is None:
        raise NoSolution("the bounded-real equation has no solution in floats")
    return symmetric_part(right @ p @ right.T)
