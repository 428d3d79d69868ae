"""Coordinates in which Theorem 1 is well conditioned: fast modes balanced by their energy, slow modes beside them.

Only the modes with `|lambda| > r` need the input. In coordinates where their minimum-energy metric is the identity,
every matrix of the inequality has condition number about `1 / (room to the frontier)`; the slow modes are contracted by
the open loop already and join through a Lyapunov equation. Derivation: docs/theory.md.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.synthesis.problem import NoSolution

# Doublings of F in sum_j F^j G G^T F^jT: 2^60 terms, or stop when F^(2^j) no longer matters.
DOUBLINGS = 60
NEGLIGIBLE = 1e-20


@dataclass(frozen=True, kw_only=True)
class Modes:
    """`x = right [z_fast; z_slow]`, `[z_fast; z_slow] = left x`, and the two parts do not see each other.

    Shapes: `right, left (n, n)`; `a_fast (k, k)`, `b_fast (k, m)`, `a_slow (n-k, n-k)`, `b_slow (n-k, m)`.
    """

    right: Float[np.ndarray, "n n"]
    left: Float[np.ndarray, "n n"]
    a_fast: Float[np.ndarray, "k k"]
    b_fast: Float[np.ndarray, "k m"]
    a_slow: Float[np.ndarray, "s s"]
    b_slow: Float[np.ndarray, "s m"]

    @property
    def fast(self) -> int:
        return len(self.a_fast)


def split_modes(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], contraction: float) -> Modes:
    """Ordered real Schur form of `A^T` (the fast part drives the slow one), then a Sylvester equation decouples them.

    Raises `NoSolution` when an eigenvalue lies so close to the circle of radius r that the two parts cannot be told
    apart.
    """
    try:
        t, z, k = scipy.linalg.schur(a.T, output="real", sort=lambda re, im: np.hypot(re, im) > contraction)
    except np.linalg.LinAlgError as error:
        raise NoSolution("fast and slow modes cannot be separated") from error
    lower = t.T  # z^T A z, block lower triangular
    a_fast, a_slow, coupling = lower[:k, :k], lower[k:, k:], lower[k:, :k]
    left, right = z.T.copy(), z.copy()
    if 0 < k < len(a):
        x = scipy.linalg.solve_sylvester(a_slow, -a_fast, -coupling)
        left[k:] -= x @ left[:k]
        right[:, :k] += right[:, k:] @ x
    b_z = left @ b
    return Modes(right=right, left=left, a_fast=a_fast, b_fast=b_z[:k], a_slow=a_slow, b_slow=b_z[k:])


def energy_root(a: Float[np.ndarray, "k k"], b: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k k"]:
    """Lower triangular `L` with `L L^T = W`, `W = A^{-1} (W + B B^T) A^{-T}`, all `|lambda(A)| > 1`.

    Summed in factored form by doubling, so that small directions of W keep their relative accuracy.
    Raises `NoSolution` if the sum does not converge or the factor is singular (a mode out of reach).
    """
    f = np.linalg.inv(a)
    root = f @ b
    for _ in range(DOUBLINGS):
        root = _compressed(np.hstack([root, f @ root]))
        f = f @ f
        size = np.abs(f).max()
        if not np.isfinite(size):
            raise NoSolution("a fast mode lies on the circle |lambda| = r")
        if size < NEGLIGIBLE:
            break
    if root.shape[1] < len(a) or not np.abs(np.diagonal(root)).min() > 0:
        raise NoSolution("a fast mode is out of the input's reach")
    return root


def _compressed(root: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "k d"]:
    if root.shape[1] <= root.shape[0]:
        return root
    return np.asarray(np.linalg.qr(root.T, mode="r")).T
