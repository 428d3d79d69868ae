"""The discrete Riccati equation `S = A^T (S^{-1} + G)^{-1} A + Q` by structure-preserving doubling.

Each step squares the closed-loop matrix: `A' = A (I + G H)^{-1} A`, `G' = G + A (I + G H)^{-1} G A^T`,
`H' = H + A^T H (I + G H)^{-1} A`, from `H = Q`; H converges to the stabilising S, quadratically. A few matrix products
a step instead of a QZ decomposition. Source: Chu, Fan, Lin & Wang 2004, Algorithm 2.1.
"""

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.synthesis.problem import NoSolution

MOST_STEPS = 60
# Quadratic convergence: after a step that changes H by less than this share the next would change nothing.
CONVERGED = 1e-10
# A solution is accepted when the equation holds to this share of S; exact arithmetic judges what follows.
RESIDUAL_SHARE = 1e-6


def solve_riccati(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], q: Float[np.ndarray, "n n"], kappa: float
) -> Float[np.ndarray, "n n"]:
    """The stabilising `S` of `S = A^T (S^{-1} + kappa B B^T)^{-1} A + Q`, by doubling, else by SciPy's QZ.

    Raises `NoSolution` when neither gives one.
    """
    s = doubled(a, kappa * b @ b.T, q)
    if s is not None and residual(a, b, q, kappa, s) < RESIDUAL_SHARE:
        return s
    try:
        s = scipy.linalg.solve_discrete_are(a, b, q, np.eye(b.shape[1]) / kappa)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise NoSolution(f"no stabilising Riccati solution: {error}") from error
    return (s + s.T) / 2


def doubled(
    a: Float[np.ndarray, "n n"], g: Float[np.ndarray, "n n"], q: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"] | None:
    """The limit of the iteration; None if it does not converge in `MOST_STEPS` or leaves the finite numbers."""
    n, h = len(a), q
    for _ in range(MOST_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                solved = np.linalg.solve(np.eye(n) + g @ h, np.hstack([a, g]))
            except np.linalg.LinAlgError:
                return None
            step = a.T @ h @ solved[:, :n]
            h = h + (step + step.T) / 2
            if not np.isfinite(h).all():
                return None
            if np.abs(step).max() <= CONVERGED * np.abs(h).max():
                return h
            g = g + a @ solved[:, n:] @ a.T
            a = a @ solved[:, :n]
        g = (g + g.T) / 2
    return None


def residual(
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n m"],
    q: Float[np.ndarray, "n n"],
    kappa: float,
    s: Float[np.ndarray, "n n"],
) -> float:
    """`|S - A^T (S^{-1} + kappa B B^T)^{-1} A - Q| / |S|`, largest entries."""
    sb = s @ b
    inner = s - kappa * sb @ np.linalg.solve(np.eye(b.shape[1]) + kappa * b.T @ sb, sb.T)
    return float(np.abs(s - a.T @ inner @ a - q).max() / max(np.abs(s).max(), np.finfo(float).tiny))
