"""The verdict on a certificate: exact rational arithmetic on the stored floats, no tolerance anywhere.

Every float is a rational number, so the LMI of a stored certificate is a rational matrix; whether it is positive
definite is a yes or no. Three exact routes, tried from cheap to dear:

* yes, if `G M G^T` is strictly diagonally dominant with a positive diagonal for some rational `G`, then invertible
  (a rounded inverse Cholesky factor; Gershgorin's theorem and Sylvester's law of inertia do the rest);
* no, if `v^T M v <= 0` for some rational `v != 0` (a rounded eigenvector);
* otherwise the fraction-free LDL^T: positive definite iff every leading principal minor is positive (Sylvester).
"""

from fractions import Fraction

import numpy as np
import scipy.linalg
from flint import fmpq, fmpq_mat, fmpz_mat
from jaxtyping import Float

Matrix = fmpq_mat

MANTISSA_BITS = 53  # rounded factors are scaled to integers of this many bits


def rational(matrix: Float[np.ndarray, "r c"]) -> Matrix:
    """The matrix of the very rationals the floats are. Raises `ValueError` or `OverflowError` for NaN or infinity."""
    rows, columns = matrix.shape
    return fmpq_mat(rows, columns, [fmpq(*float(value).as_integer_ratio()) for value in matrix.ravel()])


def exact_product(left: Float[np.ndarray, "r s"], right: Float[np.ndarray, "s c"]) -> Float[np.ndarray, "r c"]:
    """`left @ right` in rationals, each entry rounded once to the nearest float: the same bits on every machine."""
    rows = (rational(left) * rational(right)).tolist()
    return np.array([[float(Fraction(int(value.p), int(value.q))) for value in row] for row in rows])


def theorem_one(
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n m"],
    alpha: float,
    beta: float,
    rate: float,
    p: Float[np.ndarray, "n n"],
    y: Float[np.ndarray, "n n"],
    k: Float[np.ndarray, "m n"],
    sigma: float,
) -> Matrix:
    """`[(1-rho) P - sigma B B^T, A Y + alpha B X, 0; *, Y + Y^T - P, beta X^T; *, *, sigma I]` with `X = K Y`, exactly.

    Shape `(2n + m, 2n + m)`. Source: [Z26] Theorem 1.
    """
    a_, b_, p_, y_ = rational(a), rational(b), rational(p), rational(y)
    x_ = rational(k) * y_
    return _blocks(
        corner=(1 - _number(rate)) * p_ - _number(sigma) * (b_ * b_.transpose()),
        coupling=a_ * y_ + _number(alpha) * (b_ * x_),
        middle=y_ + y_.transpose() - p_,
        border=_number(beta) * x_.transpose(),
        scale=_number(sigma),
    )


def theorem_two(
    a: Float[np.ndarray, "n n"],
    c: Float[np.ndarray, "p n"],
    alpha: float,
    beta: float,
    rate: float,
    q: Float[np.ndarray, "n n"],
    u: Float[np.ndarray, "n n"],
    l: Float[np.ndarray, "n p"],  # noqa: E741
    eta: float,
) -> Matrix:
    """`[(1-rho) Q - eta C^T C, (U A + alpha V C)^T, 0; *, U + U^T - Q, beta V; *, *, eta I]` with `V = U L`, exactly.

    Shape `(2n + p, 2n + p)`. Source: [Z26] Theorem 2.
    """
    a_, c_, q_, u_ = rational(a), rational(c), rational(q), rational(u)
    v_ = u_ * rational(l)
    return _blocks(
        corner=(1 - _number(rate)) * q_ - _number(eta) * (c_.transpose() * c_),
        coupling=(u_ * a_ + _number(alpha) * (v_ * c_)).transpose(),
        middle=u_ + u_.transpose() - q_,
        border=_number(beta) * v_,
        scale=_number(eta),
    )


def _number(value: float) -> fmpq:
    return fmpq(*float(value).as_integer_ratio())


def _blocks(corner: Matrix, coupling: Matrix, middle: Matrix, border: Matrix, scale: fmpq) -> Matrix:
    n, m = border.nrows(), border.ncols()
    top, mid, side, far = corner.tolist(), middle.tolist(), coupling.tolist(), border.tolist()
    zero, side_t, far_t = fmpq(0), coupling.transpose().tolist(), border.transpose().tolist()
    rows = [top[i] + side[i] + [zero] * m for i in range(n)]
    rows += [side_t[i] + mid[i] + far[i] for i in range(n)]
    rows += [[zero] * n + far_t[i] + [scale if i == j else zero for j in range(m)] for i in range(m)]
    return fmpq_mat(rows)


def is_positive_definite(matrix: Matrix) -> bool:
    """Whether a rational matrix is symmetric and positive definite; decided, not estimated."""
    if matrix != matrix.transpose():
        return False
    integer, _ = matrix.numer_denom()  # the common denominator is positive
    scaled = _scaled_floats(integer)
    if _proved_by_dominance(integer, scaled):
        return True
    if _refuted_by_vector(integer, scaled):
        return False
    return has_positive_leading_minors(integer)


def has_positive_leading_minors(integer: fmpz_mat) -> bool:
    """Sylvester's criterion through the fraction-free elimination, whose pivots are the leading principal minors."""
    eliminated, _, order, _ = integer._fflu()
    size = integer.nrows()
    return order == list(range(size)) and all(eliminated[i, i] > 0 for i in range(size))


def _halved_exponents(integer: fmpz_mat) -> list[int]:
    return [int(integer[i, i]).bit_length() // 2 for i in range(integer.nrows())]


def _scaled_floats(integer: fmpz_mat) -> Float[np.ndarray, "s s"]:
    """`M_ij 2^-(e_i + e_j)` in floats, with `e` such that the diagonal is near one; entries are rounded once."""
    halved = _halved_exponents(integer)
    rows = integer.tolist()
    return np.array(
        [[_ratio(int(value), halved[i] + halved[j]) for j, value in enumerate(row)] for i, row in enumerate(rows)]
    )


def _ratio(value: int, exponent: int) -> float:
    if abs(value).bit_length() - exponent > 1000:  # far from diagonal dominance; the sign is all that matters
        return float(np.copysign(1e300, value))
    return value / (1 << exponent)


def _proved_by_dominance(integer: fmpz_mat, scaled: Float[np.ndarray, "s s"]) -> bool:
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    inverse = scipy.linalg.solve_triangular(factor, np.eye(len(scaled)), lower=True)
    if not np.isfinite(inverse).all():
        return False
    product = _congruence(integer, inverse)
    if product is None:
        return False
    rows = product.tolist()
    return all(row[i] > sum(abs(v) for j, v in enumerate(row) if j != i) for i, row in enumerate(rows))


def _refuted_by_vector(integer: fmpz_mat, scaled: Float[np.ndarray, "s s"]) -> bool:
    vectors = np.linalg.eigh(np.clip(scaled, -1e150, 1e150))[1]
    product = _congruence(integer, np.atleast_2d(vectors[:, 0]))
    return product is not None and bool(product[0, 0] <= 0)


def _congruence(integer: fmpz_mat, rows: Float[np.ndarray, "k s"]) -> fmpz_mat | None:
    """`G M G^T` up to positive factors, for `G = rows * 2^-e`, each row rounded to integers; None if G is zero.

    G need not be checked to be invertible: where the product is diagonally dominant it is, and so is M.
    """
    halved = _halved_exponents(integer)
    top = max(halved)
    shift = [2 ** (top - e) for e in halved]
    scale = np.ldexp(1.0, MANTISSA_BITS - np.frexp(np.abs(rows).max(axis=1))[1])
    rounded = np.rint(rows * scale[:, None])
    if not rounded.any():
        return None
    g = fmpz_mat([[int(value) * shift[j] for j, value in enumerate(row)] for row in rounded])
    return g * integer * g.transpose()
