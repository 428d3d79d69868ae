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
from ssm_study.certificates.frontier import contraction_frontier, largest_uncontrollable_modulus
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
BALLS = Balls(input=JacobianBall.from_slopes(0.3, 1.0), output=JacobianBall.from_slopes(0.8, 1.2))


def system(a: list[list[float]], b: list[float], c: list[float]) -> StateSpace:
    columns = np.array(b)[:, None], np.array(c)[None, :]
    d = np.zeros((1, 1))
    return StateSpace(a=np.array(a), b=columns[0], c=columns[1], d=d)


PLANT = system([[0.95, 0.1], [-0.1, 0.9]], [0.0, 1.0], [1.0, 0.5])


class Model:
    linear = PLANT


@pytest.fixture(scope="module")
def stored() -> dict:
    riccati_synthesis = RiccatiSynthesis(**RATES)
    text = json.dumps(riccati_synthesis.design(Model(), BALLS).to_json())
    return json.loads(text)


def test_an_untouched_certificate_has_no_broken_claim(stored: dict) -> None:
    assert failed_checks(stored, PLANT, BALLS) == []


MATRICES = [("state_feedback", name) for name in "abpyxk"] + [
    ("observer", name) for name in "acquvl"
]


@given(st.sampled_from(MATRICES), st.integers(0, 99), st.sampled_from([1e-15, -1e-9, 1e-3, 2.0]))
def test_any_tampering_with_any_matrix_is_found(
    stored: dict, where: tuple[str, str], entry: int, share: float
) -> None:
    content = copy.deepcopy(stored)
    rows = content[where[0]][where[1]]
    i, j = divmod(entry % (len(rows) * len(rows[0])), len(rows[0]))
    rows[i][j] = rows[i][j] * (1 + share) if rows[i][j] else share
    claims = failed_checks(content, PLANT, BALLS)
    assert any(claim.startswith(where[0]) for claim in claims)


def test_the_digest_covers_every_field(stored: dict) -> None:
    for side, part in stored.items():
        assert part["digest"] == certificate_digest(part)
        for name in part.keys() - {"digest"}:
            assert certificate_digest(part | {name: "altered"}) != part["digest"], f"{side}.{name}"


@pytest.mark.parametrize("name", ["alpha", "beta", "rate", "sigma", "rate_limit"])
def test_any_tampering_with_a_number_is_found(stored: dict, name: str) -> None:
    content = copy.deepcopy(stored)
    content["state_feedback"][name] *= 1 + 1e-6
    assert failed_checks(content, PLANT, BALLS)


def test_a_forged_digest_does_not_help_where_the_inequality_fails(stored: dict) -> None:
    content = copy.deepcopy(stored)
    content["state_feedback"]["rate"] = 0.9
    content["state_feedback"]["digest"] = certificate_digest(content["state_feedback"])
    claims = failed_checks(content, PLANT, BALLS)
    assert any("in exact arithmetic the inequality fails" in claim for claim in claims)


@pytest.mark.parametrize(
    ("side", "name"),
    [("state_feedback", n) for n in ("k", "y", "x")] + [("observer", n) for n in ("l", "u", "v")],
)
def test_a_forged_digest_does_not_hide_an_altered_gain(stored: dict, side: str, name: str) -> None:
    """The inequality still holds after so small a change, but the products no longer fit."""
    content = copy.deepcopy(stored)
    content[side][name][0][0] *= 1 + 1e-9
    content[side]["digest"] = certificate_digest(content[side])
    claims = failed_checks(content, PLANT, BALLS)
    assert any("differs from what" in claim for claim in claims)


def test_an_indefinite_matrix_whose_rounded_picture_is_definite() -> None:
    """Determinant about `-0.375 2^-53`; in floats the matrix reads `[[1, 1], [1, 1 + 2^-52]]`,
    which is definite."""
    one = 2**57
    off = 2**57 + 15
    last = 2**57 + 3 * 2**3
    assert np.linalg.cholesky(np.array([[1.0, 1.0], [1.0, 1 + 2.0**-52]]))[1, 1] > 0
    rational = fmpq_mat([[one, off], [off, last]])
    matrix = Exact(rational)
    assert not exact.is_positive_definite(matrix)
    rational = fmpq_mat([[one, off], [off, last + 2**4]])
    matrix = Exact(rational)
    assert exact.is_positive_definite(matrix)


def test_one_unit_in_the_last_place_decides() -> None:
    """`P = [[1, p], [p, 1]]` with p one ulp below one is positive definite; at one it is not."""
    below = np.nextafter(1.0, 0.0)
    matrix = Exact.from_floats(np.array([[1.0, below], [below, 1.0]]))
    assert exact.is_positive_definite(matrix)
    matrix = Exact.from_floats(np.array([[1.0, 1.0], [1.0, 1.0]]))
    assert not exact.is_positive_definite(matrix)
    matrix = Exact.from_floats(np.array([[1.0, below], [1.0, 1.0]]))
    assert not exact.is_positive_definite(matrix)  # not symmetric


def test_a_scalar_certificate_at_the_last_representable_sigma() -> None:
    """`a = 0, b = 1, beta = 0`: the inequality is `(1-rho) p > sigma`; equality is refused, one ulp
    less is not."""
    one = np.ones((1, 1))
    for sigma, verdict in ((0.5, False), (np.nextafter(0.5, 0.0), True)):
        numbers = {"a": 0 * one, "b": one, "k": 0 * one, "p": one, "y": one, "sigma": float(sigma)}
        state_feedback_of_ball = StateFeedbackOfBall.holds(**numbers, alpha=1.0, beta=0.0, rate=0.5)
        assert state_feedback_of_ball is verdict


def test_a_ball_smaller_than_the_models_is_found(stored: dict) -> None:
    jacobian_ball = JacobianBall.from_slopes(0.29, 1.0)
    wider = Balls(input=jacobian_ball, output=BALLS.output)
    claims = failed_checks(stored, PLANT, wider)
    assert any("alpha, beta" in claim for claim in claims)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda c: c.pop("observer"), "observer"),
        (lambda c: c["observer"].pop("q"), "q"),
        (lambda c: c["observer"].update(q=[[1.0, "x"], [0.0, 1.0]]), "q"),
        (lambda c: c["observer"].update(q=[[1.0], [0.0, 1.0]]), "q"),
        (lambda c: c["observer"].update(eta=float("nan")), "eta"),
        (lambda c: c["observer"]["l"].pop(), r"observer\.l \(shape\)"),
        (lambda c: c["observer"].update(extra=1.0), "extra"),
    ],
)
def test_a_malformed_certificate_is_one_sentence(stored: dict, change, field: str) -> None:
    content = copy.deepcopy(stored)
    change(content)
    with pytest.raises(BadRequest, match=field):
        Design.from_json(content)
    assert len(failed_checks(content, PLANT, BALLS)) == 1


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
    riccati_synthesis = RiccatiSynthesis(**RATES)
    jacobian_ball = JacobianBall.from_slopes(-0.1, 1.0)
    part = riccati_synthesis.state_feedback(PLANT, jacobian_ball)
    assert isinstance(part, Infeasible)
    assert part.proved
    expected = 1 - PLANT.spectral_radius**2
    assert part.rate_limit == pytest.approx(expected)
    assert "include zero" in part.reason
    state_weight = np.eye(2)
    weights = {"rate": 0.1, "state_weight": state_weight, "input_weight": 1.0}
    for lower in (0.0, -0.5):
        ball = JacobianBall.from_slopes(lower, 1.0)
        riccati_synthesis = RiccatiSynthesis(**RATES)
        problem = Problem(a=PLANT.a, b=PLANT.b, ball=ball, **weights)
        with pytest.raises(NoSolution, match="include zero"):
            riccati_synthesis.solve(problem)


def test_an_uncontrollable_unstable_mode_is_refused_by_its_modulus() -> None:
    plant = system([[1.2, 0.0], [0.3, 0.5]], [0.0, 1.0], [1.0, 1.0])
    riccati_synthesis = RiccatiSynthesis(**RATES)
    part = riccati_synthesis.state_feedback(plant, BALLS.input)
    assert isinstance(part, Infeasible)
    expected = 1 - 1.2**2
    assert part.rate_limit == pytest.approx(expected)
    assert "a mode of modulus 1.2 is not stable and the input does not reach it" in part.reason
    assert ratio_limit(plant.a, plant.b, 0.9) == 0.0


def test_an_unobservable_slow_mode_is_refused_by_its_modulus() -> None:
    plant = system([[0.9, 0.0], [0.0, 0.5]], [1.0, 1.0], [0.0, 1.0])
    riccati_synthesis = RiccatiSynthesis(**RATES)
    part = riccati_synthesis.observer(plant, BALLS.output)
    assert isinstance(part, Infeasible)
    expected = 1 - 0.9**2
    assert part.rate_limit == pytest.approx(expected)


@pytest.mark.parametrize(
    ("lower", "limit", "by"), [(0.1, 1.2 * 9 / 11, "the slopes"), (0.2, 0.9, "a mode out of reach")]
)
def test_what_sets_the_limit_of_several_inputs_is_named(
    lower: float, limit: float, by: str
) -> None:
    """One mode at 0.9 that no input reaches; each of two inputs holds a mode at 1.2, down to `1.2
    beta/alpha`."""
    b = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    a = np.diag([0.9, 1.2, 1.2])
    ball = JacobianBall.from_slopes(lower, 1.0)
    found = contraction_frontier(a, b, ball)
    assert found.contraction_limit == pytest.approx(limit)
    assert found.decided_by == by


def test_a_repeated_mode_one_input_cannot_split_counts_as_out_of_reach() -> None:
    plant = system([[0.9, 0.0], [0.0, 0.9]], [1.0, 2.0], [1.0, 1.0])
    assert largest_uncontrollable_modulus(plant.a, plant.b) == pytest.approx(0.9)


@pytest.mark.parametrize("unit", [1e-15, 1e-6, 1.0, 1e6, 1e15])
def test_what_is_out_of_reach_does_not_hang_on_the_inputs_unit(unit: float) -> None:
    reached = system([[0.9, 0.1], [0.0, 0.5]], [1.0, 2.0], [1.0, 1.0])
    split = np.array([[unit], [0.0]])
    b = unit * reached.b
    assert largest_uncontrollable_modulus(reached.a, b) == 0
    a = np.diag([0.9, 0.5])
    assert largest_uncontrollable_modulus(a, split) == pytest.approx(0.5)
    a = np.diag([0.9, 0.9])
    assert largest_uncontrollable_modulus(a, split) == pytest.approx(0.9)


def clustered(order: int) -> StateSpace:
    """Modes a thousandth apart under one input: the gain that moves them all is lost in
    rounding."""
    return system(np.diag(0.9 + 1e-3 * np.arange(order)).tolist(), [1.0] * order, [1.0] * order)


def test_an_ill_conditioned_model_is_refused_with_the_number_that_decides() -> None:
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.2, rate_observer=0.3)
    part = riccati_synthesis.state_feedback(clustered(12), JacobianBall.from_slopes(0.8, 1.0))
    assert isinstance(part, Infeasible)
    assert not part.proved
    assert 0.4 < part.rate_limit < 0.5
    assert float(part.reason.split("condition number is ")[1].split(";")[0]) > 1e15
    assert "truncate_to" in part.reason


def test_the_same_model_with_fewer_states_is_certified() -> None:
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.2, rate_observer=0.3)
    part = riccati_synthesis.state_feedback(clustered(3), JacobianBall.from_slopes(0.8, 1.0))
    assert part.certified


def test_a_near_miss_is_handed_on_as_found_and_says_that_it_is_not_certified() -> None:
    """Far beyond the frontier the method's matrices are no certificate, whatever its status
    says."""
    ball = BALLS.input
    riccati_synthesis = RiccatiSynthesis(**RATES)
    problem = riccati_synthesis.problem(PLANT, ball)
    design_attempt_frontier = contraction_frontier(PLANT.a, PLANT.b, ball)
    started = time.perf_counter()
    request = DesignAttempt(
        theorem=StateFeedbackOfBall,
        rate=problem.rate,
        ball=ball,
        frontier=design_attempt_frontier,
        method="any",
        started=started,
    )
    p = np.eye(2)
    y = np.eye(2)
    k = np.zeros((1, 2))
    wrong = Solution(p=p, y=y, k=k, sigma=1.0, status="solved")
    part = request.first_certified_solution(problem, [lambda: wrong])
    assert isinstance(part, StateFeedback)
    assert not part.certified
    assert part.solver_status.startswith("solved; not positive definite in exact arithmetic")


def test_matrices_that_are_not_finite() -> None:
    a = np.array([[np.nan]])
    b = np.ones((1, 1))
    with pytest.raises(BadRequest, match="a"):
        contraction_frontier(a, b, BALLS.input)


ILL = st.sampled_from([1e-12, 1e-9, 1e-3, 1.0, 1e6])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), ILL, ILL, ILL, ILL, st.sampled_from([1e-9, 0.3, 1 - 1e-12]))
def test_an_ill_request_ends_as_a_result_and_not_as_an_error(
    seed: int, gain: float, slope: float, state: float, effort: float, rate: float
) -> None:
    """Weights, gains and slopes at the edge of floats: a singular matrix ends the attempt and not
    the run."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, 3))
    a = np.diag(rng.choice([0.0, 0.5, 0.9, 1.0, 1.1], size=n))
    b = gain * rng.normal(size=(n, m))
    c = rng.normal(size=(m, n))
    d = np.zeros((m, m))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    ball = JacobianBall(alpha=slope, beta=0.5 * slope)
    weights = {"state_weight": state, "input_weight": effort, "output_noise": effort}
    for method in (RiccatiSynthesis, ClosedFormSynthesis):
        part = method(rate_controller=rate, rate_observer=rate, **weights).state_feedback(
            linear, ball
        )
        assert isinstance(part, Infeasible | StateFeedback)
        if isinstance(part, StateFeedback) and part.certified:
            assert StateFeedbackOfBall.holds(**part.variables)


@pytest.mark.parametrize("inputs", [1, 2])
def test_the_frontier_at_the_modulus_of_a_mode(inputs: int) -> None:
    """A mode on the circle costs no energy: the ratio is that of the modes outside it, from either
    side."""
    a = np.diag([1.2, 0.9, 0.5])
    b = np.array([[1.0, 0.3], [0.7, 1.0], [0.2, 0.4]])[:, :inputs]
    at, below, above = (ratio_limit(a, b, r) for r in (0.9, 0.9 * (1 - 1e-7), 0.9 * (1 + 1e-7)))
    assert below == pytest.approx(at, rel=1e-5)
    assert above == pytest.approx(at, rel=1e-5)
    assert ratio_limit(a, np.zeros_like(b), 0.9) == 0.0


def test_the_frontier_of_modes_that_two_inputs_hardly_tell_apart() -> None:
    """Three at minus one, so nearly uncoupled that each input moves its own: one of them has two,
    which decides."""
    a = np.array(
        [[-1.0, 0.0, 0.0], [3.03608337e-11, -1.0, 0.0], [3.02671280e-10, -4.81049402e-10, -1.0]]
    )
    b = np.array([[0.57466926, -0.3113685], [-0.18975561, 0.30924853], [0.26792832, 0.38736124]])
    jacobian_ball = JacobianBall.from_slopes(1 / 3, 1.0)
    for ball in (BALLS.input, jacobian_ball):
        contraction_limit = contraction_frontier(a, b, ball).contraction_limit
        expected = np.sqrt(ball.relative_radius)
        assert contraction_limit == pytest.approx(expected, abs=1e-6)


def test_slopes_in_the_wrong_order() -> None:
    with pytest.raises(BadRequest, match="slopes"):
        JacobianBall.from_slopes(1.0, 0.5)


def test_exact_arithmetic_takes_no_nan() -> None:
    with pytest.raises((ValueError, OverflowError)):
        Exact.from_floats(np.array([[np.nan]]))
