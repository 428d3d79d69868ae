"""Exact verdicts by two routes, and certificates that survive the trip through their file."""

import json
from fractions import Fraction

import numpy as np
import pytest
from flint import fmpq_mat, fmpz_mat
from hypothesis import given
from hypothesis import strategies as st

from ssm_study import exact
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.exact import ExactMatrix
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace


class Model:
    """A stable third-order model, one fast and one slow pole pair."""

    a = np.array([[0.95, 0.1, 0.0], [-0.1, 0.95, 0.2], [0.0, 0.0, 0.5]])
    b = np.array([[0.0], [1.0], [0.7]])
    c = np.array([[1.0, 0.5, -0.3]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)


INPUT_BALL = JacobianBall.from_slopes(0.3, 1.0)
OUTPUT_BALL = JacobianBall.from_slopes(0.8, 1.2)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)


def plain_ldl_is_positive(matrix: list[list[Fraction]]) -> bool:
    """Textbook LDL^T in fractions: the slow independent route."""
    rows = [row[:] for row in matrix]
    for i, pivot_row in enumerate(rows):
        pivot = pivot_row[i]
        if pivot <= 0:
            return False
        for j in range(i + 1, len(rows)):
            factor = rows[j][i] / pivot
            pairs = zip(rows[j], pivot_row, strict=True)
            rows[j] = [entry - factor * above for entry, above in pairs]
    return True


SHIFTS = [-1e-3, -1e-13, -1e-16, 0.0, 1e-16, 1e-13, 1e-3]
SHIFT = st.sampled_from(SHIFTS)
SIZE = st.integers(1, 6)
SEED = st.integers(0, 10_000)


@given(SIZE, SEED, SHIFT)
def test_the_exact_routes_agree_with_textbook_elimination(
    size: int, seed: int, shift: float
) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(size, size))
    gram = factor @ factor.T
    gram = (gram + gram.T) / 2
    eigenvalues = np.linalg.eigvalsh(gram)
    difference = shift - eigenvalues[0]
    matrix = gram + difference * np.eye(size)
    fractions = []
    for row in matrix.tolist():
        fractions.append([Fraction(value) for value in row])
    as_exact = ExactMatrix.from_floats(matrix)
    verdict = exact.is_positive_definite(as_exact)
    assert verdict == plain_ldl_is_positive(fractions)
    rational = as_exact.rational
    integer = rational.numer_denom()[0]
    expected = exact.has_positive_leading_minors(integer)
    assert verdict == expected


METHODS = [RiccatiSynthesis, ClosedFormSynthesis, LmiSynthesis]


@pytest.mark.parametrize("synthesis", METHODS)
def test_every_method_is_certified_and_survives_its_file(synthesis, tmp_path) -> None:
    method = synthesis(rate_controller=0.3, rate_observer=0.3)
    design = method.design(Model(), BALLS)
    assert design.certified
    design.save(tmp_path / "certificate.json")
    again = Design.load(tmp_path / "certificate.json")
    for side in ("state_feedback", "observer"):
        before = getattr(design, side)
        after = getattr(again, side)
        for name in vars(before):
            value = getattr(before, name)
            value_after = getattr(after, name)
            assert np.array_equal(value, value_after), name
    text = (tmp_path / "certificate.json").read_text()
    content = json.loads(text)
    observer = content["observer"]
    certified = observer["certified"]
    assert certified is True


def assert_gains_agree(actual: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-3)


def test_riccati_and_lmi_agree_on_the_guaranteed_cost_gain() -> None:
    rates = {"rate_controller": 0.2, "rate_observer": 0.2}
    riccati_synthesis = RiccatiSynthesis(**rates)
    riccati = riccati_synthesis.design(Model(), BALLS)
    lmi_synthesis = LmiSynthesis(**rates, objective="guaranteed_cost")
    lmi = lmi_synthesis.design(Model(), BALLS)
    assert_gains_agree(riccati.state_feedback.k, lmi.state_feedback.k)
    assert_gains_agree(riccati.observer.l, lmi.observer.l)


def test_beyond_the_frontier_is_a_recorded_outcome_with_the_number() -> None:
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.9, rate_observer=0.3)
    design = riccati_synthesis.design(Model(), BALLS)
    outcome = design.state_feedback
    assert not outcome.certified
    assert outcome.proved
    assert outcome.rate_limit < 0.9
    printed_limit = f"{outcome.rate_limit:.6g}"
    assert printed_limit in outcome.reason


def test_minors_of_one_and_of_zero() -> None:
    """Pivots of the fraction-free elimination are integers: one is the smallest that is positive,
    zero is not."""
    integer = fmpz_mat([[1, 0], [0, 1]])
    assert exact.has_positive_leading_minors(integer)
    integer = fmpz_mat([[1, 1], [1, 1]])
    assert not exact.has_positive_leading_minors(integer)
    integer = fmpz_mat([[0, 1], [1, 0]])
    assert not exact.has_positive_leading_minors(integer)


def assert_inequality(conditions: dict[str, ExactMatrix], expected: np.ndarray) -> None:
    """The exact inequality, in floats, is this matrix."""
    actual = conditions["inequality"].to_floats()
    np.testing.assert_allclose(actual, expected, atol=1e-13)


def test_the_exact_blocks_are_the_theorems_blocks() -> None:
    """Theorems 1 and 2 written out in NumPy, entry by entry, with Y different from P."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3, 3))
    p = rng.normal(size=(3, 3))
    y = rng.normal(size=(3, 3))
    b = rng.normal(size=(3, 2))
    k = rng.normal(size=(2, 3))
    zero = np.zeros((3, 2))
    p = p + p.T
    x = k @ y
    coupling = a @ y + 0.7 * b @ x
    border = 0.2 * x.T
    corner = 0.6 * p - 1.3 * b @ b.T
    middle = y + y.T - p
    first_rows = [corner, coupling, zero]
    middle_rows = [coupling.T, middle, border]
    identity = 1.3 * np.eye(2)
    last_rows = [zero.T, border.T, identity]
    state_feedback_matrix = np.block([first_rows, middle_rows, last_rows])
    numbers = {"alpha": 0.7, "beta": 0.2, "rate": 0.4}
    variables = {"a": a, "b": b, "p": p, "y": y, "k": k}
    exactly = StateFeedbackOfBall.exact_conditions(sigma=1.3, **variables, **numbers)
    assert_inequality(exactly, state_feedback_matrix)
    c = b.T.copy()
    gain = k.T.copy()
    v = y @ gain
    coupling = (y @ a + 0.7 * v @ c).T
    border = 0.2 * v
    first_rows = [corner, coupling, zero]
    middle_rows = [coupling.T, middle, border]
    last_rows = [zero.T, border.T, identity]
    observer_matrix = np.block([first_rows, middle_rows, last_rows])
    variables = {"a": a, "c": c, "q": p, "u": y, "l": gain}
    exactly = ObserverOfBall.exact_conditions(eta=1.3, **variables, **numbers)
    assert_inequality(exactly, observer_matrix)


def forbid_elimination(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the exact elimination fail the test."""

    def fail(_: fmpz_mat) -> None:
        pytest.fail("eliminated")

    monkeypatch.setattr(exact, "has_positive_leading_minors", fail)


def test_units_far_apart_are_decided_by_the_balls_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows and columns in units that are `2^40` apart, one of them indefinite by its last bit."""
    forbid_elimination(monkeypatch)
    entries = [[2, 2**40], [2**40, 2 * 2**80]]
    rational = fmpq_mat(entries)
    matrix = ExactMatrix(rational)
    assert exact.is_positive_definite(matrix)
    entries = [[1, 2**41], [2**41, 2**80]]
    rational = fmpq_mat(entries)
    matrix = ExactMatrix(rational)
    assert not exact.is_positive_definite(matrix)
    entries = [[2**400, 2**200], [2**200, 0]]
    rational = fmpq_mat(entries)
    matrix = ExactMatrix(rational)
    assert not exact.is_positive_definite(matrix)


def test_what_is_singular_exactly_is_left_to_the_elimination(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No number of digits shows the sign of a zero."""
    eliminated: list[fmpz_mat] = []

    def record_integer(integer: fmpz_mat) -> bool:
        eliminated.append(integer)
        return False

    monkeypatch.setattr(exact, "has_positive_leading_minors", record_integer)
    rows = [[3, 1, 4], [1, 3, 4], [4, 4, 8]]  # the last row is the sum of the others
    third = fmpz_mat(rows)
    matrix = ExactMatrix(fmpq_mat(third))
    assert not exact.is_positive_definite(matrix)
    assert eliminated == [third]


SCALARS = [[[0]], [[-1]]]
SINGULAR = [[[0, 0], [0, 1]], [[1, 0], [0, 0]]]
INDEFINITE = [[[0, 1], [1, 0]], [[-1, 0], [0, 1]]]


@pytest.mark.parametrize("rows", [*SCALARS, *SINGULAR, *INDEFINITE])
def test_zero_and_less_on_the_diagonal(rows: list[list[int]]) -> None:
    matrix = ExactMatrix(fmpq_mat(rows))
    assert not exact.is_positive_definite(matrix)


SMALLEST_PIVOTS = [1e-17, -1e-17, 1e-30, -1e-30, 1e-60, -1e-60]


@pytest.mark.parametrize("size", [3, 40])
@pytest.mark.parametrize("smallest", SMALLEST_PIVOTS)
def test_what_floats_cannot_see_needs_no_elimination(
    size: int, smallest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`L diag(1, ..., smallest) L^T`, exact: definite or not by its last pivot, far below the
    resolution of floats."""
    rng = np.random.default_rng(size)
    drawn_entries = rng.normal(size=(size, size))
    entries = 0.1 * drawn_entries
    strict_triangle = np.tril(entries, -1)
    unit_triangle = strict_triangle + np.eye(size)
    lower = ExactMatrix.from_floats(unit_triangle)
    falling = np.geomspace(1, 1e-3, size - 1)
    pivots = [*falling, smallest]
    diagonal = np.diag(pivots)
    matrix = lower @ diagonal @ lower.T
    forbid_elimination(monkeypatch)
    is_definite = exact.is_positive_definite(matrix)
    assert is_definite is (smallest > 0)


def test_a_factor_whose_inverse_is_beyond_the_floats_is_decided() -> None:
    """`L L^T` with `2^-20` beside ones, exact in floats: L's inverse grows by `2^20` a row."""
    ones = np.ones(55)
    shift = np.diag(ones, -1)
    small_diagonal = 2.0**-20 * np.eye(56)
    factor = small_diagonal + shift
    floats = factor @ factor.T
    actual = np.linalg.cholesky(floats)
    np.testing.assert_array_equal(actual, factor)
    matrix = ExactMatrix.from_floats(floats)
    assert exact.is_positive_definite(matrix)
    floats[-1, -1] = 1.0  # the last pivot is zero
    matrix = ExactMatrix.from_floats(floats)
    assert not exact.is_positive_definite(matrix)
