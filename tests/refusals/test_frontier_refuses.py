"""Frontier of the contraction rate: which mode sets it, and what it refuses to answer."""

import numpy as np
import pytest
from synthesis_ratio import ratio_limit
from test_synthesis_refuses import BALLS, INPUT_BALL, system

from ssm_study.certificates.frontier import contraction_frontier, largest_uncontrollable_modulus
from ssm_study.refusal import BadRequest
from ssm_study.systems import JacobianBall


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

    frontier = contraction_frontier(a, b, ball)

    assert frontier.contraction_limit == pytest.approx(limit)
    assert frontier.decided_by == by


def test_a_repeated_mode_one_input_cannot_split_counts_as_out_of_reach() -> None:
    plant = system([[0.9, 0.0], [0.0, 0.9]], [1.0, 2.0], [1.0, 1.0])
    modulus = largest_uncontrollable_modulus(plant.a, plant.b)
    assert modulus == pytest.approx(0.9)


@pytest.mark.parametrize("unit", [1e-15, 1e-6, 1.0, 1e6, 1e15])
def test_what_is_out_of_reach_does_not_hang_on_the_inputs_unit(unit: float) -> None:
    reached = system([[0.9, 0.1], [0.0, 0.5]], [1.0, 2.0], [1.0, 1.0])
    of_reached = largest_uncontrollable_modulus(reached.a, unit * reached.b)
    assert of_reached == 0

    first_mode_only = np.array([[unit], [0.0]])
    of_two_modes = largest_uncontrollable_modulus(np.diag([0.9, 0.5]), first_mode_only)
    assert of_two_modes == pytest.approx(0.5)
    of_repeated_mode = largest_uncontrollable_modulus(np.diag([0.9, 0.9]), first_mode_only)
    assert of_repeated_mode == pytest.approx(0.9)


def test_matrices_that_are_not_finite() -> None:
    a = np.array([[np.nan]])
    b = np.ones((1, 1))
    with pytest.raises(BadRequest, match="a"):
        contraction_frontier(a, b, BALLS.input)


@pytest.mark.parametrize("inputs", [1, 2])
def test_the_frontier_at_the_modulus_of_a_mode(inputs: int) -> None:
    """A mode on the circle costs no energy: the ratio is that of the modes outside it, from either
    side."""
    a = np.diag([1.2, 0.9, 0.5])
    columns = np.array([[1.0, 0.3], [0.7, 1.0], [0.2, 0.4]])
    b = columns[:, :inputs]

    at = ratio_limit(a, b, 0.9)
    below = ratio_limit(a, b, 0.9 * (1 - 1e-7))
    above = ratio_limit(a, b, 0.9 * (1 + 1e-7))
    without_input = ratio_limit(a, np.zeros_like(b), 0.9)

    assert below == pytest.approx(at, rel=1e-5)
    assert above == pytest.approx(at, rel=1e-5)
    assert without_input == 0.0


def test_the_frontier_of_modes_that_two_inputs_hardly_tell_apart() -> None:
    """Three at minus one, so nearly uncoupled that each input moves its own: one of them has two,
    which decides."""
    a = np.array(
        [[-1.0, 0.0, 0.0], [3.03608337e-11, -1.0, 0.0], [3.02671280e-10, -4.81049402e-10, -1.0]]
    )
    b = np.array([[0.57466926, -0.3113685], [-0.18975561, 0.30924853], [0.26792832, 0.38736124]])
    wide_ball = JacobianBall.from_slopes(1 / 3, 1.0)
    for ball in (INPUT_BALL, wide_ball):
        frontier = contraction_frontier(a, b, ball)
        of_both_inputs = np.sqrt(ball.relative_radius)
        assert frontier.contraction_limit == pytest.approx(of_both_inputs, abs=1e-6)
