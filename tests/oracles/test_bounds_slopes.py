"""Bounds on scaffoldings against sampling, against each other, and against the cases they must not
be fooled by."""

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worst_case import worst_jacobian

from ssm_study.bounds import lipsdp
from ssm_study.bounds.lipsdp import lipsdp_ball
from ssm_study.bounds.network import Network, slope_interval
from ssm_study.bounds.slopes import (
    enclosing_ball,
    interval_bound,
    jacobian_ball,
    lipsdp_bound,
    spectral_norm_bound,
)
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.scaffolds.residual import ResidualScaffold
from ssm_study.refusal import BadRequest


def network(seed: int, channels: int, widths: tuple[int, ...], low: float = 0.1) -> Network:
    rng = np.random.default_rng(seed)
    sizes = (channels, *widths, channels)
    weights = []
    for inputs, outputs in pairwise(sizes):
        weight = rng.normal(size=(outputs, inputs)) / np.sqrt(inputs)
        weights.append(weight)
    biases = tuple(rng.normal(size=h) for h in widths)
    negative_slopes = tuple(np.full(h, low) for h in widths)
    positive_slopes = tuple(np.ones(h) for h in widths)
    return Network(
        weights=tuple(weights),
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )


CHOICES_OF_WIDTHS = [(1,), (7,), (5, 4), (3, 4, 3)]
WIDTHS = st.sampled_from(CHOICES_OF_WIDTHS)


SEEDS = st.integers(0, 10**6)


@given(SEEDS, WIDTHS)
def test_the_exact_interval_is_what_a_fine_walk_finds(seed: int, widths: tuple[int, ...]) -> None:
    net = network(seed, 1, widths)
    lower, upper = slope_interval(net)
    v = np.linspace(-8, 8, 40_001)
    columns = v[:, None]
    outputs = net(columns)[:, 0]
    differences = np.diff(outputs)
    slopes = differences / np.diff(v)
    smallest = slopes.min()
    assert smallest >= float(lower) - 1e-9
    largest = slopes.max()
    assert largest <= float(upper) + 1e-9
    outside = []
    for point in (-1e6, 1e6):
        jacobian = net.jacobian(np.array([point]))
        outside.append(jacobian[0, 0])
    steepest = slopes.max()
    largest = max(*outside, steepest)
    flattest = slopes.min()
    smallest = min(*outside, flattest)
    widest = largest - smallest
    lower_limit = 0.5 * float(upper - lower)
    assert (
        widest >= lower_limit
    )  # a piece narrower than the walk's step may hide, not half the range


def test_both_ends_of_the_exact_interval_are_attained() -> None:
    """Break points at -1 and 1; slopes 0.1 + 1, 2, 1 + 0.1 from left to right, by hand."""
    two_signs = [[1.0], [-1.0]]
    both_signs = np.array(two_signs)
    one_and_minus_one = [1.0, -1.0]
    difference_of_both = np.array([one_and_minus_one])
    weights = (both_signs, difference_of_both)
    ones = np.array([1.0, 1.0])
    biases = (ones,)
    quarters = np.array([0.25, 0.25])
    negative_slopes = (quarters,)
    positive_slopes = (ones,)
    net = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    five_quarters = Fraction(5, 4)
    expected = (five_quarters, Fraction(2))
    assert slope_interval(net) == expected
    scaffold = MlpScaffold(network=net)
    bound = jacobian_ball(scaffold)
    assert bound.lower == 1.25
    assert bound.upper == 2.0
    assert bound.method == "break_points"


def test_neurons_that_bend_at_one_point_are_never_both_active() -> None:
    """`relu(w) - relu(-w)` of `w = relu(v) - relu(-v)`: the identity, whose only break point lies
    on an edge."""
    turned = np.array([[1.0, -1.0]])
    mirrored = np.vstack([turned, -turned])
    weights = (turned.T, mirrored, turned)
    zeros = np.zeros(2)
    biases = (zeros,) * 2
    negative_slopes = (zeros,) * 2
    ones = np.ones(2)
    positive_slopes = (ones,) * 2
    net = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    expected = (1, 1)
    assert slope_interval(net) == expected


def test_the_papers_lower_bound_is_unsound() -> None:
    """`W1 = [1, 1]^T, W2 = [1, -1]`: the zero map, whose "smallest slope" the norm product puts at
    0.02."""
    two_equal = np.array([[1.0], [1.0]])
    difference_of_both = np.array([[1.0, -1.0]])
    weights = (two_equal, difference_of_both)
    zeros = np.zeros(2)
    biases = (zeros,)
    hundredths = np.full(2, 0.01)
    negative_slopes = (hundredths,)
    ones = np.ones(2)
    positive_slopes = (ones,)
    net = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    lower, _ = spectral_norm_bound(net)
    assert lower == pytest.approx(0.02)
    scaffold = MlpScaffold(network=net)
    slope_bound = jacobian_ball(scaffold)
    upper = slope_bound.upper
    assert upper == 0.0  # the truth


@given(SEEDS, WIDTHS)
def test_the_spectral_figure_is_sound_from_above(seed: int, widths: tuple[int, ...]) -> None:
    mlp_scaffold_network = network(seed, 1, widths)
    scaffold = MlpScaffold(network=mlp_scaffold_network)
    upper = jacobian_ball(scaffold).upper
    norm_bound = spectral_norm_bound(scaffold.network)
    upper_limit = norm_bound[1] * (1 + 1e-12)
    assert upper <= upper_limit


CHOICES_OF_CHANNEL_WIDTHS = [(6,), (4, 3)]
CHANNEL_WIDTHS = st.sampled_from(CHOICES_OF_CHANNEL_WIDTHS)


METHODS = [interval_bound, lipsdp_bound]
CHANNELS = st.integers(1, 3)


@pytest.mark.parametrize("method", METHODS)
@given(SEEDS, CHANNELS, CHANNEL_WIDTHS)
def test_sampled_jacobians_lie_in_the_ball(
    method: Any, seed: int, channels: int, widths: tuple[int, ...]
) -> None:
    mlp_scaffold_network = network(seed, channels, widths)
    scaffold = MlpScaffold(network=mlp_scaffold_network)
    bound = method(scaffold.network)
    worst = worst_jacobian(scaffold, bound.ball, seed=seed, starts=1)
    beta = bound.ball.beta
    upper_limit = beta * (1 + 1e-9)
    assert worst.distance <= upper_limit
    if channels == 1:  # every sound ball holds the exact interval
        exact = jacobian_ball(scaffold)
        lower = bound.ball.lower
        assert lower <= exact.lower + 1e-9
        upper_limit = bound.ball.upper
        assert exact.upper - 1e-9 <= upper_limit


def test_lipsdp_is_tighter_than_the_norm_product_and_the_search_comes_close() -> None:
    mlp_scaffold_network = network(3, 2, (8,))
    scaffold = MlpScaffold(network=mlp_scaffold_network)
    ball = lipsdp_bound(scaffold.network).ball
    upper_limit = spectral_norm_bound(scaffold.network)[1]
    assert ball.upper < upper_limit
    worst = worst_jacobian(scaffold, ball, starts=12)
    tightness = worst.tightness(ball)
    assert 0.5 < tightness <= 1


def test_lipsdp_of_one_neuron_is_tight_and_holds_both_slopes() -> None:
    unit_weight = np.ones((1, 1))
    weights = (unit_weight, unit_weight)
    zero = np.zeros(1)
    biases = (zero,)
    tenth = np.full(1, 0.1)
    negative_slopes = (tenth,)
    unit_slope = np.ones(1)
    positive_slopes = (unit_slope,)
    net = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    centre, radius = lipsdp_ball(net)
    above = 1 - centre[0, 0]
    below = centre[0, 0] - 0.1
    largest = max(above, below)
    assert largest <= radius <= 0.45 * (1 + 1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_lipsdp_proves_a_bound_for_wide_networks(seed: int) -> None:
    """The solver stops just outside its own inequality on most of these; no worse than interval
    arithmetic beyond."""
    net = network(seed, 1, (32,))
    bound = lipsdp_bound(net)
    interval = interval_bound(net)
    scaffold = MlpScaffold(network=net)
    exact = jacobian_ball(scaffold)
    assert bound.lower <= exact.lower <= exact.upper <= bound.upper
    difference = bound.upper - bound.lower
    width_of_interval = interval.upper - interval.lower
    upper_limit = width_of_interval * (1 + 1e-3)
    assert difference <= upper_limit


LAYERS = [(7,), (5, 4), (3, 4, 3)]


@pytest.mark.parametrize("widths", LAYERS)
def test_interval_arithmetic_goes_through_every_layer(widths: tuple[int, ...]) -> None:
    mlp_scaffold_network = network(1, 1, widths)
    scaffold = MlpScaffold(network=mlp_scaffold_network)
    interval = interval_bound(scaffold.network)
    exact = jacobian_ball(scaffold)
    assert interval.lower <= exact.lower <= exact.upper <= interval.upper


def test_the_interval_of_one_neuron_behind_two_inputs_by_hand() -> None:
    """`J = s e1 [1 1]`, s in [0.1, 1]: centre at s = 0.55, and a radius whose 2-norm its largest
    column is not."""
    no_bias = np.zeros(1)
    biases = (no_bias,)
    slope_rows = [[1.0, 1.0], [0.0, 0.0]]
    slope = np.array(slope_rows)
    ones = [[1.0, 1.0]]
    sum_of_inputs = np.array(ones)
    to_the_first = np.array([[1.0], [0.0]])
    weights = (sum_of_inputs, to_the_first)
    tenths = np.full(1, 0.1)
    negative_slopes = (tenths,)
    ones_of_slopes = np.ones(1)
    positive_slopes = (ones_of_slopes,)
    net = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    ball = interval_bound(net).ball
    expected_alpha = pytest.approx(0.275)
    assert ball.alpha == expected_alpha
    identity = np.eye(2)
    difference = 0.55 * slope - 0.275 * identity
    distance = np.linalg.norm(difference, 2)
    spread = 0.45 * np.sqrt(2)
    expected = distance + spread
    expected_beta = pytest.approx(expected)
    assert ball.beta == expected_beta


def test_a_solver_that_fails_leaves_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    mlp_scaffold_network = network(0, 2, (4,))
    scaffold = MlpScaffold(network=mlp_scaffold_network)
    no_multipliers = (-1.0,)
    monkeypatch.setattr(lipsdp, "ENLARGED", no_multipliers)  # no multipliers prove nothing
    with pytest.raises(BadRequest, match="do not prove"):
        lipsdp_bound(scaffold.network)
    assert jacobian_ball(scaffold).method == "interval"


ENDS = st.floats(-3, 3)
WIDTHS_OF_INTERVALS = st.floats(0, 2)


@given(ENDS, WIDTHS_OF_INTERVALS)
def test_the_enclosing_ball_holds_both_ends_exactly(lower: float, width: float) -> None:
    upper = lower + width
    ball = enclosing_ball(Fraction(lower), Fraction(upper))
    difference = Fraction(ball.alpha) - Fraction(ball.beta)
    assert difference <= Fraction(lower)
    upper_limit = Fraction(ball.alpha) + Fraction(ball.beta)
    assert Fraction(upper) <= upper_limit


@pytest.mark.parametrize("seed", range(20))
def test_the_ball_of_a_matrix_holds_it_in_exact_arithmetic(seed: int) -> None:
    """`beta^2 I - (G - alpha I)^T (G - alpha I)` has a trace and a determinant that are not
    negative."""
    rng = np.random.default_rng(seed)
    gain = rng.standard_normal((2, 2))
    scaffold = LinearScaffold(gain=gain)
    slope_bound = jacobian_ball(scaffold)
    ball = slope_bound.ball
    a, b, c, d = (
        Fraction(float(entry)) - Fraction(ball.alpha) * (k in (0, 3))
        for k, entry in enumerate(gain.flat)
    )
    above_left = Fraction(ball.beta) ** 2
    difference = above_left - a * a
    left = difference - c * c
    across = a * b + c * d
    above_right = Fraction(ball.beta) ** 2
    difference = above_right - b * b
    right = difference - d * d
    assert left + right >= 0
    assert left * right - across**2 >= 0
    identity = np.eye(2)
    difference = gain - ball.alpha * identity
    expected = np.linalg.norm(difference, 2)
    expected_beta = pytest.approx(expected, rel=1e-11)
    assert ball.beta == expected_beta


@pytest.mark.parametrize("seed", range(5))
def test_an_interval_holds_what_neurons_reach_in_exact_arithmetic(seed: int) -> None:
    """Slopes of one and minus one: the radius is the sum of the products of the weights."""
    rng = np.random.default_rng(seed)
    first, last = rng.standard_normal((2, 6))
    ones = np.ones(6)
    net = Network(
        weights=(first[:, None], last[None]),
        biases=(ones,),
        negative_slopes=(-ones,),
        positive_slopes=(ones,),
    )
    products = [Fraction(a) * Fraction(b) for a, b in zip(first, last, strict=True)]
    largest = sum(map(abs, products))
    ball = interval_bound(net).ball
    beta = Fraction(ball.beta)
    assert beta >= largest
    assert beta <= largest * Fraction(1.0001)


def test_a_decreasing_map_keeps_its_sign() -> None:
    breakpoints = np.array([[0.0]])
    falling_slopes = [-1.0, -0.25]
    slopes = np.array([falling_slopes])
    falling = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    bound = jacobian_ball(falling)
    assert bound.lower == -1.0
    assert bound.upper == -0.25
    assert bound.ball.alpha < 0


def test_a_residual_scaffolding_fills_the_ball_it_was_built_with() -> None:
    inner = network(0, 2, (5,))
    inner_ball = lipsdp_ball(inner, scalar_centre=True)
    scale = 1 / inner_ball[1]
    smallest = min(scale, 0.05)
    scaled_outer = inner.weights[1] * smallest
    weights = (inner.weights[0], scaled_outer)
    shrunk = replace(inner, weights=weights)
    ones = np.ones(5)
    multipliers = (ones,)
    scaffold = ResidualScaffold(alpha=0.6, beta=0.4, network=shrunk, multipliers=multipliers)
    bound = jacobian_ball(scaffold)
    assert bound.ball.alpha == 0.6
    assert bound.ball.beta == 0.4
    worst = worst_jacobian(scaffold, bound.ball, starts=2)
    tightness = worst.tightness(bound.ball)
    assert tightness <= 1
