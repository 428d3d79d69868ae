"""Laws of what the methods try in turn: each asks for more than was asked and less than the
frontier allows."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg

from ssm_study.certificates.frontier import Frontier, contraction_frontier
from ssm_study.certificates.problem import NoSolution, Problem, Solution
from ssm_study.synthesis.design import REPAIRS
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis, guaranteed_cost, solve_at_tau
from ssm_study.synthesis.minimum_energy import SHARES, minimum_energy_attempts
from ssm_study.systems import JacobianBall

UNIT_SLOPE = JacobianBall(alpha=1.0, beta=0.0)
BALLS = [UNIT_SLOPE, JacobianBall.from_slopes(0.4, 1.0)]  # a frontier at r = 0, one above it


def problem(ball: JacobianBall, rate: float = 0.1) -> Problem:
    a = np.array([[1.05, 0.1, 0.0], [-0.1, 0.97, 0.2], [0.0, 0.0, 0.4]])
    b = np.array([[0.1], [1.0], [0.5]])
    state_weight = np.eye(3)
    return Problem(a=a, b=b, ball=ball, rate=rate, state_weight=state_weight, input_weight=1.0)


def limits(asked: Problem) -> Frontier:
    return contraction_frontier(asked.a, asked.b, asked.ball)


def shares(asked: Problem, contractions: list[float]) -> np.ndarray:
    """How far each lies on the way, in log r, from the asked factor to the frontier, or to half
    where that is zero."""
    contraction_limit = limits(asked).contraction_limit
    floor = max(contraction_limit, asked.contraction / 2)
    logs = np.log(np.array(contractions) / asked.contraction)
    return logs / np.log(floor / asked.contraction)


@pytest.mark.parametrize("ball", BALLS)
def test_gains_in_closed_form_are_built_inside_the_room(ball: JacobianBall) -> None:
    """The status of each attempt gives its rate; no two are the same matrices, as they would be
    with scales a power of two apart."""
    asked = problem(ball)
    made: list[tuple[float, str]] = []
    built: list[float] = []
    for attempt in minimum_energy_attempts(asked):
        try:
            found = attempt()
        except NoSolution:
            continue
        words = found.status.split("at rate ")[1]
        rate = float(words.split(",")[0])
        assert asked.rate < rate < limits(asked).rate_limit
        assert 1 <= found.sigma < 2
        made.append((found.sigma, found.status))
        built.append(float(np.sqrt(1 - rate)))
    assert len(set(made)) == len(made) > 20
    contractions = built[: len(SHARES)]
    actual = shares(asked, contractions)
    np.testing.assert_allclose(actual, SHARES, atol=1e-4)


@pytest.mark.parametrize("ball", BALLS)
def test_the_asked_rate_comes_first_and_repairs_lie_inside_the_room(ball: JacobianBall) -> None:
    tried: list[float] = []

    class Noting(RiccatiSynthesis):
        def solve(self, problem: Problem) -> Solution:
            tried.append(problem.rate)
            raise NoSolution("noted")

    asked = problem(ball)
    noting = Noting(rate_controller=0.1, rate_observer=0.1)
    attempts: list[Callable[[], Solution]] = super(RiccatiSynthesis, noting).solution_attempts(
        asked, limits(asked)
    )
    for attempt in attempts:
        with pytest.raises(NoSolution):
            attempt()
    first, *repairs = tried
    assert first == asked.rate
    contractions = [float(np.sqrt(1 - rate)) for rate in repairs]
    actual = shares(asked, contractions)
    np.testing.assert_allclose(actual, REPAIRS)
    assert all(asked.rate < rate < limits(asked).rate_limit for rate in repairs)
    assert repairs == sorted(repairs)  # the mildest first


def test_the_smallest_tau_itself_is_not_admissible() -> None:
    """`kappa = 0`: the equation says nothing of the input, though it still has a solution where A
    is stable."""
    one = np.ones((1, 1))
    state_weight = 0.1 * one
    asked = Problem(
        a=0.5 * one, b=one, ball=BALLS[0], rate=0.1, state_weight=state_weight, input_weight=1.0
    )
    assert solve_at_tau(asked, 1.0) is None
    assert solve_at_tau(asked, 2.0) is not None


def test_without_a_radius_the_weights_give_the_linear_quadratic_regulator() -> None:
    """The regulator is that of `(A/r, alpha B/r)`: a ball without radius is a known linear
    input."""
    ball = JacobianBall(alpha=2.0, beta=0.0)
    r = np.sqrt(0.9)
    asked = problem(ball)
    a = asked.a / r
    b = 2.0 * asked.b / r
    s = scipy.linalg.solve_discrete_are(a, b, asked.state_weight, np.eye(1))
    input_cost = np.eye(1) + b.T @ s @ b
    gain = -np.linalg.solve(input_cost, b.T @ s @ a)
    actual = guaranteed_cost(asked).k
    np.testing.assert_allclose(actual, gain, rtol=1e-6)


def test_the_weights_are_tried_at_the_asked_rate_and_two_faster_ones_before_the_closed_form() -> (
    None
):
    asked = problem(BALLS[1])
    method = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    attempts_at_all_rates = method.solution_attempts(asked, limits(asked))
    attempts = attempts_at_all_rates[:5]
    said = [attempt().status.split()[0] for attempt in attempts]
    expected = ["tau", "tau", "tau", "minimum", "minimum"]
    assert said == expected
