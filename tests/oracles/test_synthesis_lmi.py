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

ROTATION = [[1.05, 0.1, 0.0], [-0.1, 0.97, 0.2]]
A = np.array([*ROTATION, [0.0, 0.0, 0.4]])
ONE_INPUT = np.array([[0.1], [1.0], [0.5]])
TWO_INPUTS = np.array([[0.1, 0.7], [1.0, -0.2], [0.5, 0.3]])
INPUTS = {1: ONE_INPUT, 2: TWO_INPUTS}


def problem(inputs: int, beta: float = 0.3) -> Problem:
    ball = JacobianBall(alpha=1.2, beta=beta)
    weight = np.diag([1.0, 0.5, 2.0])
    weights = {"state_weight": weight, "input_weight": 0.5}
    return Problem(a=A, b=INPUTS[inputs], ball=ball, rate=0.1, **weights)


def solved(posed: Problem, objective: str, full: bool) -> tuple[Solution, float]:
    weights = {"state_weight": posed.state_weight, "input_weight": posed.input_weight}
    form = {"objective": objective, "full": full}
    compiled = CompiledLmi(a=posed.a, b=posed.b, **form, **weights)
    solution = compiled.solve(posed)
    return solution, float(compiled.problem.value)


def block(posed: Problem, solution: Solution, rows: np.ndarray | None = None) -> np.ndarray:
    """Theorem 1's matrix, by its definition; with performance rows bordered by the identity."""
    a = posed.a
    b = posed.b
    ball = posed.ball
    p = solution.p
    y = solution.y
    x = solution.k @ y
    n, m = b.shape
    coupling = a @ y + ball.alpha * b @ x
    border = ball.beta * x.T
    if rows is None:
        rows = np.zeros((0, n))
    bordered = len(rows)
    state_rows = np.zeros((n, bordered))
    input_rows = np.zeros((m, bordered))
    contracted = (1 - posed.rate) * p
    corner = contracted - solution.sigma * b @ b.T
    difference = y + y.T - p
    no_input = np.zeros((n, m))
    identity = np.eye(bordered)
    middle = solution.sigma * np.eye(m)
    next_state = [corner, coupling, no_input, state_rows]
    state = [coupling.T, difference, border, rows.T]
    of_input = [no_input.T, border.T, middle, input_rows]
    performance = [state_rows.T, rows, input_rows.T, identity]
    return np.block([next_state, state, of_input, performance])


def least(matrix: np.ndarray) -> float:
    eigenvalues = np.linalg.eigvalsh(matrix)
    return float(eigenvalues[0])


INPUTS_AND_FORMS = [(1, False), (2, False), (2, True)]
FORMS = pytest.mark.parametrize(("inputs", "full"), INPUTS_AND_FORMS)


@FORMS
def test_feasibility_is_the_block_matrix_above_the_identity(inputs: int, full: bool) -> None:
    posed = problem(inputs)
    feasible, _ = solved(posed, "feasibility", full)
    matrix = block(posed, feasible)
    assert least(matrix) > 1 - 1e-4


@FORMS
def test_the_largest_margin_is_the_least_eigenvalue_at_a_trace_of_one_each(
    inputs: int, full: bool
) -> None:
    posed = problem(inputs)
    solution, value = solved(posed, "largest_margin", full)
    matrix = block(posed, solution)
    trace = np.trace(matrix)
    assert trace == pytest.approx(len(matrix), rel=1e-6)
    margin = least(matrix)
    assert margin == pytest.approx(-value, abs=1e-5)
    feasible, _ = solved(posed, "feasibility", full)
    other = block(posed, feasible)
    scaling = len(other) / np.trace(other)
    scaled_other = least(other) * scaling
    assert margin >= scaled_other - 1e-6


@FORMS
def test_the_smallest_gain_is_below_the_root_of_what_was_minimised(inputs: int, full: bool) -> None:
    posed = problem(inputs)
    solution, value = solved(posed, "smallest_gain", full)
    assert least(solution.p) > 1 - 1e-4
    matrix = block(posed, solution)
    assert least(matrix) > 0
    norm = np.linalg.norm(solution.k, 2)
    upper_limit = value * (1 + 1e-4)
    assert norm**2 <= upper_limit


@FORMS
def test_the_guaranteed_cost_is_the_trace_of_the_inverse_metric(inputs: int, full: bool) -> None:
    """And the Riccati route finds the same; the bordered block matrix is what bounds the cost."""
    posed = problem(inputs)
    solution, value = solved(posed, "guaranteed_cost", full)
    inverse = np.linalg.inv(solution.p)
    expected = np.trace(inverse)
    assert value == pytest.approx(expected, rel=1e-4)
    root = np.sqrt(posed.state_weight)  # diagonal
    state_rows = root @ solution.y
    input_weight = np.sqrt(posed.input_weight)
    input_rows = input_weight * solution.k @ solution.y
    rows = np.vstack([state_rows, input_rows])
    matrix = block(posed, solution, rows)
    assert least(matrix) > -1e-6
    other = guaranteed_cost(posed)
    words = other.status.split()
    tau = float(words[1])
    inverse = np.linalg.inv(other.p)
    expected = tau * np.trace(inverse)
    assert value == pytest.approx(expected, rel=1e-2)


def plant_of(posed: Problem) -> StateSpace:
    """The problem's states and inputs, with an output."""
    c = np.ones((1, 3))
    d = np.zeros((1, 1))
    return StateSpace(a=posed.a, b=posed.b, c=c, d=d)


def test_theorem_one_as_printed_has_a_y_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    posed = problem(1)
    solutions: list[Solution] = []
    solve = CompiledLmi.solve

    def solve_and_note(self: CompiledLmi, *arguments: object) -> Solution:
        solution = solve(self, *arguments)
        solutions.append(solution)
        return solution

    monkeypatch.setattr(lmi.CompiledLmi, "solve", solve_and_note)
    linear = plant_of(posed)
    certificate = certificate_from_paper_lmi(linear, posed.ball, posed.rate)
    assert certificate.certified
    (solution,) = solutions
    difference = np.abs(solution.y - solution.p)
    largest_difference = difference.max()
    largest = np.abs(solution.p).max()
    lower_limit = 1e-3 * largest
    assert largest_difference > lower_limit


def test_the_inequality_is_solved_with_y_equal_to_p_unless_asked_otherwise() -> None:
    """A third of the unknowns, and nothing lost."""
    posed = problem(1)
    linear = plant_of(posed)
    rates = {"rate_controller": 0.1, "rate_observer": 0.1}
    cases = (({}, True), ({"full": True}, False))
    for options, equal in cases:
        lmi_synthesis = LmiSynthesis(**rates, **options)
        part = lmi_synthesis.state_feedback(linear, posed.ball)
        assert isinstance(part, StateFeedback)
        assert part.certified
        assert np.array_equal(part.p, part.y) is equal


SEEDS = (102, 108, 176, 335, 503)


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

    identity = np.eye(7)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        a = rng.normal(size=(7, 7))
        eigenvalues = np.linalg.eigvals(a)
        for modulus in np.abs(eigenvalues):
            actual = split(a, float(modulus))
            np.testing.assert_allclose(actual, identity, atol=1e-6)


def test_the_energy_root_is_a_root_of_the_energy_and_there_is_none_out_of_reach() -> None:
    """`W = A^-1 (W + B B^T) A^-T`; two modes that one input moves alike, and one that it does not
    move at all."""
    a = np.array([[1.3, 0.2], [-0.1, 2.0]])
    b = np.array([[1.0], [0.5]])
    root = inverse_time_gramian_root(a, b)
    inverse = np.linalg.inv(a)
    w = root @ root.T
    driven = w + b @ b.T
    expected = inverse @ driven @ inverse.T
    np.testing.assert_allclose(w, expected, rtol=1e-12)
    expected = np.tril(root)
    np.testing.assert_array_equal(root, expected)
    two_modes = np.diag([2.0, 3.0])
    first_mode_only = np.array([[1.0], [0.0]])
    words = "out of the input's reach"
    with pytest.raises(NoSolution, match=words):
        inverse_time_gramian_root(two_modes, first_mode_only)
    no_input = np.zeros((2, 1))
    with pytest.raises(NoSolution, match=words):
        inverse_time_gramian_root(two_modes, no_input)
