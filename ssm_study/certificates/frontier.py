"""Exact largest contraction rate that linear gains can be certified for, computed without a solver.
It is the limit of Theorems 1 and 2 of Zakwan et al. [Z26].

Theorem 1 is feasible iff `beta/|alpha| < 1 / sqrt(1 + lambda_max(Bh^T S Bh))`, S of minimum energy;
Theorem 2 is the
same for `(A^T, C^T)`. Derivation: docs/theory.md, "The frontier"; cf. Elia & Mitter 2001, Fu & Xie
2005.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import NoSolution
from ssm_study.refusal import require
from ssm_study.systems import JacobianBall, StateSpace, System

Square = Float[np.ndarray, "n n"]
InputMatrix = Float[np.ndarray, "n m"]
FastMatrix = Float[np.ndarray, "k k"]

# a mode whose left eigenvector meets B at less of `||B||` is out of reach: vectors err by 1e-14
REACH_FLOOR = 1e-12
# eigenvalues closer than this share of the largest count as repeated: a defective pair splits by
# 1e-8
REPEATED = 1e-7
# a mode this near to `|lambda| = r` costs no energy, `(|lambda| / r)^2 - 1`: its metric is infinite
ON_CIRCLE = 1e-10
# After k steps 2^k samples are summed: where 60 do not suffice a closed loop is on the unit circle
# for floats.
MOST_STEPS = 60
NEGLIGIBLE = 1e-20  # a power F^(2^j) of this size no longer matters in sum_j F^j G G^T F^jT


@dataclass(frozen=True, kw_only=True)
class Frontier:
    """Exact limit of the contraction rate that certificates can prove for a model, and what sets
    the limit. A certificate exists for every `rate < rate_limit`, and for none from there on.

    `contraction_limit = sqrt(1 - rate_limit)` is the smallest certifiable factor per step; above
    one (a negative `rate_limit`) nothing is certifiable at all. `decided_by` names what sets the
    limit.
    """

    contraction_limit: float
    decided_by: str

    @property
    def rate_limit(self) -> float:
        """Largest contraction rate that can be certified for a model, `1 - contraction_limit^2`."""
        return 1 - self.contraction_limit**2


def controller_frontier(system: System, ball: JacobianBall) -> Frontier:
    """Exact limit of the contraction rate that can be certified for a system by some state
    feedback. The frontier of Theorem 1 for `x+ = A x + B S_u(u)`; that of Theorem 2 is the dual
    system's (`problem.dual_system`).

    With neurons it is the worst over frozen slopes, which no certificate goes beyond and few
    attain. Raises `BadRequest` for matrices that are not finite.
    """
    if isinstance(system, StateSpace):
        return contraction_frontier(system.a, system.b, ball)
    frontiers = []
    for slopes in system.slope_corners():  # each neuron at slope zero or one
        frozen = system.linearise_at_slopes(slopes)
        frontiers.append(contraction_frontier(frozen.a, frozen.b, ball))
    return max(frontiers, key=lambda limit: limit.contraction_limit)


def contraction_frontier(a: Square, b: InputMatrix, ball: JacobianBall) -> Frontier:
    """Exact limit of the contraction factor that some linear gain can guarantee for all slopes in a
    ball of Jacobians. Infimum of the `r` at which `beta/|alpha| < 1 / sqrt(1 + lambda_max(Bh^T S
    Bh))`.

    If the ball contains zero (`|alpha| <= beta`), the limit is the open loop's own contraction; it
    is never below that of the modes which the input does not reach. Otherwise several inputs need a
    scalar search within closed-form brackets, which meet for one input.
    """
    for label, matrix in (("a", a), ("b", b)):
        is_finite = bool(np.isfinite(matrix).all())
        remedy = "identify the model again"
        require(is_finite, label, "NaN or infinity", "not finite", remedy)
    ascending_moduli = np.sort(np.abs(np.linalg.eigvals(a)))
    moduli = ascending_moduli[::-1]
    if ball.relative_radius >= 1 or not b.any():
        spectral_radius = float(moduli[0])
        return Frontier(contraction_limit=spectral_radius, decided_by="the open loop")
    unreached = largest_uncontrollable_modulus(a, b)
    product = _contraction_at_moduli_product(moduli, ball.relative_radius)
    if unreached >= product:
        return Frontier(contraction_limit=unreached, decided_by="a mode out of reach")
    high = product
    inputs = b.shape[1]
    least = _contraction_at_moduli_product(moduli, ball.relative_radius**inputs)
    low = max(unreached, least, np.finfo(float).tiny)
    # The largest ball grows with r: halved until doubles run out.
    while low < (middle := float(np.sqrt(low * high))) < high:
        energy = largest_control_energy(a, b, middle)
        largest_ball = 1 / np.sqrt(1 + energy)
        if largest_ball > ball.relative_radius:
            high = middle
        else:
            low = middle
    decided_by = "the slopes" if low > unreached else "a mode out of reach"
    return Frontier(contraction_limit=high, decided_by=decided_by)


def largest_uncontrollable_modulus(a: Square, b: InputMatrix) -> float:
    """Largest modulus of an uncontrollable eigenvalue, by the Popov-Belevitch-Hautus test; 0 if
    there is none.

    A repeated eigenvalue has no single eigenvector to test: there the rank of `[A - lambda I, B]`
    decides.
    """
    values, left = np.linalg.eig(a.T)  # columns are left eigenvectors of A
    size_of_b = max(np.linalg.norm(b, 2), np.finfo(float).tiny)
    reach = np.linalg.norm(left.T @ b, axis=1) / size_of_b
    to_itself = np.diag(np.full(len(values), np.inf))
    distances = np.abs(values[:, None] - values) + to_itself
    spectral_radius = np.abs(values).max()
    is_repeated = distances.min(axis=1) < REPEATED * spectral_radius
    identity = np.eye(len(a))
    for i in np.flatnonzero(is_repeated):
        pencil = np.hstack([a - values[i] * identity, b])
        singular_values = np.linalg.svd(pencil, compute_uv=False)
        reach[i] = singular_values[-1] / np.linalg.norm(pencil, 2)
    unreached_values = values[reach < REACH_FLOOR]
    return float(np.abs(unreached_values).max(initial=0.0))


def inverse_time_gramian_root(a: FastMatrix, b: Float[np.ndarray, "k m"]) -> FastMatrix:
    """Square root of the controllability Gramian of the inverse-time system, for modes outside the
    unit circle. Lower triangular `L` with `L L^T = W`, `W = A^{-1} (W + B B^T) A^{-T}`, all
    `|lambda(A)| > 1`.

    Summed in factored form by doubling, so that small directions of W keep their relative accuracy.
    Raises `NoSolution` if the sum does not converge or the factor is singular (a mode out of
    reach).
    """
    f = np.linalg.inv(a)
    root = f @ b
    for _ in range(MOST_STEPS):
        root = np.hstack([root, f @ root])
        if root.shape[1] > len(root):
            # R^T R = root root^T: as narrow as W again.
            triangular = np.linalg.qr(root.T, mode="r")
            root = np.asarray(triangular).T
        f = f @ f  # F^(2^j): each round doubles the terms summed
        size = np.abs(f).max()
        if not np.isfinite(size):
            raise NoSolution("a fast mode lies on the circle |lambda| = r")
        if size < NEGLIGIBLE:
            break
    if root.shape[1] < len(a) or not np.abs(np.diagonal(root)).min() > 0:
        raise NoSolution("a fast mode is out of the input's reach")
    return root


def largest_control_energy(a: Square, b: InputMatrix, contraction: float) -> float:
    """Largest eigenvalue of the matrix that gives the minimum control energy for a contraction
    factor. `lambda_max(Bh^T S Bh)`: 0 when every mode is fast enough already, infinite when a slow
    mode cannot be reached.

    Those with `|lambda| > r` are a left invariant subspace: the ordered real Schur form of `A^T`
    has orthogonal coordinates of it, so no eigenvector basis is ever inverted.
    """
    edge = contraction * (1 + ON_CIRCLE)
    # a lambda: SciPy counts the arguments of its code, which a decorator would hide
    t, z, order = scipy.linalg.schur(
        a.T, output="real", sort=lambda re, im: np.hypot(re, im) > edge
    )
    if not order:
        return 0.0
    slow_subspace = z[:, :order].T
    slow_block = t[:order, :order].T
    bh = slow_subspace @ b / contraction
    try:
        root = inverse_time_gramian_root(slow_block / contraction, bh)
    except NoSolution:
        return np.inf
    whitened = scipy.linalg.solve_triangular(root, bh, lower=True)
    return float(np.linalg.norm(whitened, 2) ** 2)


def _contraction_at_moduli_product(moduli: Float[np.ndarray, "n"], ratio: float) -> float:
    """Contraction factor r at which the ratios `r / |lambda_i|`, over all eigenvalues of modulus
    above r, have a given product. The `r` with `prod over |lambda_i| > r of r/|lambda_i| = ratio`;
    moduli in descending order.

    With the k largest modes faster than r, `r = (ratio prod |lambda_i|)^(1/k)`; the right k is the
    one whose r lies between its neighbours, and the largest candidate is that one.
    """
    counts = np.arange(1, len(moduli) + 1)
    with np.errstate(divide="ignore"):
        log_products = np.log(ratio) + np.cumsum(np.log(moduli))
        logs = log_products / counts
    largest = np.exp(logs.max())
    return float(min(largest, moduli[0]))
