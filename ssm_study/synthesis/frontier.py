"""What is possible: the exact largest rate any certificate of [Z26] Theorems 1 and 2 can reach, without a solver.

With `r = sqrt(1 - rho)`, `Ah = A/r`, `Bh = B/r` and `S` the minimum-energy solution of
`S = Ah^T (S^{-1} + Bh Bh^T)^{-1} Ah`, Theorem 1 is feasible iff `beta/|alpha| < 1 / sqrt(1 + lambda_max(Bh^T S Bh))`.
For one input `1 + Bh^T S Bh = prod (|lambda_i| / r)^2` over the modes with `|lambda_i| > r`. Theorem 2 is the same
statement for `(A^T, C^T)`. Derivation: docs/theory.md; cf. Elia & Mitter 2001, Fu & Xie 2005.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import JacobianBall, StateSpace

# A mode counts as out of the input's reach when its left eigenvector meets B at less than this share of ||B||:
# eigenvectors of a well-conditioned matrix are accurate to about 1e-14.
REACH_FLOOR = 1e-12
# Eigenvalues closer than this share of the largest are treated as repeated (a defective pair splits by 1e-8).
REPEATED = 1e-7


@dataclass(frozen=True, kw_only=True)
class Frontier:
    """A certificate exists for every `rate < rate_limit`, and for none from there on.

    `contraction_limit = sqrt(1 - rate_limit)` is the smallest certifiable factor per step; above one (a negative
    `rate_limit`) nothing is certifiable at all. `decided_by` names what sets the limit.
    """

    contraction_limit: float
    decided_by: str

    @property
    def rate_limit(self) -> float:
        return 1 - self.contraction_limit**2


def controller_frontier(linear: StateSpace, ball: JacobianBall) -> Frontier:
    """The frontier of Theorem 1 for `x+ = A x + B S_u(u)`. Raises `BadRequest` for matrices that are not finite."""
    return frontier(linear.a, linear.b, ball)


def observer_frontier(linear: StateSpace, ball: JacobianBall) -> Frontier:
    """The frontier of Theorem 2: that of the dual pair `(A^T, C^T)`."""
    return frontier(linear.a.T, linear.c.T, ball)


def rate_limit(linear: StateSpace, input_ball: JacobianBall, output_ball: JacobianBall) -> tuple[float, float]:
    """The largest certifiable rates of controller and observer."""
    controller, observer = controller_frontier(linear, input_ball), observer_frontier(linear, output_ball)
    return controller.rate_limit, observer.rate_limit


def frontier(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], ball: JacobianBall) -> Frontier:
    """Infimum of the `r` at which `beta/|alpha| < ratio_limit(a, b, r)`.

    A ball that holds zero (`|alpha| <= beta`) leaves the open loop's own contraction; modes the input does not reach
    keep theirs. In between several inputs need a scalar search within closed-form brackets, which meet for one input.
    """
    _require_finite(a, b)
    moduli = np.sort(np.abs(np.linalg.eigvals(a)))[::-1]
    if ball.relative_radius >= 1 or not b.any():
        return Frontier(contraction_limit=float(moduli[0]), decided_by="the open loop")
    unreached = unreached_modulus(a, b)
    product = _product_limit(moduli, ball.relative_radius)
    if unreached >= product:
        return Frontier(contraction_limit=unreached, decided_by="a mode out of reach")
    lowest = max(unreached, _product_limit(moduli, ball.relative_radius ** b.shape[1]))
    limit = _search(a, b, ball.relative_radius, lowest, product)
    return Frontier(contraction_limit=limit, decided_by="the slopes" if limit > unreached else "a mode out of reach")


def ratio_limit(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], contraction: float) -> float:
    """The supremum of `beta/|alpha|` at which Theorem 1 is feasible with `r = contraction`; 0 if no ball at all is.

    For one input `prod r/|lambda_i|` over `|lambda_i| > r`; for several `1 / sqrt(1 + lambda_max(Bh^T S Bh))`.
    """
    _require_finite(a, b)
    if b.any() and unreached_modulus(a, b) >= contraction:
        return 0.0
    if b.shape[1] == 1:
        moduli = np.abs(np.linalg.eigvals(a))
        return float(np.prod(contraction / np.maximum(moduli, contraction)))
    return float(1 / np.sqrt(1 + _largest_energy(a, b, contraction)))


def unreached_modulus(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> float:
    """The largest `|lambda|` of a mode the input does not reach (Popov-Belevitch-Hautus, left eigenvectors); 0 if none.

    A repeated eigenvalue has no single eigenvector to test: there the rank of `[A - lambda I, B]` decides.
    """
    values, left = np.linalg.eig(a.T)
    reach = np.linalg.norm(left.T @ b, axis=1) / max(np.linalg.norm(b, 2), np.finfo(float).tiny)
    distances = np.abs(values[:, None] - values) + np.diag(np.full(len(values), np.inf))
    for i in np.flatnonzero(distances.min(axis=1) < REPEATED * np.abs(values).max()):
        pencil = np.hstack([a - values[i] * np.eye(len(a)), b])
        reach[i] = np.linalg.svd(pencil, compute_uv=False)[-1] / np.linalg.norm(pencil, 2)
    return float(np.abs(values[reach < REACH_FLOOR]).max(initial=0.0))


@dataclass(frozen=True, kw_only=True)
class FastPart:
    """The modes with `|lambda| > r`: `z = basis^T x`, `z+ = a z + b u`: a left invariant subspace."""

    basis: Float[np.ndarray, "n k"]
    a: Float[np.ndarray, "k k"]
    b: Float[np.ndarray, "k m"]

    @property
    def order(self) -> int:
        return len(self.a)


def fast_part(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], contraction: float) -> FastPart:
    """Ordered real Schur form of `A^T`: orthogonal coordinates, so no eigenvector basis is ever inverted."""
    t, z, order = scipy.linalg.schur(a.T, output="real", sort=lambda re, im: np.hypot(re, im) > contraction)
    basis = z[:, :order]
    return FastPart(basis=basis, a=t[:order, :order].T, b=basis.T @ b)


def minimum_energy(a: Float[np.ndarray, "k k"], b: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k k"]:
    """`W = S^{-1}` of `S = A^T (S^{-1} + B B^T)^{-1} A`, all `|lambda(A)| > 1`: `W = A^{-1} (W + B B^T) A^{-T}`.

    With no weight on the state the Riccati equation is a Lyapunov equation in the inverse.
    """
    inverse = np.linalg.inv(a)
    w = scipy.linalg.solve_discrete_lyapunov(inverse, inverse @ b @ b.T @ inverse.T)
    return (w + w.T) / 2


def _largest_energy(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], contraction: float) -> float:
    """`lambda_max(Bh^T S Bh)`, 0 when no mode is faster than `r` asks for."""
    part = fast_part(a, b, contraction)
    if part.order == 0:
        return 0.0
    bh = part.b / contraction
    w = minimum_energy(part.a / contraction, bh)
    return float(np.linalg.eigvalsh(bh.T @ np.linalg.solve(w, bh))[-1])


def _product_limit(moduli: Float[np.ndarray, "n"], ratio: float) -> float:
    """The `r` with `prod over |lambda_i| > r of r/|lambda_i| = ratio`; moduli in descending order.

    With the k largest modes faster than r, `r = (ratio prod |lambda_i|)^(1/k)`; the right k is the one whose r lies
    between its neighbours, and the largest candidate is that one.
    """
    with np.errstate(divide="ignore"):
        logs = (np.log(ratio) + np.cumsum(np.log(moduli))) / np.arange(1, len(moduli) + 1)
    return float(min(np.exp(logs.max()), moduli[0]))


def _search(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], ratio: float, low: float, high: float) -> float:
    """Bisection on `r` until doubles are exhausted: `ratio_limit` grows with `r`."""
    low = max(low, np.finfo(float).tiny)
    while low < (middle := float(np.sqrt(low * high))) < high:
        feasible = 1 / np.sqrt(1 + _largest_energy(a, b, middle)) > ratio
        low, high = (low, middle) if feasible else (middle, high)
    return high


def _require_finite(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> None:
    for label, matrix in (("a", a), ("b", b)):
        require(bool(np.isfinite(matrix).all()), label, "NaN or infinity", "not finite", "identify the model again")
