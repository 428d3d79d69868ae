"""The refusals of synthesis, and tampering that verification must find."""

import copy
import json
import time

import numpy as np
import pytest
from flint import fmpq_mat
from hypothesis import given, settings
from hypothesis import strategies as st
from synthesis_ratio import ratio_limit

from ssm_study import exact
from ssm_study.certificates.certificate import Design, Infeasible, StateFeedback, certificate_digest
from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.exact import Exact
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.design import DesignAttempt, failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import Balls, JacobianBall, StateSpace

RATES = {"rate_controller": 0.3, "rate_observer": 0.3}
INPUT_BALL = JacobianBall.from_slopes(0.3, 1.0)
OUTPUT_BALL = JacobianBall.from_slopes(0.8, 1.2)
BALLS = Balls(input=INPUT_BALL, output=OUTPUT_BALL)


def system(a: list[list[float]], b: list[float], c: list[float]) -> StateSpace:
    """A system with one input and one output."""
    column = np.array(b)[:, None]
    row = np.array(c)[None, :]
    feedthrough = np.zeros((1, 1))
    return StateSpace(a=np.array(a), b=column, c=row, d=feedthrough)


A = [[0.95, 0.1], [-0.1, 0.9]]
PLANT = system(A, [0.0, 1.0], [1.0, 0.5])


class Model:
    linear = PLANT


@pytest.fixture(scope="module")
def stored() -> dict:
    synthesis = RiccatiSynthesis(**RATES)
    design = synthesis.design(Model(), BALLS)
    return json.loads(json.dumps(design.to_json()))


def test_an_untouched_certificate_has_no_broken_claim(stored: dict) -> None:
    assert failed_checks(stored, PLANT, BALLS) == []


MATRICES = [
    *(("state_feedback", name) for name in "abpyxk"),
    *(("observer", name) for name in "acquvl"),
]
SHARES = [1e-15, -1e-9, 1e-3, 2.0]


MATRIX = st.sampled_from(MATRICES)
SHARE = st.sampled_from(SHARES)


@given(MATRIX, st.integers(0, 99), SHARE)
def test_any_tampering_with_any_matrix_is_found(
    stored: dict, where: tuple[str, str], entry: int, share: float
) -> None:
    side, name = where
    content = copy.deepcopy(stored)
    rows = content[side][name]
    columns = len(rows[0])
    i, j = divmod(entry % (len(rows) * columns), columns)
    rows[i][j] = rows[i][j] * (1 + share) if rows[i][j] else share

    claims = failed_checks(content, PLANT, BALLS)

    assert any(claim.startswith(side) for claim in claims)


def test_the_digest_covers_every_field(stored: dict) -> None:
    for side, part in stored.items():
        assert part["digest"] == certificate_digest(part)
        for name in part.keys() - {"digest"}:
            digest_of_altered = certificate_digest(part | {name: "altered"})
            assert digest_of_altered != part["digest"], f"{side}.{name}"


@pytest.mark.parametrize("name", ["alpha", "beta", "rate", "sigma", "rate_limit"])
def test_any_tampering_with_a_number_is_found(stored: dict, name: str) -> None:
    content = copy.deepcopy(stored)
    content["state_feedback"][name] *= 1 + 1e-6
    assert failed_checks(content, PLANT, BALLS)


def test_a_forged_digest_does_not_help_where_the_inequality_fails(stored: dict) -> None:
    content = copy.deepcopy(stored)
    state_feedback = content["state_feedback"]
    state_feedback["rate"] = 0.9
    state_feedback["digest"] = certificate_digest(state_feedback)

    claims = failed_checks(content, PLANT, BALLS)

    assert any("in exact arithmetic the inequality fails" in claim for claim in claims)


GAINS = [
    *(("state_feedback", name) for name in ("k", "y", "x")),
    *(("observer", name) for name in ("l", "u", "v")),
]


@pytest.mark.parametrize(("side", "name"), GAINS)
def test_a_forged_digest_does_not_hide_an_altered_gain(stored: dict, side: str, name: str) -> None:
    """The inequality still holds after so small a change, but the products no longer fit."""
    content = copy.deepcopy(stored)
    part = content[side]
    part[name][0][0] *= 1 + 1e-9
    part["digest"] = certificate_digest(part)

    claims = failed_checks(content, PLANT, BALLS)

    assert any("differs from what" in claim for claim in claims)


def test_an_indefinite_matrix_whose_rounded_picture_is_definite() -> None:
    """Determinant about `-0.375 2^-53`; in floats the matrix reads `[[1, 1], [1, 1 + 2^-52]]`,
    which is definite."""
    one = 2**57
    off = 2**57 + 15
    last = 2**57 + 3 * 2**3
    almost_equal = [1.0, 1 + 2.0**-52]
    rounded = np.array([[1.0, 1.0], almost_equal])
    rows = [[one, off], [off, last]]
    indefinite = Exact(fmpq_mat(rows))
    changed_rows = [[one, off], [off, last + 2**4]]
    definite = Exact(fmpq_mat(changed_rows))

    assert np.linalg.cholesky(rounded)[1, 1] > 0
    assert not exact.is_positive_definite(indefinite)
    assert exact.is_positive_definite(definite)


def test_one_unit_in_the_last_place_decides() -> None:
    """`P = [[1, p], [p, 1]]` with p one ulp below one is positive definite; at one it is not."""
    below = np.nextafter(1.0, 0.0)
    of_definite = np.array([[1.0, below], [below, 1.0]])
    definite = Exact.from_floats(of_definite)
    of_singular = np.array([[1.0, 1.0], [1.0, 1.0]])
    singular = Exact.from_floats(of_singular)
    of_unsymmetric = np.array([[1.0, below], [1.0, 1.0]])
    unsymmetric = Exact.from_floats(of_unsymmetric)

    assert exact.is_positive_definite(definite)
    assert not exact.is_positive_definite(singular)
    assert not exact.is_positive_definite(unsymmetric)


@pytest.mark.parametrize(("sigma", "holds"), [(0.5, False), (np.nextafter(0.5, 0.0), True)])
def test_a_scalar_certificate_at_the_last_representable_sigma(sigma: float, holds: bool) -> None:
    """`a = 0, b = 1, beta = 0`: the inequality is `(1-rho) p > sigma`; equality is refused, one ulp
    less is not."""
    one = np.ones((1, 1))
    zero = np.zeros((1, 1))
    matrices = {"a": zero, "b": one, "k": zero, "p": one, "y": one}
    numbers = {"sigma": float(sigma), "alpha": 1.0, "beta": 0.0, "rate": 0.5}
    assert StateFeedbackOfBall.holds(**matrices, **numbers) is holds


def test_a_ball_smaller_than_the_models_is_found(stored: dict) -> None:
    wider_ball = JacobianBall.from_slopes(0.29, 1.0)
    wider = Balls(input=wider_ball, output=OUTPUT_BALL)
    claims = failed_checks(stored, PLANT, wider)
    assert any("alpha, beta" in claim for claim in claims)


MALFORMED = [
    (lambda c: c.pop("observer"), "observer"),
    (lambda c: c["observer"].pop("q"), "q"),
    (lambda c: c["observer"].update(q=[[1.0, "x"], [0.0, 1.0]]), "q"),
    (lambda c: c["observer"].update(q=[[1.0], [0.0, 1.0]]), "q"),
    (lambda c: c["observer"].update(eta=float("nan")), "eta"),
    (lambda c: c["observer"]["l"].pop(), r"observer\.l \(shape\)"),
    (lambda c: c["observer"].update(extra=1.0), "extra"),
]


@pytest.mark.parametrize(("change", "field"), MALFORMED)
def test_a_malformed_certificate_is_one_sentence(stored: dict, change, field: str) -> None:
    content = copy.deepcopy(stored)
    change(content)
    with pytest.raises(BadRequest, match=field):
        Design.from_json(content)
    claims = failed_checks(content, PLANT, BALLS)
    assert len(claims) == 1


@pytest.mark.parametrize("name", ["rate_controller", "rate_observer"])
@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1, float("nan")])
def test_a_rate_outside_the_unit_interval(name: str, rate: float) -> None:
    with pytest.raises(BadRequest, match=name):
        RiccatiSynthesis(**(RATES | {name: rate}))


@pytest.mark.parametrize("name", ["state_weight", "input_weight", "state_noise", "output_noise"])
def test_weights_must_be_positive(name: str) -> None:
    with pytest.raises(BadRequest, match=name):
        RiccatiSynthesis(**RATES, **{name: 0.0})


@pytest.mark.parametrize(("name", "value"), [("objective", "fastest"), ("solver", "MOSEK")])
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
    assert part.rate_limit == pytest.approx(open_loop_rate)
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
    plant = system(matrix, [0.0, 1.0], [1.0, 1.0])
    synthesis = RiccatiSynthesis(**RATES)

    part = synthesis.state_feedback(plant, INPUT_BALL)

    assert isinstance(part, Infeasible)
    rate_of_the_mode = 1 - 1.2**2
    assert part.rate_limit == pytest.approx(rate_of_the_mode)
    assert "a mode of modulus 1.2 is not stable and the input does not reach it" in part.reason
    assert ratio_limit(plant.a, plant.b, 0.9) == 0.0


def test_an_unobservable_slow_mode_is_refused_by_its_modulus() -> None:
    matrix = [[0.9, 0.0], [0.0, 0.5]]
    plant = system(matrix, [1.0, 1.0], [0.0, 1.0])
    synthesis = RiccatiSynthesis(**RATES)

    part = synthesis.observer(plant, OUTPUT_BALL)

    assert isinstance(part, Infeasible)
    rate_of_the_mode = 1 - 0.9**2
    assert part.rate_limit == pytest.approx(rate_of_the_mode)


def clustered(order: int) -> StateSpace:
    """Modes a thousandth apart under one input: the gain that moves them all is lost in
    rounding."""
    modes = 0.9 + 1e-3 * np.arange(order)
    ones = [1.0] * order
    a = np.diag(modes).tolist()
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
    words = part.reason.split("condition number is ")[1]
    condition_number = float(words.split(";")[0])
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
    attempt = DesignAttempt(
        theorem=StateFeedbackOfBall,
        rate=problem.rate,
        ball=INPUT_BALL,
        frontier=contraction_frontier(PLANT.a, PLANT.b, INPUT_BALL),
        method="any",
        started=time.perf_counter(),
    )
    identity = np.eye(2)
    no_gain = np.zeros((1, 2))
    near_miss = Solution(p=identity, y=identity, k=no_gain, sigma=1.0, status="solved")

    part = attempt.first_certified_solution(problem, [lambda: near_miss])

    assert isinstance(part, StateFeedback)
    assert not part.certified
    assert part.solver_status.startswith("solved; not positive definite in exact arithmetic")


ILL = st.sampled_from([1e-12, 1e-9, 1e-3, 1.0, 1e6])


RATE = st.sampled_from([1e-9, 0.3, 1 - 1e-12])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), ILL, ILL, ILL, ILL, RATE)
def test_an_ill_request_ends_as_a_result_and_not_as_an_error(
    seed: int, gain: float, slope: float, state: float, effort: float, rate: float
) -> None:
    """Weights, gains and slopes at the edge of floats: a singular matrix ends the attempt and not
    the run."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, 3))
    moduli = rng.choice([0.0, 0.5, 0.9, 1.0, 1.1], size=n)
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
        if isinstance(part, StateFeedback) and part.certified:
            assert StateFeedbackOfBall.holds(**part.variables)


def test_slopes_in_the_wrong_order() -> None:
    with pytest.raises(BadRequest, match="slopes"):
        JacobianBall.from_slopes(1.0, 0.5)


def test_exact_arithmetic_takes_no_nan() -> None:
    matrix = np.array([[np.nan]])
    with pytest.raises((ValueError, OverflowError)):
        Exact.from_floats(matrix)
