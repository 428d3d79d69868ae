"""The steps between a method's matrices and a stored claim, each against a fault that would let it
pass."""

import copy
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_study import exact
from ssm_study.certificates.certificate import Design, Infeasible, StateFeedback, certificate_digest
from ssm_study.certificates.frontier import Frontier, contraction_frontier
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.certificates.theorem import scale_to_unit_diagonal, smallest_eigenvalue
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.design import DesignAttempt, failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis, guaranteed_cost
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

INPUT_BALL = JacobianBall.from_slopes(0.3, 1.0)
OUTPUT_BALL = JacobianBall.from_slopes(0.8, 1.2)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)
A = np.array([[0.95, 0.1], [-0.1, 0.9]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.5]])
D = np.zeros((1, 1))
PLANT = StateSpace(a=A, b=B, c=C, d=D)


class Model:
    linear = PLANT


def designed(rate: float = 0.3) -> Design:
    riccati_synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=0.3)
    return riccati_synthesis.design(Model(), BALLS)


def stored(rate: float) -> dict:
    content = designed(rate).to_json()
    text = json.dumps(content)
    return json.loads(text)


def frontier_of_plant() -> Frontier:
    return contraction_frontier(PLANT.a, PLANT.b, BALLS.input)


def test_an_attempt_without_matrices_is_followed_by_the_next() -> None:
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    problem = riccati_synthesis.problem(PLANT, BALLS.input)
    ball_and_frontier = {"ball": BALLS.input, "frontier": frontier_of_plant()}
    bookkeeping = {"method": "any", "started": 0.0}
    request = DesignAttempt(
        theorem=StateFeedbackOfBall, rate=0.3, **ball_and_frontier, **bookkeeping
    )

    def nothing() -> Solution:
        raise NoSolution("nothing")

    methods = [nothing, lambda: guaranteed_cost(problem)]
    part = request.first_certified_solution(problem, methods)
    assert isinstance(part, StateFeedback)
    assert part.certified


def test_margins_are_of_a_unit_diagonal() -> None:
    matrix = np.array([[4.0, 1.0], [1.0, 9.0]])
    scaled = scale_to_unit_diagonal(matrix)
    correlation = 1 / 6
    expected = [[1, correlation], [correlation, 1]]
    np.testing.assert_allclose(scaled, expected)
    smallest = smallest_eigenvalue(scaled)
    assert smallest == pytest.approx(5 / 6)


def test_what_the_frontier_excludes_is_a_claim_that_holds() -> None:
    content = stored(0.9)
    assert content["state_feedback"]["proved"]
    assert failed_checks(content, PLANT, BALLS) == []
    inside = content["state_feedback"] | {"rate": 0.1}
    digest = certificate_digest(inside)
    content["state_feedback"] = inside | {"digest": digest}
    claims = failed_checks(content, PLANT, BALLS)
    assert any("inside the frontier" in claim for claim in claims)


def test_a_certificate_of_another_order_does_not_fit() -> None:
    a = PLANT.a[:1, :1]
    b = np.ones((1, 1))
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    smaller = StateSpace(a=a, b=b, c=c, d=d)
    content = stored(0.3)
    broken = failed_checks(content, smaller, BALLS)
    for side in ("state_feedback", "observer"):
        assert f"{side}: the matrices do not fit the model" in broken


def test_the_digest_is_of_the_numbers_and_not_of_their_order() -> None:
    part = stored(0.3)["observer"]
    backwards = dict(reversed(part.items()))
    assert certificate_digest(backwards) == part["digest"]


def test_a_malformed_part_says_what_is_wrong_with_it() -> None:
    content = stored(0.3)
    missing = copy.deepcopy(content)
    strange = copy.deepcopy(content)
    del missing["observer"]["eta"]
    strange["observer"]["gain"] = 1.0
    malformed = ((missing, "is missing"), (strange, "is not part of a certificate"))
    for wrong, words in malformed:
        with pytest.raises(BadRequest, match=words):
            Design.from_json(wrong)


WRONG_ENTRIES = {
    "words": str,
    "bools": bool,
    "lists": lambda entry: [entry],
    "huge": lambda _: 10**400,
}
wrong_entries = pytest.mark.parametrize("convert", WRONG_ENTRIES.values(), ids=WRONG_ENTRIES)


@wrong_entries
def test_entries_of_a_matrix_are_numbers(convert: Callable[[float], object]) -> None:
    content = stored(0.3)
    rows = content["observer"]["l"]
    row = rows[0]
    row[0] = convert(row[0])
    words = r"certificate.observer.l .*not a finite matrix"
    with pytest.raises(BadRequest, match=words):
        Design.from_json(content)


def test_a_part_that_does_not_say_whether_it_is_feasible_is_a_certificate() -> None:
    content = stored(0.3)
    del content["observer"]["feasible"]
    observer = Design.from_json(content).observer
    actual = observer.q
    expected = designed().observer.q
    np.testing.assert_array_equal(actual, expected)


def test_a_certificate_that_is_not_a_number_is_not_written(tmp_path: Path) -> None:
    design = designed()
    state_feedback = replace(design.state_feedback, margin=np.nan)
    changed_design = replace(design, state_feedback=state_feedback)
    with pytest.raises(ValueError, match="JSON"):
        changed_design.save(tmp_path / "c.json")


BELOW_HALF = float(np.nextafter(0.5, 0))
ABOVE_HALF = float(np.nextafter(0.5, 1))
EDGE = {"p": 1.0, "y": 1.0, "sigma": BELOW_HALF, "rate": 0.5}


STORED_NUMBERS = [
    ("p", 1.0, 0.0),
    ("sigma", BELOW_HALF, 1.0),
    ("rate", 0.5, 1.0),
    ("y", ABOVE_HALF, 0.0),
]


def scalar_model() -> StateSpace:
    """`x+ = u`, `y = x`."""
    one = np.ones((1, 1))
    zero = np.zeros((1, 1))
    return StateSpace(a=zero, b=one, c=one, d=zero)


def as_stored(state_feedback: StateFeedback) -> dict:
    """A design with this state feedback, as its file holds it."""
    design = replace(designed(), state_feedback=state_feedback)
    text = json.dumps(design.to_json())
    return json.loads(text)


@pytest.mark.parametrize(("name", "start", "towards"), STORED_NUMBERS)
def test_one_unit_in_the_last_place_of_a_stored_number_is_found(
    name: str, start: float, towards: float
) -> None:
    """`x+ = S(u)`, K = 0: definite iff `(1 - rho) p > sigma` and `2 y > p`; every number is its
    last admissible float.

    The digest is written anew and the products still fit: exact arithmetic alone can find it.
    """
    linear = scalar_model()
    zero = linear.a
    one = linear.b
    limit = contraction_frontier(zero, one, BALLS.input).rate_limit
    matrices = {"a": zero, "b": one, "p": one, "y": one, "k": zero, "x": zero}
    scalar = replace(designed().state_feedback, rate_limit=limit, **matrices)
    content = as_stored(scalar)

    def claims(value: float) -> list[str]:
        part = content["state_feedback"] | EDGE
        part[name] = value
        part["certified_rate"] = part["rate"]
        part["p"] = [[part["p"]]]
        part["y"] = [[part["y"]]]
        digest = certificate_digest(part)
        state_feedback = part | {"digest": digest}
        changed = content | {"state_feedback": state_feedback}
        messages = failed_checks(changed, linear, BALLS)
        return [message for message in messages if message.startswith("state_feedback")]

    away = 0.0 if towards else 2.0
    next_away = float(np.nextafter(start, away))
    assert claims(start) == []
    assert claims(next_away) == []
    next_towards = float(np.nextafter(start, towards))
    (claim,) = claims(next_towards)
    assert "in exact arithmetic the inequality fails" in claim


@pytest.mark.parametrize("rate", [1.0, 1.5, 3.0])
def test_a_rate_of_one_or_more_is_no_certificate_though_the_inequality_may_hold(
    rate: float,
) -> None:
    """With `p < 0` the corner `(1 - rho) p - sigma` is positive, and so are `2 y - p` and sigma."""
    linear = scalar_model()
    zero = linear.a
    one = linear.b
    matrices = {"a": zero, "b": one, "p": -one, "y": zero, "k": zero, "x": zero}
    forged = replace(designed().state_feedback, sigma=0.1, rate=rate, **matrices)
    conditions = StateFeedbackOfBall.exact_conditions(**forged.variables)
    is_definite = exact.is_positive_definite(conditions["inequality"])
    assert is_definite is (rate > 1)
    content = as_stored(forged)
    messages = failed_checks(content, linear, BALLS)
    assert any("state_feedback.certified = True" in message for message in messages)


def test_a_rate_at_the_frontier_is_refused_and_just_below_it_is_not() -> None:
    limit = frontier_of_plant()
    bookkeeping = {"method": "any", "started": 0.0}
    request = DesignAttempt(
        theorem=StateFeedbackOfBall,
        rate=limit.rate_limit,
        ball=BALLS.input,
        frontier=limit,
        **bookkeeping,
    )
    refused = request.infeasible_beyond_limit()
    assert isinstance(refused, Infeasible)
    assert refused.proved
    rate = float(np.nextafter(limit.rate_limit, 0))
    changed_request = replace(request, rate=rate)
    assert changed_request.infeasible_beyond_limit() is None


OUTSIDE_RATES = [("rate", 0.0), ("rate", 1.0), ("rate", 1.5)]
OUTSIDE_WEIGHTS = [("input_weight", 0.0), ("input_weight", -1.0)]
OUTSIDE = [*OUTSIDE_RATES, *OUTSIDE_WEIGHTS]


@pytest.mark.parametrize(("name", "value"), OUTSIDE)
def test_a_problem_outside_its_hypotheses(name: str, value: float) -> None:
    numbers = {"rate": 0.1, "input_weight": 1.0, name: value}
    state_weight = np.eye(2)
    a = PLANT.a
    b = PLANT.b
    with pytest.raises(BadRequest, match=name):
        Problem(a=a, b=b, ball=BALLS.input, state_weight=state_weight, **numbers)


def test_the_margin_is_that_of_the_exact_inequality() -> None:
    """The smallest eigenvalue of what exact arithmetic decides on, rounded afterwards; Y is not P
    here."""
    part = designed().state_feedback
    change = np.array([[1.0, 0.1], [0.0, 1.2]])
    y = part.y @ change
    numbers = part.variables | {"y": y}
    theorem = type(part)
    in_floats = theorem.float_conditions(**numbers)["inequality"]
    exactly = theorem.exact_conditions(**numbers)["inequality"]
    expected = scale_to_unit_diagonal(exactly.to_floats())
    np.testing.assert_allclose(in_floats, expected, atol=1e-13)
    outcome = {"method": "", "status": "", "rate_limit": 1.0, "started": 0.0}
    margin = theorem.from_numbers(numbers, **outcome).margin
    assert margin == smallest_eigenvalue(in_floats)


def test_what_stands_beside_the_matrices() -> None:
    """Gain norm and seconds, each against its definition."""
    started = time.perf_counter()
    feedback = designed().state_feedback
    observer = designed().observer
    beyond = designed(0.9).state_feedback
    elapsed = time.perf_counter() - started
    entries = feedback.k**2
    expected = np.sqrt(entries.sum())
    assert feedback.gain_norm == pytest.approx(expected)  # one row: its Euclidean length
    entries = observer.l**2
    expected = np.sqrt(entries.sum())
    assert observer.gain_norm == pytest.approx(expected)
    seconds = [part.seconds for part in (feedback, observer, beyond)]
    assert min(seconds) >= 0
    assert max(seconds) <= elapsed
