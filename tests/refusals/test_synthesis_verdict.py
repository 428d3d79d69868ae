"""What stands between a method's matrices and a stored claim, each step against a fault that would let it pass."""

import copy
import json

import numpy as np
import pytest

from ssm_study.refusal import BadRequest
from ssm_study.synthesis.certificate import Design, StateFeedback, digest
from ssm_study.synthesis.frontier import frontier
from ssm_study.synthesis.problem import NoSolution, Solution, margin, unit_diagonal
from ssm_study.synthesis.riccati import RiccatiSynthesis, guaranteed_cost
from ssm_study.synthesis.verdict import CONTROLLER, Request
from ssm_study.synthesis.verify import broken_claims
from ssm_study.systems import JacobianBall, StateSpace

BALLS = (JacobianBall.from_slopes(0.3, 1.0), JacobianBall.from_slopes(0.8, 1.2))
PLANT = StateSpace(
    a=np.array([[0.95, 0.1], [-0.1, 0.9]]),
    b=np.array([[0.0], [1.0]]),
    c=np.array([[1.0, 0.5]]),
    d=np.zeros((1, 1)),
)


class Model:
    linear = PLANT


def stored(rate: float) -> dict:
    design = RiccatiSynthesis(rate_controller=rate, rate_observer=0.3).design(Model(), *BALLS)
    return json.loads(json.dumps(design.to_json()))


def test_an_attempt_without_matrices_is_followed_by_the_next() -> None:
    problem = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3).controller_problem(PLANT, BALLS[0])
    limit = frontier(PLANT.a, PLANT.b, BALLS[0])
    request = Request(side=CONTROLLER, rate=0.3, ball=BALLS[0], frontier=limit, method="any", started=0.0)

    def nothing() -> Solution:
        raise NoSolution("nothing")

    part = request.first_certified(problem, [nothing, lambda: guaranteed_cost(problem)])
    assert isinstance(part, StateFeedback)
    assert part.certified


def test_margins_are_of_a_unit_diagonal() -> None:
    matrix = np.array([[4.0, 1.0], [1.0, 9.0]])
    scaled = unit_diagonal(matrix)
    np.testing.assert_allclose(scaled, [[1, 1 / 6], [1 / 6, 1]])
    assert margin(scaled) == pytest.approx(5 / 6)


def test_what_the_frontier_excludes_is_a_claim_that_holds() -> None:
    content = stored(0.9)
    assert content["state_feedback"]["proved"]
    assert broken_claims(content, PLANT, BALLS) == []
    inside = content["state_feedback"] | {"rate": 0.1}
    content["state_feedback"] = inside | {"digest": digest(inside)}
    assert any("inside the frontier" in claim for claim in broken_claims(content, PLANT, BALLS))


def test_a_certificate_of_another_order_does_not_fit() -> None:
    smaller = StateSpace(a=PLANT.a[:1, :1], b=np.ones((1, 1)), c=np.ones((1, 1)), d=np.zeros((1, 1)))
    broken = broken_claims(stored(0.3), smaller, BALLS)
    for side in ("state_feedback", "observer"):
        assert f"{side}: the matrices do not fit the model" in broken


def test_the_digest_is_of_the_numbers_and_not_of_their_order() -> None:
    part = stored(0.3)["observer"]
    assert digest(dict(reversed(part.items()))) == part["digest"]


def test_a_malformed_part_says_what_is_wrong_with_it() -> None:
    content = stored(0.3)
    missing, strange = copy.deepcopy(content), copy.deepcopy(content)
    del missing["observer"]["eta"]
    strange["observer"]["gain"] = 1.0
    for wrong, told in ((missing, "is missing"), (strange, "is not part of a certificate")):
        with pytest.raises(BadRequest, match=told):
            Design.from_json(wrong)
