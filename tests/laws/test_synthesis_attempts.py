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
    rotation = [[1.05, 0.1, 0.0], [-0.1, 0.97, 0.2]]
    a = np.array([*rotation, [0.0, 0.0, 0.4]])
    b = np.array([[0.1], [1.0], [0.5]])
    weights = {"state_weight": np.eye(3), "input_weight": 1.0}
    return Problem(a=a, b=b, ball=ball, rate=rate, **weights)


def limits(asked: Problem) -> Frontier:
    return contraction_frontier(asked.a, asked.b, asked.ball)


def shares(asked: Problem, contractions: list[float]) -> np.ndarray:
    """How far each lies on the way, in log r, from the asked factor to the frontier, or to half
    where that is zero."""
    contraction_limit = limits(asked).contraction_limit
    floor = max(contraction_limit, asked.contraction_factor / 2)
    asked_contraction = asked.contraction_factor
    logs = np.log(np.array(contractions) / asked_contraction)
    return logs / np.log(floor / asked_contraction)


@pytest.mark.parametrize("ball", BALLS)
def test_gains_in_closed_form_are_built_inside_the_room(ball: JacobianBall) -> None:
    """The status of each attempt gives its rate; no two are the same matrices, as they would be
    with scales a power of two apart."""
    asked = problem(ball)
    rate_limit = limits(asked).rate_limit
    solutions: list[tuple[float, str]] = []
    built: list[float] = []
    for attempt in minimum_energy_attempts(asked):
        try:
            solution = attempt()
        except NoSolution:
            continue
        words = solution.status.split("at rate ")[1]
        rate = float(words.split(",")[0])
        assert asked.rate < rate < rate_limit
        assert 1 <= solution.sigma < 2
        solutions.append((solution.sigma, solution.status))
        contraction = np.sqrt(1 - rate)
        built.append(float(contraction))
    assert len(solutions) > 20
    assert len(set(solutions)) == len(solutions)
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
    frontier = limits(asked)
    riccati = super(RiccatiSynthesis, noting)
    attempts: list[Callable[[], Solution]] = riccati.solution_attempts(asked, frontier)
    for attempt in attempts:
        with pytest.raises(NoSolution):
            attempt()
    first, *repairs = tried
    assert first == asked.rate
    contractions = [float(np.sqrt(1 - rate)) for rate in repairs]
    actual = shares(asked, contractions)
    np.testing.assert_allclose(actual, REPAIRS)
    for rate in repairs:
        assert asked.rate < rate < frontier.rate_limit
    assert repairs == sorted(repairs)  # the mildest first


def test_the_smallest_tau_itself_is_not_admissible() -> None:
    """`kappa = 0`: the equation says nothing of the input, though it still has a solution where A
    is stable."""
    one = np.ones((1, 1))
    a = 0.5 * one
    weights = {"state_weight": 0.1 * one, "input_weight": 1.0}
    asked = Problem(a=a, b=one, ball=BALLS[0], rate=0.1, **weights)
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
    identity = np.eye(1)
    s = scipy.linalg.solve_discrete_are(a, b, asked.state_weight, identity)
    input_cost = identity + b.T @ s @ b
    coupling = b.T @ s @ a
    gain = -np.linalg.solve(input_cost, coupling)
    actual = guaranteed_cost(asked).k
    np.testing.assert_allclose(actual, gain, rtol=1e-6)


def test_the_weights_are_tried_at_the_asked_rate_and_two_faster_ones_before_the_closed_form() -> (
    None
):
    asked = problem(BALLS[1])
    method = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1)
    attempts_at_all_rates = method.solution_attempts(asked, limits(asked))
    attempts = attempts_at_all_rates[:5]
    statuses = [attempt().status for attempt in attempts]
    first_words = [status.split()[0] for status in statuses]
    expected = ["tau", "tau", "tau", "minimum", "minimum"]
    assert first_words == expected
