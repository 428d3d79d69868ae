"""The largest rate by two routes: what the solver reaches by bisection, and the exact frontier it may not pass."""

import numpy as np
import pytest

from ssm_study.synthesis.certificate import Infeasible
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.systems import JacobianBall, StateSpace


@pytest.fixture
def linear() -> StateSpace:
    a = np.array([[0.95, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, 0.0, 0.5]])
    return StateSpace(a=a, b=np.array([[0.0], [0.0], [1.0]]), c=np.array([[1.0, 0.0, 0.0]]), d=np.zeros((1, 1)))


def test_the_solver_reaches_the_frontier_and_never_passes_it(linear: StateSpace) -> None:
    ball = JacobianBall.from_slopes(0.4, 1.0)
    method = LmiSynthesis(rate_controller=0.02, rate_observer=0.02, objective="largest_rate")
    for part in (method.state_feedback(linear, ball), method.observer(linear, ball)):
        assert part.certified
        assert 0.98 * part.rate_limit < part.rate < part.rate_limit


def test_a_floor_beyond_the_frontier_is_infeasible(linear: StateSpace) -> None:
    ball = JacobianBall.from_slopes(0.4, 1.0)
    method = LmiSynthesis(rate_controller=0.99, rate_observer=0.02, objective="largest_rate")
    assert isinstance(method.state_feedback(linear, ball), Infeasible)


def test_it_runs_through_both_sides_of_a_design_with_a_linear_output(linear: StateSpace) -> None:
    """No limit short of observability: the observer's bisection ends near one and stays certified."""
    found = LmiSynthesis(rate_controller=0.02, rate_observer=0.02, objective="largest_rate").observer(
        linear, JacobianBall(alpha=1.0, beta=0.0)
    )
    assert found.certified
    assert found.rate > 0.5
