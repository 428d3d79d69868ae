"""Frontier of the contraction rate: which mode sets it, and what it refuses to answer."""

import numpy as np
import pytest
from synthesis_ratio import ratio_limit
from test_synthesis_refuses import BALLS, INPUT_BALL, system

from ssm_study.certificates.frontier import contraction_frontier, largest_uncontrollable_modulus
from ssm_study.refusal import BadRequest
from ssm_study.systems import JacobianBall

RATIO_OF_SLOPES = 1.2 * 9 / 11
LIMITS = [(0.1, RATIO_OF_SLOPES, "the slopes"), (0.2, 0.9, "a mode out of reach")]


@pytest.mark.parametrize(("lower", "limit", "by"), LIMITS)
def test_what_sets_the_limit_of_several_inputs_is_named(
    lower: float, limit: float, by: str
) -> None:
    """One mode at 0.9 that no input reaches; each of two inputs holds a mode at 1.2, down to `1.2
    beta/alpha`."""
    rows_of_b = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    b = np.array(rows_of_b)
    modes = [0.9, 1.2, 1.2]
    a = np.diag(modes)
    ball = JacobianBall.from_slopes(lower, 1.0)

    frontier = contraction_frontier(a, b, ball)

    expected_limit = pytest.approx(limit)
    assert frontier.contraction_limit == expected_limit
    assert frontier.decided_by == by


def test_a_repeated_mode_one_input_cannot_split_counts_as_out_of_reach() -> None:
    repeated_modes = [[0.9, 0.0], [0.0, 0.9]]
    input_column = [1.0, 2.0]
    output_row = [1.0, 1.0]
    plant = system(repeated_modes, input_column, output_row)
    modulus = largest_uncontrollable_modulus(plant.a, plant.b)
    assert modulus == pytest.approx(0.9)


UNITS = [1e-15, 1e-6, 1.0, 1e6, 1e15]


@pytest.mark.parametrize("unit", UNITS)
def test_what_is_out_of_reach_does_not_hang_on_the_inputs_unit(unit: float) -> None:
    coupled_modes = [[0.9, 0.1], [0.0, 0.5]]
    input_column = [1.0, 2.0]
    output_row = [1.0, 1.0]
    reached = system(coupled_modes, input_column, output_row)
    scaled_input = unit * reached.b
    of_reached = largest_uncontrollable_modulus(reached.a, scaled_input)
    assert of_reached == 0

    first_column = [[unit], [0.0]]
    first_mode_only = np.array(first_column)
    two_modes = [0.9, 0.5]
    a_of_two_modes = np.diag(two_modes)
    of_two_modes = largest_uncontrollable_modulus(a_of_two_modes, first_mode_only)
    assert of_two_modes == pytest.approx(0.5)
    repeated_modes = [0.9, 0.9]
    a_of_repeated_modes = np.diag(repeated_modes)
    of_repeated_mode = largest_uncontrollable_modulus(a_of_repeated_modes, first_mode_only)
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
    modes = [1.2, 0.9, 0.5]
    a = np.diag(modes)
    rows = [[1.0, 0.3], [0.7, 1.0], [0.2, 0.4]]
    columns = np.array(rows)
    b = columns[:, :inputs]

    at = ratio_limit(a, b, 0.9)
    just_below = 0.9 * (1 - 1e-7)
    below = ratio_limit(a, b, just_below)
    just_above = 0.9 * (1 + 1e-7)
    above = ratio_limit(a, b, just_above)
    no_input = np.zeros_like(b)
    without_input = ratio_limit(a, no_input, 0.9)

    expected = pytest.approx(at, rel=1e-5)
    assert below == expected
    assert above == expected
    assert without_input == 0.0


def test_the_frontier_of_modes_that_two_inputs_hardly_tell_apart() -> None:
    """Three at minus one, so nearly uncoupled that each input moves its own: one of them has two,
    which decides."""
    rows_of_a = [
        [-1.0, 0.0, 0.0],
        [3.03608337e-11, -1.0, 0.0],
        [3.02671280e-10, -4.81049402e-10, -1.0],
    ]
    a = np.array(rows_of_a)
    rows_of_b = [[0.57466926, -0.3113685], [-0.18975561, 0.30924853], [0.26792832, 0.38736124]]
    b = np.array(rows_of_b)
    wide_ball = JacobianBall.from_slopes(1 / 3, 1.0)
    for ball in (INPUT_BALL, wide_ball):
        frontier = contraction_frontier(a, b, ball)
        of_both_inputs = np.sqrt(ball.relative_radius)
        expected_limit = pytest.approx(of_both_inputs, abs=1e-6)
        assert frontier.contraction_limit == expected_limit
