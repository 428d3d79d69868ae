"""Bounds small enough to be worked out on paper, and searches against what they search."""

from fractions import Fraction

import numpy as np
import pytest
import worst_case

from ssm_study.bounds.gramians import (
    balanced_realization,
    bound_local_controllability,
    hankel_singular_values,
)
from ssm_study.bounds.network import Network, PortableMap, break_points, invert_map, slope_interval
from ssm_study.bounds.slopes import spectral_norm_bound
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.refusal import BadRequest
from ssm_study.systems import JacobianBall, StateSpace

Layers = tuple[np.ndarray, ...]
LayerSlopes = tuple[Layers, Layers]


def make_network(
    weights: tuple[np.ndarray, ...], biases: tuple[np.ndarray, ...], slopes: LayerSlopes
) -> Network:
    """A network of these layers; of each, the slopes below and above its neurons' kinks."""
    below, above = slopes
    return Network(weights=weights, biases=biases, negative_slopes=below, positive_slopes=above)


def test_a_bias_of_minus_one_is_negative() -> None:
    """`s1(v - 1) - s1(-1)` is v/4 up to one and `v - 3/4` beyond; the second neuron turns at 1/2,
    hence at 5/4."""
    one = np.ones((1, 1))
    weights = (one, one, one)
    biases = (np.array([-1.0]), np.array([-0.5]))
    below = (np.array([0.25]), np.array([0.5]))
    above = (np.ones(1), np.ones(1))
    net = make_network(weights, biases, (below, above))
    expected = (Fraction(1, 8), Fraction(1))
    assert slope_interval(net) == expected


def test_a_falling_neuron_turns_once_and_one_without_input_nowhere() -> None:
    """`s(1 - v)` falls by one up to one and by a quarter beyond; the second neuron stands still."""
    falling = np.array([[-1.0], [0.0]])
    together = np.ones((1, 2))
    biases = (np.ones(2),)
    below = (np.full(2, 0.25),)
    above = (np.ones(2),)
    net = make_network((falling, together), biases, (below, above))
    assert break_points(net) == [Fraction(1)]
    expected = (Fraction(-1), Fraction(-1, 4))
    assert slope_interval(net) == expected


@pytest.mark.parametrize("seed", range(5))
def test_the_smoothed_copy_that_a_search_climbs_becomes_the_network(seed: int) -> None:
    """Cold, its Jacobian is the network's; warm, it lies between the slopes."""
    rng = np.random.default_rng(seed)
    widths = (4, 5, 3)
    shapes = ((4, 2), (5, 4), (3, 5), (2, 3))
    weights = tuple(rng.normal(size=shape) for shape in shapes)
    biases = tuple(rng.normal(size=h) for h in widths)
    below = tuple(np.full(width, 0.1) for width in widths)
    above = tuple(np.full(width, 1.5) for width in widths)
    net = make_network(weights, biases, (below, above))
    points = rng.uniform(-5, 5, size=(20, 2))
    for v in points:
        actual = worst_case._smooth_jacobian(net, v, 1e-7)
        expected = net.jacobian(v)
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
    one = np.ones((1, 1))
    weights = (one, one)
    biases = (np.zeros(1),)
    below = (np.array([0.1]),)
    above = (np.array([1.5]),)
    single = make_network(weights, biases, (below, above))
    zero = np.zeros(1)
    jacobian = worst_case._smooth_jacobian(single, zero, 1.0)
    assert jacobian[0, 0] == pytest.approx(0.8)


def test_the_refusal_names_the_value_of_the_last_state_that_was_to_be_kept() -> None:
    """Three modes, a thousandth and a billionth as strongly driven as the first."""
    a = np.diag([0.5, -0.5, 0.1])
    b = np.array([[1.0], [1e-3], [1e-9]])
    c = np.ones((1, 3))
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    first, second, third = hankel_singular_values(linear)
    upper_limit = 1e-8 * first
    assert third < upper_limit
    assert upper_limit < second
    with pytest.raises(BadRequest, match="at most 2") as refused:
        balanced_realization(linear)
    expected = pytest.approx(third, rel=1e-3)
    assert refused.value.value == expected
    order = balanced_realization(linear, 2).order
    assert order == 2


def test_the_papers_figure_is_the_product_of_the_extreme_singular_values_and_slopes() -> None:
    """`2 x 0.5 x 0.1` below and `3 x 4 x 1` above; nothing of it is a ball."""
    inner = np.diag([2.0, -3.0])
    outer = np.diag([0.5, 4.0])
    weights = (inner, outer)
    biases = (np.ones(2),)
    below = (np.array([0.1, 0.2]),)
    above = (np.array([1.0, 0.9]),)
    net = make_network(weights, biases, (below, above))
    expected = (0.1, 12.0)
    assert spectral_norm_bound(net) == pytest.approx(expected)


def test_local_gramians_lie_between_the_squares_of_the_slopes() -> None:
    """One state, one step: the linear part's Gramian is `b^2 = 4`, the model's `0.2^2` to `0.5^2`
    of it."""
    a = np.array([[0.5]])
    b = np.array([[2.0]])
    ball = JacobianBall.from_slopes(0.2, 0.5)
    local = bound_local_controllability(a, b, ball)
    assert local.holds
    assert local.lower == pytest.approx(0.16)
    assert local.upper == pytest.approx(1.0)


def test_a_falling_map_has_an_inverse() -> None:
    """`-v` between -1 and 1, twice as steep below and half as steep above."""
    breakpoints = np.array([[-1.0, 1.0]])
    slopes = np.array([[-2.0, -1.0, -0.5]])
    falling = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    inverse = invert_map(falling.as_portable())
    assert inverse is not None
    values = np.array([[5.0], [0.5], [-2.0]])
    actual = inverse(values)
    expected = [[-3.0], [-0.5], [3.0]]
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_a_map_that_couples_its_channels_has_no_inverse_by_channel() -> None:
    """Its one neuron sees the first channel and moves the second."""
    first_input_alone = np.array([[1.0, 0.0]])
    second_output_alone = np.array([[0.0], [1.0]])
    weights = (first_input_alone, second_output_alone)
    biases = (np.array([0.5]),)
    below = (np.array([0.1]),)
    above = (np.ones(1),)
    net = make_network(weights, biases, (below, above))
    linear = np.eye(2)
    portable = PortableMap(linear=linear, network=net)
    assert invert_map(portable) is None
