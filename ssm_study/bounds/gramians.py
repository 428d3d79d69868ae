"""How strongly inputs reach states and states reach outputs: Gramians of the linear part."""

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import StateSpace


def _require_stable(linear: StateSpace) -> None:
    require(
        linear.spectral_radius < 1,
        "spectral_radius",
        linear.spectral_radius,
        "the infinite-horizon Gramian of a model that is not stable does not exist",
        "use a finite horizon, or identify a stable model",
    )


def controllability_gramian(linear: StateSpace, horizon: int | None = None) -> Float[np.ndarray, "n n"]:
    """`W = sum_k A^k B B^T (A^T)^k`, over `horizon` samples or, for a stable model, over all.

    Solves `W = A W A^T + B B^T`. Raises `BadRequest` for an infinite horizon on a model that is not stable.
    Source: [Z26] eq. (9), without the scaffolding.
    """
    if horizon is not None:
        return _finite(linear.a, linear.b, horizon)
    _require_stable(linear)
    return _symmetric(scipy.linalg.solve_discrete_lyapunov(linear.a, linear.b @ linear.b.T))


def observability_gramian(linear: StateSpace, horizon: int | None = None) -> Float[np.ndarray, "n n"]:
    """`W = sum_k (A^T)^k C^T C A^k`: the controllability Gramian of `(A^T, C^T)`."""
    if horizon is not None:
        return _finite(linear.a.T, linear.c.T, horizon)
    _require_stable(linear)
    return _symmetric(scipy.linalg.solve_discrete_lyapunov(linear.a.T, linear.c.T @ linear.c))


def _finite(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], horizon: int) -> Float[np.ndarray, "n n"]:
    gramian, power = np.zeros_like(a), b
    for _ in range(horizon):
        gramian, power = gramian + power @ power.T, a @ power
    return _symmetric(gramian)


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return (matrix + matrix.T) / 2
