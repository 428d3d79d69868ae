"""The minimum-energy gain and its metric, explicit in the coordinates a linear recurrent unit is born in: its modes.

For one input and `A = diag(lambda)` the gain moves every mode with `|lambda_i| > r` to its mirror
`mu_i = r^2 / conj(lambda_i)` and leaves the others:

    k_i = -prod_j (lambda_i - mu_j) / (b_i prod_{j != i} (lambda_i - lambda_j)) / ((1 - delta^2) alpha),
    W_ij = b_i conj(b_j) / (lambda_i conj(lambda_j) - r^2).

No factorisation, no iteration: microseconds. Derivation: docs/theory.md.
"""

import numpy as np
from jaxtyping import Complex

from ssm_study.systems import JacobianBall


def modal_gain(
    eigenvalues: Complex[np.ndarray, "n"], b: Complex[np.ndarray, "n"], ball: JacobianBall, contraction: float
) -> Complex[np.ndarray, "n"]:
    """`k (n,)` with `u = sum_i k_i z_i`, zero on slow modes; distinct eigenvalues, conjugate pairs with conjugate b."""
    fast = np.abs(eigenvalues) > contraction
    modes = eigenvalues[fast]
    moved = modes[:, None] - contraction**2 / modes.conj()
    apart = modes[:, None] - modes
    np.fill_diagonal(apart, 1.0)
    k = np.zeros(len(eigenvalues), dtype=complex)
    # One quotient at a time: the products alone overflow for hundreds of modes.
    k[fast] = -np.prod(moved / apart, axis=1) / (b[fast] * (1 - ball.relative_radius**2) * ball.alpha)
    return k


def modal_energy(
    eigenvalues: Complex[np.ndarray, "k"], b: Complex[np.ndarray, "k"], contraction: float
) -> Complex[np.ndarray, "k k"]:
    """`W` of the fast modes (all `|lambda| > r`): Hermitian; `P = (1/delta^2 - 1) W` with sigma = 1."""
    return np.outer(b, b.conj()) / (np.outer(eigenvalues, eigenvalues.conj()) - contraction**2)
