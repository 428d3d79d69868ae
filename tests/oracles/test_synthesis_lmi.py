"""The promises of each objective of the inequality about the matrices that come back, checked in
NumPy."""

import numpy as np
import pytest

from ssm_study.certificates.certificate import StateFeedback
from ssm_study.certificates.frontier import inverse_time_gramian_root
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.synthesis import lmi
from ssm_study.synthesis.guaranteed_cost import guaranteed_cost
from ssm_study.synthesis.lmi import CompiledLmi, LmiSynthesis, certificate_from_paper_lmi
from ssm_study.synthesis.modes import split_modes
from ssm_study.systems import JacobianBall, StateSpace

A = np.array([[1.05, 0.1, 0.0], [-0.1, 0.97, 0.2], [0.0, 0.0, 0.4]])
ONE_INPUT = np.array([[0.1], [1.0], [0.5]])
TWO_INPUTS = np.array([[0.1, 0.7], [1.0, -0.2], [0.5, 0.3]])
INPUTS = {1: ONE_INPUT, 2: TWO_INPUTS}


def problem(inputs: int, beta: float = 0.3) -> Problem:
    ball = JacobianBall(alpha=1.2, beta=beta)
    weight = np.diag([1.0, 0.5, 2.0])
    return Problem(
        a=A, b=INPUTS[inputs], ball=ball, rate=0.1, state_weight=weight, input_weight=0.5
    )


def solved(asked: Problem, objective: str, full: bool) -> tuple[Solution, float]:
    weights = {"state_weight": asked.state_weight, "input_weight": asked.input_weight}
    compiled = CompiledLmi(a=asked.a, b=asked.b, objective=objective, full=full, **weights)
    found = compiled.solve(asked)
    return found, float(compiled.problem.value)


def block(asked: Problem, found: Solution, rows: np.ndarray | None = None) -> np.ndarray:
    """Theorem 1's matrix, by its definition; with performance rows bordered by the identity."""
    a = asked.a
    b = asked.b
    ball = asked.ball
    x = found.k @ found.y
    n, m = b.shape
    coupling = a @ found.y + ball.alpha * b @ x
    border = ball.beta * x.T
    rows = np.zeros((0, n)) if rows is None else rows
    state_rows = np.zeros((n, len(rows)))
    input_rows = np.zeros((m, len(rows)))
    contracted = (1 - asked.rate) * found.p
    corner = contracted - found.sigma * b @ b.T
    difference = found.y + found.y.T - found.p
    no_input = np.zeros((n, m))
    identity = np.eye(len(rows))
    middle = found.sigma * np.eye(m)
    return np.block(
        [
            [corner, coupling, no_input, state_rows],
            [coupling.T, difference, border, rows.T],
            [no_input.T, border.T, middle, input_rows],
            [state_rows.T, rows, input_rows.T, identity],
        ]
    )


def least(matrix: np.ndarray) -> float:
    eigenvalues = np.linalg.eigvalsh(matrix)
    return float(eigenvalues[0])


FORMS = pytest.mark.parametrize(("inputs", "full"), [(1, False), (2, False), (2, True)])


@FORMS
def test_feasibility_is_the_block_matrix_above_the_identity(inputs: int, full: bool) -> None:
    asked = problem(inputs)
    feasible, _ = solved(asked, "feasibility", full)
    matrix = block(asked, feasible)
    assert least(matrix) > 1 - 1e-4


@FORMS
def test_the_largest_margin_is_the_least_eigenvalue_at_a_trace_of_one_each(
    inputs: int, full: bool
) -> None:
    asked = problem(inputs)
    found, value = solved(asked, "largest_margin", full)
    matrix = block(asked, found)
    trace = np.trace(matrix)
    assert trace == pytest.approx(len(matrix), rel=1e-6)
    assert least(matrix) == pytest.approx(-value, abs=1e-5)
    feasible, _ = solved(asked, "feasibility", full)
    other = block(asked, feasible)
    scaled_other = least(other) * len(other) / np.trace(other)
    assert least(matrix) >= scaled_other - 1e-6


@FORMS
def test_the_smallest_gain_is_below_the_root_of_what_was_minimised(inputs: int, full: bool) -> None:
    asked = problem(inputs)
    found, value = solved(asked, "smallest_gain", full)
    assert least(found.p) > 1 - 1e-4
    matrix = block(asked, found)
    assert least(matrix) > 0
    norm = np.linalg.norm(found.k, 2)
    upper_limit = value * (1 + 1e-4)
    assert norm**2 <= upper_limit


@FORMS
def test_the_guaranteed_cost_is_the_trace_of_the_inverse_metric(inputs: int, full: bool) -> None:
    """And the Riccati route finds the same; the bordered block matrix is what bounds the cost."""
    asked = problem(inputs)
    found, value = solved(asked, "guaranteed_cost", full)
    inverse = np.linalg.inv(found.p)
    expected = np.trace(inverse)
    assert value == pytest.approx(expected, rel=1e-4)
    root = np.sqrt(asked.state_weight)  # diagonal
    state_rows = root @ found.y
    input_weight = np.sqrt(asked.input_weight)
    input_rows = input_weight * found.k @ found.y
    rows = np.vstack([state_rows, input_rows])
    matrix = block(asked, found, rows)
    assert least(matrix) > -1e-6
    other = guaranteed_cost(asked)
    tau = float(other.status.split()[1])
    inverse = np.linalg.inv(other.p)
    expected = tau * np.trace(inverse)
    assert value == pytest.approx(expected, rel=1e-2)


def test_theorem_one_as_printed_has_a_y_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = problem(1)
    kept = []
    solve = CompiledLmi.solve

    def noted(self: CompiledLmi, *given: object) -> Solution:
        solution = solve(self, *given)
        kept.append(solution)  # type: ignore[arg-type]
        return kept[-1]

    monkeypatch.setattr(lmi.CompiledLmi, "solve", noted)
    c = np.ones((1, 3))
    d = np.zeros((1, 1))
    linear = StateSpace(a=asked.a, b=asked.b, c=c, d=d)
    assert certificate_from_paper_lmi(linear, asked.ball, asked.rate).certified
    (found,) = kept
    difference = np.abs(found.y - found.p)
    largest_difference = difference.max()
    largest = np.abs(found.p).max()
    lower_limit = 1e-3 * largest
    assert largest_difference > lower_limit


def test_the_inequality_is_solved_with_y_equal_to_p_unless_asked_otherwise() -> None:
    """A third of the unknowns, and nothing lost."""
    asked = problem(1)
    c = np.ones((1, 3))
    d = np.zeros((1, 1))
    linear = StateSpace(a=asked.a, b=asked.b, c=c, d=d)
    cases = (({}, True), ({"full": True}, False))
    for options, equal in cases:
        lmi_synthesis = LmiSynthesis(rate_controller=0.1, rate_observer=0.1, **options)
        part = lmi_synthesis.state_feedback(linear, asked.ball)
        assert isinstance(part, StateFeedback)
        assert part.certified
        assert np.array_equal(part.p, part.y) is equal


def test_modes_that_cannot_be_told_from_the_circle_are_no_solution() -> None:
    """The radius is a mode's own modulus: where rounding moves it across, the reordered form is
    refused, not raised."""

    def split(a: np.ndarray, radius: float) -> np.ndarray:
        try:
            b = np.ones((7, 1))
            modes = split_modes(a, b, radius)
        except NoSolution:
            return np.eye(7)
        return modes.left @ modes.right

    for seed in (102, 108, 176, 335, 503):
        rng = np.random.default_rng(seed)
        a = rng.normal(size=(7, 7))
        eigenvalues = np.linalg.eigvals(a)
        for modulus in np.abs(eigenvalues):
            actual = split(a, float(modulus))
            expected = np.eye(7)
            np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_the_energy_root_is_a_root_of_the_energy_and_there_is_none_out_of_reach() -> None:
    """`W = A^-1 (W + B B^T) A^-T`; two modes that one input moves alike, and one that it does not
    move at all."""
    a = np.array([[1.3, 0.2], [-0.1, 2.0]])
    b = np.array([[1.0], [0.5]])
    root = inverse_time_gramian_root(a, b)
    inverse = np.linalg.inv(a)
    w = root @ root.T
    expected = inverse @ (w + b @ b.T) @ inverse.T
    np.testing.assert_allclose(w, expected, rtol=1e-12)
    expected = np.tril(root)
    np.testing.assert_array_equal(root, expected)
    first_mode_only = np.array([[1.0], [0.0]])
    with pytest.raises(NoSolution, match="out of the input's reach"):
        inverse_time_gramian_root(np.diag([2.0, 3.0]), first_mode_only)
    no_input = np.zeros((2, 1))
    with pytest.raises(NoSolution, match="out of the input's reach"):
        inverse_time_gramian_root(np.diag([2.0, 3.0]), no_input)
