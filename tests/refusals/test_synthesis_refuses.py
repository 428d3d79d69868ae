"""The refusals of synthesis: requests that no method can meet, and what exact arithmetic says."""

import time

import numpy as np
import pytest
from flint import fmpq_mat
from hypothesis import given, settings
from hypothesis import strategies as st
from synthesis_ratio import ratio_limit

from ssm_study import exact
from ssm_study.certificates.certificate import Infeasible, StateFeedback
from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.exact import ExactMatrix
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.design import DesignAttempt
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

RATES = {"rate_controller": 0.3, "rate_observer": 0.3}
INPUT_BALL = JacobianBall.from_slopes(0.3, 1.0)
OUTPUT_BALL = JacobianBall.from_slopes(0.8, 1.2)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)


def system(a: list[list[float]], b: list[float], c: list[float]) -> StateSpace:
    """A system with one input and one output."""
    column = np.array(b)[:, None]
    row = np.array(c)[None, :]
    feedthrough = np.zeros((1, 1))
    return StateSpace(a=np.array(a), b=column, c=row, d=feedthrough)


FIRST_ROW = [0.95, 0.1]
SECOND_ROW = [-0.1, 0.9]
A = [FIRST_ROW, SECOND_ROW]
INPUT_COLUMN = [0.0, 1.0]
OUTPUT_ROW = [1.0, 0.5]
PLANT = system(A, INPUT_COLUMN, OUTPUT_ROW)


def test_an_indefinite_matrix_whose_rounded_picture_is_definite() -> None:
    """Determinant about `-0.375 2^-53`; in floats the matrix reads `[[1, 1], [1, 1 + 2^-52]]`,
    which is definite."""
    one = 2**57
    off = 2**57 + 15
    small = 3 * 2**3
    last = 2**57 + small
    almost_equal = [1.0, 1 + 2.0**-52]
    rounded_rows = [[1.0, 1.0], almost_equal]
    rounded = np.array(rounded_rows)
    rows = [[one, off], [off, last]]
    indefinite = ExactMatrix(fmpq_mat(rows))
    changed_last_row = [off, last + 2**4]
    changed_rows = [[one, off], changed_last_row]
    definite = ExactMatrix(fmpq_mat(changed_rows))

    cholesky_factor = np.linalg.cholesky(rounded)
    assert cholesky_factor[1, 1] > 0
    assert not exact.is_positive_definite(indefinite)
    assert exact.is_positive_definite(definite)


def test_one_unit_in_the_last_place_decides() -> None:
    """`P = [[1, p], [p, 1]]` with p one ulp below one is positive definite; at one it is not."""
    below = np.nextafter(1.0, 0.0)
    rows_of_definite = [[1.0, below], [below, 1.0]]
    of_definite = np.array(rows_of_definite)
    definite = ExactMatrix.from_floats(of_definite)
    rows_of_singular = [[1.0, 1.0], [1.0, 1.0]]
    of_singular = np.array(rows_of_singular)
    singular = ExactMatrix.from_floats(of_singular)
    rows_of_unsymmetric = [[1.0, below], [1.0, 1.0]]
    of_unsymmetric = np.array(rows_of_unsymmetric)
    unsymmetric = ExactMatrix.from_floats(of_unsymmetric)

    assert exact.is_positive_definite(definite)
    assert not exact.is_positive_definite(singular)
    assert not exact.is_positive_definite(unsymmetric)


ONE_LESS = np.nextafter(0.5, 0.0)
SIGMAS = [(0.5, False), (ONE_LESS, True)]


@pytest.mark.parametrize(("sigma", "holds"), SIGMAS)
def test_a_scalar_certificate_at_the_last_representable_sigma(sigma: float, holds: bool) -> None:
    """`a = 0, b = 1, beta = 0`: the inequality is `(1-rho) p > sigma`; equality is refused, one ulp
    less is not."""
    shape = (1, 1)
    one = np.ones(shape)
    zero = np.zeros(shape)
    matrices = {"a": zero, "b": one, "k": zero, "p": one, "y": one}
    numbers = {"sigma": float(sigma), "alpha": 1.0, "beta": 0.0, "rate": 0.5}
    holds_exactly = StateFeedbackOfBall.holds(**matrices, **numbers)
    assert holds_exactly is holds


NAMES_OF_RATES = ["rate_controller", "rate_observer"]
RATES_OUTSIDE = [0.0, 1.0, -0.1, float("nan")]


@pytest.mark.parametrize("name", NAMES_OF_RATES)
@pytest.mark.parametrize("rate", RATES_OUTSIDE)
def test_a_rate_outside_the_unit_interval(name: str, rate: float) -> None:
    settings_of_rates = RATES | {name: rate}
    with pytest.raises(BadRequest, match=name):
        RiccatiSynthesis(**settings_of_rates)


NAMES_OF_WEIGHTS = ["state_weight", "input_weight", "state_noise", "output_noise"]


@pytest.mark.parametrize("name", NAMES_OF_WEIGHTS)
def test_weights_must_be_positive(name: str) -> None:
    with pytest.raises(BadRequest, match=name):
        RiccatiSynthesis(**RATES, **{name: 0.0})


UNKNOWN_CHOICES = [("objective", "fastest"), ("solver", "MOSEK")]


@pytest.mark.parametrize(("name", "value"), UNKNOWN_CHOICES)
def test_unknown_choices_of_the_lmi(name: str, value: str) -> None:
    with pytest.raises(BadRequest, match=name):
        LmiSynthesis(**RATES, **{name: value})


def test_slopes_that_include_zero_are_refused_with_the_open_loops_rate() -> None:
    synthesis = RiccatiSynthesis(**RATES)
    ball = JacobianBall.from_slopes(-0.1, 1.0)

    part = synthesis.state_feedback(PLANT, ball)

    assert isinstance(part, Infeasible)
    assert part.proved
    open_loop_rate = 1 - PLANT.spectral_radius**2
    expected = pytest.approx(open_loop_rate)
    assert part.rate_limit == expected
    assert "include zero" in part.reason


@pytest.mark.parametrize("lower", [0.0, -0.5])
def test_the_equation_itself_refuses_slopes_that_include_zero(lower: float) -> None:
    ball = JacobianBall.from_slopes(lower, 1.0)
    state_weight = np.eye(2)
    weights = {"rate": 0.1, "state_weight": state_weight, "input_weight": 1.0}
    problem = Problem(a=PLANT.a, b=PLANT.b, ball=ball, **weights)
    synthesis = RiccatiSynthesis(**RATES)
    with pytest.raises(NoSolution, match="include zero"):
        synthesis.solve(problem)


def test_an_uncontrollable_unstable_mode_is_refused_by_its_modulus() -> None:
    matrix = [[1.2, 0.0], [0.3, 0.5]]
    input_column = [0.0, 1.0]
    output_row = [1.0, 1.0]
    plant = system(matrix, input_column, output_row)
    synthesis = RiccatiSynthesis(**RATES)

    part = synthesis.state_feedback(plant, INPUT_BALL)

    assert isinstance(part, Infeasible)
    rate_of_the_mode = 1 - 1.2**2
    expected = pytest.approx(rate_of_the_mode)
    assert part.rate_limit == expected
    assert "a mode of modulus 1.2 is not stable and the input does not reach it" in part.reason
    largest_ratio = ratio_limit(plant.a, plant.b, 0.9)
    assert largest_ratio == 0.0


def test_an_unobservable_slow_mode_is_refused_by_its_modulus() -> None:
    matrix = [[0.9, 0.0], [0.0, 0.5]]
    input_column = [1.0, 1.0]
    output_row = [0.0, 1.0]
    plant = system(matrix, input_column, output_row)
    synthesis = RiccatiSynthesis(**RATES)

    part = synthesis.observer(plant, OUTPUT_BALL)

    assert isinstance(part, Infeasible)
    rate_of_the_mode = 1 - 0.9**2
    expected = pytest.approx(rate_of_the_mode)
    assert part.rate_limit == expected


def clustered(order: int) -> StateSpace:
    """Modes a thousandth apart under one input: the gain that moves them all is lost in
    rounding."""
    numbers = np.arange(order)
    modes = 0.9 + 1e-3 * numbers
    ones = [1.0] * order
    dynamics = np.diag(modes)
    a = dynamics.tolist()
    return system(a, ones, ones)


def attempt_on_clustered_modes(order: int) -> StateFeedback | Infeasible:
    synthesis = RiccatiSynthesis(rate_controller=0.2, rate_observer=0.3)
    ball = JacobianBall.from_slopes(0.8, 1.0)
    return synthesis.state_feedback(clustered(order), ball)


def test_an_ill_conditioned_model_is_refused_with_the_number_that_decides() -> None:
    part = attempt_on_clustered_modes(12)

    assert isinstance(part, Infeasible)
    assert not part.proved
    assert 0.4 < part.rate_limit < 0.5
    parts_of_the_reason = part.reason.split("condition number is ")
    words = parts_of_the_reason[1]
    number_and_rest = words.split(";")
    condition_number = float(number_and_rest[0])
    assert condition_number > 1e15
    assert "truncate_to" in part.reason


def test_the_same_model_with_fewer_states_is_certified() -> None:
    part = attempt_on_clustered_modes(3)
    assert part.certified


def test_a_near_miss_is_handed_on_as_found_and_says_that_it_is_not_certified() -> None:
    """Far beyond the frontier the method's matrices are no certificate, whatever its status
    says."""
    synthesis = RiccatiSynthesis(**RATES)
    problem = synthesis.problem(PLANT, INPUT_BALL)
    frontier = contraction_frontier(PLANT.a, PLANT.b, INPUT_BALL)
    started = time.perf_counter()
    attempt = DesignAttempt(
        theorem=StateFeedbackOfBall,
        rate=problem.rate,
        ball=INPUT_BALL,
        frontier=frontier,
        method="any",
        started=started,
    )
    identity = np.eye(2)
    no_gain = np.zeros((1, 2))
    near_miss = Solution(p=identity, y=identity, k=no_gain, sigma=1.0, status="solved")

    methods = [lambda: near_miss]
    part = attempt.first_certified_solution(problem, methods)

    assert isinstance(part, StateFeedback)
    assert not part.certified
    assert part.solver_status.startswith("solved; not positive definite in exact arithmetic")


ILL_NUMBERS = [1e-12, 1e-9, 1e-3, 1.0, 1e6]
ILL = st.sampled_from(ILL_NUMBERS)


RATES_AT_THE_EDGE = [1e-9, 0.3, 1 - 1e-12]
RATE = st.sampled_from(RATES_AT_THE_EDGE)


SEEDS = st.integers(0, 10**6)


@settings(max_examples=25, deadline=None)
@given(SEEDS, ILL, ILL, ILL, ILL, RATE)
def test_an_ill_request_ends_as_a_result_and_not_as_an_error(
    seed: int, gain: float, slope: float, state: float, effort: float, rate: float
) -> None:
    """Weights, gains and slopes at the edge of floats: a singular matrix ends the attempt and not
    the run."""
    rng = np.random.default_rng(seed)
    drawn_order = rng.integers(1, 5)
    n = int(drawn_order)
    drawn_inputs = rng.integers(1, 3)
    m = int(drawn_inputs)
    choices = [0.0, 0.5, 0.9, 1.0, 1.1]
    moduli = rng.choice(choices, size=n)
    a = np.diag(moduli)
    b = gain * rng.normal(size=(n, m))
    c = rng.normal(size=(m, n))
    d = np.zeros((m, m))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    ball = JacobianBall(alpha=slope, beta=0.5 * slope)
    weights = {"state_weight": state, "input_weight": effort, "output_noise": effort}
    for method in (RiccatiSynthesis, ClosedFormSynthesis):
        synthesis = method(rate_controller=rate, rate_observer=rate, **weights)
        part = synthesis.state_feedback(linear, ball)
        assert isinstance(part, Infeasible | StateFeedback)
        is_certified = isinstance(part, StateFeedback) and part.certified
        if is_certified:
            assert StateFeedbackOfBall.holds(**part.variables)


def test_slopes_in_the_wrong_order() -> None:
    with pytest.raises(BadRequest, match="slopes"):
        JacobianBall.from_slopes(1.0, 0.5)


def test_exact_arithmetic_takes_no_nan() -> None:
    row = [np.nan]
    matrix = np.array([row])
    with pytest.raises((ValueError, OverflowError)):
        ExactMatrix.from_floats(matrix)
