"""The verdict on a certificate: exact arithmetic on the stored floats, no tolerance anywhere.

Floats are rational numbers, so whether a matrix of them is positive definite is a yes or no. `M = [A, B; B^T, C]` is
positive definite iff A and the Schur complement `C - B^T A^{-1} B` are: by halves, down to numbers. It is done in balls
(FLINT's `arb`): each holds the exact number, so a sign that a ball shows is proved, whatever was rounded. Where one
contains zero, twice as many digits are taken; where `BITS` do not decide (a matrix that is singular, exactly), the
fraction-free LDL^T does: positive definite iff every leading principal minor is positive (Sylvester).

Why it is needed: docs/theory.md, "The verdict". Source of the balls: Johansson 2017 (Arb).
"""

from typing import Any

import numpy as np
from flint import arb_mat, ctx, fmpz_mat
from jaxtyping import Float

BITS = (128, 256, 512, 1024)  # floats have 53; certificates whose margin floats still see are decided by the first


class Exact:
    """`integer 2^-shift`: a matrix of binary fractions, which is what floats are and what their sums and products stay.

    `+, -, @, .T, [:, :]` as NumPy has them, with arrays and floats too; `*` scales by a number. No fraction is reduced.
    """

    __array_ufunc__ = None  # NumPy leaves `array @ exact` to this class
    __slots__ = ("integer", "shift")

    def __init__(self, integer: fmpz_mat, shift: int = 0) -> None:
        self.integer, self.shift = integer, shift

    @classmethod
    def of(cls, value: Any) -> "Exact":
        """The very rationals that floats are. Raises `ValueError` or `OverflowError` for NaN or infinity."""
        if isinstance(value, cls):
            return value
        matrix = np.atleast_2d(np.asarray(value, dtype=float))
        ratios = [entry.as_integer_ratio() for entry in matrix.ravel().tolist()]
        shift = max((bottom.bit_length() - 1 for _, bottom in ratios), default=0)
        entries = [top << (shift + 1 - bottom.bit_length()) for top, bottom in ratios]
        return cls(fmpz_mat(len(matrix), matrix.shape[1], entries), shift)

    @classmethod
    def block(cls, rows: list[list[Any]]) -> "Exact":
        """As `np.block`; raises `ValueError` where the blocks do not fit."""
        blocks = [[cls.of(block) for block in row] for row in rows]
        shift = max(block.shift for row in blocks for block in row)
        return cls._of_entries(np.block([[block._entries(shift) for block in row] for row in blocks]), shift)

    @classmethod
    def _of_entries(cls, entries: np.ndarray, shift: int) -> "Exact":
        return cls(fmpz_mat(len(entries), entries.shape[1], entries.ravel().tolist()), shift)

    def _entries(self, shift: int) -> np.ndarray:  # The integers at another shift, as an array of objects
        return np.array(self._shifted(shift).tolist(), dtype=object).reshape(self.shape)

    def _shifted(self, shift: int) -> fmpz_mat:
        return self.integer * (1 << (shift - self.shift))

    @property
    def shape(self) -> tuple[int, int]:
        return self.integer.nrows(), self.integer.ncols()

    @property
    def T(self) -> "Exact":
        return Exact(self.integer.transpose(), self.shift)

    def __getitem__(self, index: tuple[slice, slice]) -> "Exact":
        return Exact._of_entries(self._entries(self.shift)[index], self.shift)

    def diagonal(self) -> "Exact":
        """The diagonal matrix of the entries of a row."""
        return Exact._of_entries(np.diagflat(self._entries(self.shift)[0]), self.shift)

    def rounded(self) -> Float[np.ndarray, "r c"]:
        """Each entry rounded once to the nearest float: the same bits on every machine."""
        scale = 1 << self.shift
        return np.array([[int(entry) / scale for entry in row] for row in self.integer.tolist()])

    def __add__(self, other: Any) -> "Exact":
        right, shift = Exact.of(other), max(self.shift, Exact.of(other).shift)
        return Exact(self._shifted(shift) + right._shifted(shift), shift)

    __radd__ = __add__

    def __neg__(self) -> "Exact":
        return self * -1

    def __sub__(self, other: Any) -> "Exact":
        return self + -Exact.of(other)

    def __rsub__(self, other: Any) -> "Exact":
        return -self + other

    def __matmul__(self, other: Any) -> "Exact":
        right = Exact.of(other)
        return Exact(self.integer * right.integer, self.shift + right.shift)

    def __rmatmul__(self, other: Any) -> "Exact":
        return Exact.of(other) @ self

    def __mul__(self, other: Any) -> "Exact":
        number, matrix = (self, Exact.of(other)) if self.shape == (1, 1) else (Exact.of(other), self)
        if number.shape != (1, 1):
            raise ValueError("only a number scales a matrix")
        return Exact(matrix.integer * number.integer[0, 0], matrix.shift + number.shift)

    __rmul__ = __mul__


def exact_product(left: Float[np.ndarray, "r s"], right: Float[np.ndarray, "s c"]) -> Float[np.ndarray, "r c"]:
    """`left @ right`, exactly, each entry rounded once to the nearest float."""
    return (Exact.of(left) @ right).rounded()


def is_positive_definite(matrix: Exact) -> bool:
    """Whether a matrix of rationals is symmetric and positive definite; decided, not estimated."""
    integer = matrix.integer  # the common denominator is positive
    if integer != integer.transpose():  # a quadratic form alone would not see it
        return False
    for bits in BITS:
        with ctx.workprec(bits):
            decided = _definite(arb_mat(integer))
        if decided is not None:
            return decided
    return has_positive_leading_minors(integer)


def _definite(matrix: arb_mat) -> bool | None:  # What these balls prove; None where one of them leaves it open
    rows, half = matrix.tolist(), matrix.nrows() // 2
    if not half:
        return True if rows[0][0] > 0 else False if rows[0][0] <= 0 else None
    first, rest = slice(half), slice(half, None)
    a, b, c = (arb_mat([row[s] for row in rows[r]]) for r, s in ((first, first), (first, rest), (rest, rest)))
    if (upper := _definite(a)) is not True:
        return upper
    try:
        return _definite(c - b.transpose() * a.solve(b))
    except ZeroDivisionError:  # A is not seen to be regular
        return None


def has_positive_leading_minors(integer: fmpz_mat) -> bool:
    """Sylvester's criterion through the fraction-free elimination, whose pivots are the leading principal minors."""
    eliminated, _, order, _ = integer._fflu()
    size = integer.nrows()
    return order == list(range(size)) and all(eliminated[i, i] > 0 for i in range(size))
