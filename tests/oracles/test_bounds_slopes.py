"""Bounds on scaffoldings against sampling, against each other, and against the cases they must not
be fooled by."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worst_case import worst_jacobian

from ssm_study.bounds import lipsdp
from ssm_study.bounds.gramians import balance, gramian, hankel_singular_values
from ssm_study.bounds.lipsdp import lipsdp_ball
from ssm_study.bounds.network import Network, slope_interval
from ssm_study.bounds.reduction import Reduction
from ssm_study.bounds.slopes import (
    certified_balls,
    enclosing_ball,
    interval_bound,
    jacobian_ball,
    lipsdp_bound,
    spectral_norm_bound,
)
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.scaffolds.residual import ResidualScaffold
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace


def network(seed: int, channels: int, widths: tuple[int, ...], low: float = 0.1) -> Network:
    rng = np.random.default_rng(seed)
    sizes = (channels, *widths, channels)
    weights = tuple(
        rng.normal(size=(sizes[i + 1], sizes[i])) / np.sqrt(sizes[i]) for i in range(len(sizes) - 1)
    )
    return Network(
        weights=weights,
        biases=tuple(rng.normal(size=h) for h in widths),
        negative_slopes=tuple(np.full(h, low) for h in widths),
        positive_slopes=tuple(np.ones(h) for h in widths),
    )


WIDTHS = st.sampled_from([(1,), (7,), (5, 4), (3, 4, 3)])


@given(st.integers(0, 10**6), WIDTHS)
def test_the_exact_interval_is_what_a_fine_walk_finds(seed: int, widths: tuple[int, ...]) -> None:
    net = network(seed, 1, widths)
    lower, upper = slope_interval(net)
    v = np.linspace(-8, 8, 40_001)
    slopes = np.diff(net(v[:, None])[:, 0]) / np.diff(v)
    assert slopes.min() >= float(lower) - 1e-9
    assert slopes.max() <= float(upper) + 1e-9
    outside = [net.jacobian(np.array([x]))[0, 0] for x in (-1e6, 1e6)]
    widest = max(*outside, slopes.max()) - min(*outside, slopes.min())
    assert widest >= 0.5 * float(
        upper - lower
    )  # a piece narrower than the walk's step may hide, not half the range


def test_both_ends_of_the_exact_interval_are_attained() -> None:
    """Break points at -1 and 1; slopes 0.1 + 1, 2, 1 + 0.1 from left to right, by hand."""
    net = Network(
        weights=(np.array([[1.0], [-1.0]]), np.array([[1.0, -1.0]])),
        biases=(np.array([1.0, 1.0]),),
        negative_slopes=(np.array([0.25, 0.25]),),
        positive_slopes=(np.array([1.0, 1.0]),),
    )
    assert slope_interval(net) == (Fraction(5, 4), Fraction(2))
    bound = jacobian_ball(MlpScaffold(network=net))
    assert (bound.lower, bound.upper, bound.method) == (1.25, 2.0, "break_points")


def test_neurons_that_bend_at_one_point_are_never_both_active() -> None:
    """`relu(w) - relu(-w)` of `w = relu(v) - relu(-v)`: the identity, whose only break point lies
    on an edge."""
    turned = np.array([[1.0, -1.0]])
    net = Network(
        weights=(turned.T, np.vstack([turned, -turned]), turned),
        biases=(np.zeros(2),) * 2,
        negative_slopes=(np.zeros(2),) * 2,
        positive_slopes=(np.ones(2),) * 2,
    )
    assert slope_interval(net) == (1, 1)


def test_the_papers_lower_bound_is_unsound() -> None:
    """`W1 = [1, 1]^T, W2 = [1, -1]`: the zero map, whose "smallest slope" the norm product puts at
    0.02."""
    net = Network(
        weights=(np.array([[1.0], [1.0]]), np.array([[1.0, -1.0]])),
        biases=(np.zeros(2),),
        negative_slopes=(np.full(2, 0.01),),
        positive_slopes=(np.ones(2),),
    )
    lower, _ = spectral_norm_bound(net)
    assert lower == pytest.approx(0.02)
    assert jacobian_ball(MlpScaffold(network=net)).upper == 0.0  # the truth


@given(st.integers(0, 10**6), WIDTHS)
def test_the_spectral_figure_is_sound_from_above(seed: int, widths: tuple[int, ...]) -> None:
    scaffold = MlpScaffold(network=network(seed, 1, widths))
    assert jacobian_ball(scaffold).upper <= spectral_norm_bound(scaffold.network)[1] * (1 + 1e-12)


@pytest.mark.parametrize("method", [interval_bound, lipsdp_bound])
@given(st.integers(0, 10**6), st.integers(1, 3), st.sampled_from([(6,), (4, 3)]))
def test_sampled_jacobians_lie_in_the_ball(
    method: Any, seed: int, channels: int, widths: tuple[int, ...]
) -> None:
    scaffold = MlpScaffold(network=network(seed, channels, widths))
    bound = method(scaffold.network)
    worst = worst_jacobian(scaffold, bound.ball, seed=seed, starts=1)
    assert worst.distance <= bound.ball.beta * (1 + 1e-9)
    if channels == 1:  # every sound ball holds the exact interval
        exact = jacobian_ball(scaffold)
        assert bound.ball.lower <= exact.lower + 1e-9
        assert exact.upper - 1e-9 <= bound.ball.upper


def test_lipsdp_is_tighter_than_the_norm_product_and_the_search_comes_close() -> None:
    scaffold = MlpScaffold(network=network(3, 2, (8,)))
    ball = lipsdp_bound(scaffold.network).ball
    assert ball.upper < spectral_norm_bound(scaffold.network)[1]
    assert 0.5 < worst_jacobian(scaffold, ball, starts=12).tightness(ball) <= 1


def test_lipsdp_of_one_neuron_is_tight_and_holds_both_slopes() -> None:
    one = np.ones((1, 1))
    net = Network(
        weights=(one, one),
        biases=(np.zeros(1),),
        negative_slopes=(np.full(1, 0.1),),
        positive_slopes=(np.ones(1),),
    )
    centre, radius = lipsdp_ball(net)
    assert max(1 - centre[0, 0], centre[0, 0] - 0.1) <= radius <= 0.45 * (1 + 1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_lipsdp_proves_a_bound_for_wide_networks(seed: int) -> None:
    """The solver stops just outside its own inequality on most of these; no worse than interval
    arithmetic beyond."""
    net = network(seed, 1, (32,))
    found = lipsdp_bound(net)
    interval = interval_bound(net)
    exact = jacobian_ball(MlpScaffold(network=net))
    assert found.lower <= exact.lower <= exact.upper <= found.upper
    assert found.upper - found.lower <= (interval.upper - interval.lower) * (1 + 1e-3)


@pytest.mark.parametrize("widths", [(7,), (5, 4), (3, 4, 3)])
def test_interval_arithmetic_goes_through_every_layer(widths: tuple[int, ...]) -> None:
    scaffold = MlpScaffold(network=network(1, 1, widths))
    interval = interval_bound(scaffold.network)
    exact = jacobian_ball(scaffold)
    assert interval.lower <= exact.lower <= exact.upper <= interval.upper


def test_the_interval_of_one_neuron_behind_two_inputs_by_hand() -> None:
    """`J = s e1 [1 1]`, s in [0.1, 1]: centre at s = 0.55, and a radius whose 2-norm its largest
    column is not."""
    one = (np.zeros(1),)
    slope = np.array([[1.0, 1.0], [0.0, 0.0]])
    weights = (np.array([[1.0, 1.0]]), np.array([[1.0], [0.0]]))
    net = Network(
        weights=weights,
        biases=one,
        negative_slopes=(np.full(1, 0.1),),
        positive_slopes=(np.ones(1),),
    )
    ball = interval_bound(net).ball
    assert ball.alpha == pytest.approx(0.275)
    distance = np.linalg.norm(0.55 * slope - 0.275 * np.eye(2), 2)
    assert ball.beta == pytest.approx(distance + 0.45 * np.sqrt(2))


def test_a_solver_that_fails_leaves_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    scaffold = MlpScaffold(network=network(0, 2, (4,)))
    monkeypatch.setattr(lipsdp, "ENLARGED", (-1.0,))  # no multipliers prove nothing
    with pytest.raises(BadRequest, match="do not prove"):
        lipsdp_bound(scaffold.network)
    assert jacobian_ball(scaffold).method == "interval"


@given(st.floats(-3, 3), st.floats(0, 2))
def test_the_enclosing_ball_holds_both_ends_exactly(lower: float, width: float) -> None:
    upper = lower + width
    ball = enclosing_ball(Fraction(lower), Fraction(upper))
    assert Fraction(ball.alpha) - Fraction(ball.beta) <= Fraction(lower)
    assert Fraction(upper) <= Fraction(ball.alpha) + Fraction(ball.beta)


@pytest.mark.parametrize("seed", range(20))
def test_the_ball_of_a_matrix_holds_it_in_exact_arithmetic(seed: int) -> None:
    """`beta^2 I - (G - alpha I)^T (G - alpha I)` has a trace and a determinant that are not
    negative."""
    gain = np.random.default_rng(seed).standard_normal((2, 2))
    ball = jacobian_ball(LinearScaffold(gain=gain)).ball
    a, b, c, d = (
        Fraction(float(entry)) - Fraction(ball.alpha) * (k in (0, 3))
        for k, entry in enumerate(gain.flat)
    )
    left = Fraction(ball.beta) ** 2 - a * a - c * c
    across = a * b + c * d
    right = Fraction(ball.beta) ** 2 - b * b - d * d
    assert left + right >= 0
    assert left * right - across**2 >= 0
    assert ball.beta == pytest.approx(np.linalg.norm(gain - ball.alpha * np.eye(2), 2), rel=1e-11)


def test_a_decreasing_map_keeps_its_sign() -> None:
    falling = MonotoneScaffold(breakpoints=np.array([[0.0]]), slopes=np.array([[-1.0, -0.25]]))
    bound = jacobian_ball(falling)
    assert (bound.lower, bound.upper) == (-1.0, -0.25)
    assert bound.ball.alpha < 0


def test_a_residual_scaffolding_fills_the_ball_it_was_built_with() -> None:
    inner = network(0, 2, (5,))
    scale = 1 / lipsdp_ball(inner, scalar_centre=True)[1]
    shrunk = replace(inner, weights=(inner.weights[0], inner.weights[1] * min(scale, 0.05)))
    scaffold = ResidualScaffold(alpha=0.6, beta=0.4, network=shrunk, multipliers=(np.ones(5),))
    bound = jacobian_ball(scaffold)
    assert (bound.ball.alpha, bound.ball.beta) == (0.6, 0.4)
    assert worst_jacobian(scaffold, bound.ball, starts=2).tightness(bound.ball) <= 1


TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def two_channel(inner, outer=None) -> SSM:
    rng = np.random.default_rng(0)
    linear = StateSpace(
        a=np.diag([0.9, -0.5, 0.3]),
        b=rng.normal(size=(3, 2)),
        c=rng.normal(size=(2, 3)),
        d=rng.normal(size=(2, 2)),
    )
    return SSM(
        linear=linear,
        scaffold_in=inner,
        scaffold_out=outer or LinearScaffold.identity(2),
        scale=Scale.identity(2, 2),
        step_s=0.1,
    )


def near_linear(seed: int, centre: np.ndarray) -> MlpScaffold:
    """`N(v)` close to `centre v`: leaky slopes between 0.8 and 1 around an almost linear
    network."""
    rng = np.random.default_rng(seed)
    first = np.vstack([np.eye(2), 0.2 * rng.normal(size=(2, 2))])
    last = np.hstack([centre / 0.9, 0.1 * rng.normal(size=(2, 2))])
    slopes = (np.full(4, 0.8),), (np.ones(4),)
    return MlpScaffold(
        network=Network(
            weights=(first, last),
            biases=(rng.normal(size=4),),
            negative_slopes=slopes[0],
            positive_slopes=slopes[1],
        )
    )


SIGNS = MonotoneScaffold(
    breakpoints=np.array([[0.5], [-0.5]]), slopes=np.array([[1.0, 0.5], [-1.0, -2.0]])
)


@pytest.mark.parametrize(
    "inner",
    [LinearScaffold(gain=TURN), near_linear(1, TURN), near_linear(2, np.diag([1.0, -1.0])), SIGNS],
    ids=["rotation", "rotating network", "mirroring network", "one falling channel"],
)
@pytest.mark.parametrize("side", ["in", "out"])
def test_rotations_and_signs_are_absorbed(inner, side: str) -> None:
    """Singular values alone would pass these as they are; the ball around alpha I refuses them
    until absorbed."""
    model = two_channel(inner) if side == "in" else two_channel(LinearScaffold.identity(2), inner)
    assert getattr(certified_balls(model), f"{side}put").relative_radius >= 1
    turned = model.absorbed()
    assert getattr(certified_balls(turned), f"{side}put").relative_radius < 0.6
    u = np.random.default_rng(1).normal(size=(200, 2))
    np.testing.assert_allclose(turned.simulate(u), model.simulate(u), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("side", ["in", "out"])
def test_channels_of_different_gain_keep_their_map(side: str) -> None:
    """One channel steeper than one, one flatter, one falling: pieces are turned around for the
    falling one alone."""
    inner = MonotoneScaffold(
        breakpoints=np.array([[-0.3, 0.8], [0.2, 0.9]]),
        slopes=np.array([[2.0, 3.0, 4.0], [-3.0, -2.0, -1.0]]),
    )
    for scaffold in (inner, replace(inner, slopes=np.array([[2.0, 3.0, 4.0], [0.1, 0.2, 0.3]]))):
        model = (
            two_channel(scaffold)
            if side == "in"
            else two_channel(LinearScaffold.identity(2), scaffold)
        )
        turned = model.absorbed()
        assert turned.linear is not model.linear
        u = np.random.default_rng(2).normal(size=(200, 2))
        np.testing.assert_allclose(turned.simulate(u), model.simulate(u), rtol=1e-9, atol=1e-9)


def test_reduction_absorbs_unless_told_not_to() -> None:
    model = two_channel(LinearScaffold(gain=np.array([[0.0, -2.0], [2.0, 0.0]])))
    assert certified_balls(Reduction(balanced=False).reduce(model)).input.relative_radius == 0
    assert Reduction(balanced=False, absorb=False).reduce(model) is model


def test_a_scalar_gain_is_an_exact_bound() -> None:
    bound = jacobian_ball(LinearScaffold(gain=np.array([[-0.3]])))
    assert bound.lower == bound.upper == -0.3


def test_what_cannot_be_absorbed_is_left_for_synthesis_to_refuse() -> None:
    folding = MonotoneScaffold(
        breakpoints=np.zeros((2, 1)), slopes=np.array([[-1.0, 1.0], [1.0, 1.0]])
    )
    assert certified_balls(two_channel(folding).absorbed()).input.relative_radius >= 1


def test_a_scaffolding_that_is_not_square_is_refused() -> None:
    with pytest.raises(BadRequest, match="square"):
        jacobian_ball(LinearScaffold(gain=np.ones((2, 1))))


@given(st.integers(0, 10**6), st.integers(2, 8))
def test_balanced_coordinates_and_the_truncation_bound(seed: int, order: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
    linear = StateSpace(
        a=a, b=rng.normal(size=(order, 1)), c=rng.normal(size=(1, order)), d=np.zeros((1, 1))
    )
    hankel = hankel_singular_values(linear)
    if hankel[-1] < 1e-6 * hankel[0]:
        return
    balanced = balance(linear)
    np.testing.assert_allclose(hankel_singular_values(balanced), hankel, rtol=1e-5)
    for w in (gramian(balanced.a, balanced.b), gramian(balanced.a.T, balanced.c.T)):
        np.testing.assert_allclose(w, np.diag(hankel), atol=1e-5 * hankel[0])
    reduced = balance(linear, order - 1)
    z = np.exp(1j * np.linspace(0, np.pi, 200))
    gaps = [abs(response(linear, point) - response(reduced, point)) for point in z]
    assert max(gaps) <= 2 * hankel[-1] * (1 + 1e-6) + 1e-9


def response(linear: StateSpace, z: complex) -> complex:
    return (linear.c @ np.linalg.solve(z * np.eye(linear.order) - linear.a, linear.b) + linear.d)[
        0, 0
    ]


class Model:
    """A linear part alone."""

    def __init__(self, linear: StateSpace) -> None:
        self.linear = linear

    @property
    def driven_system(self) -> StateSpace:
        return self.linear

    def with_driven_system(self, system: StateSpace) -> "Model":
        return Model(system)


def test_balancing_refuses_what_has_no_gramian_and_drops_what_carries_nothing() -> None:
    unstable = StateSpace(
        a=np.array([[1.1]]), b=np.ones((1, 1)), c=np.ones((1, 1)), d=np.zeros((1, 1))
    )
    with pytest.raises(BadRequest, match="spectral_radius"):
        balance(unstable)
    dead = StateSpace(
        a=np.diag([0.9, 0.5]), b=np.array([[1.0], [1e-12]]), c=np.ones((1, 2)), d=np.zeros((1, 1))
    )
    largest = f"{hankel_singular_values(dead)[0]:.3g}"
    with pytest.raises(BadRequest, match=rf"of the largest \({largest}\).*truncate_to"):
        balance(dead)

    assert Reduction().reduce(Model(dead)).linear.order == 1
    assert Reduction(balanced=False).reduce(Model(dead)).linear.order == 2


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_states_are_dropped_by_their_share_of_the_largest(scale: float) -> None:
    """Two decoupled states, one a thousandth as strong; what unit the output has does not
    matter."""

    a = np.diag([0.5, -0.5])
    b = np.array([[1.0], [1.0]])
    linear = StateSpace(a=a, b=b, c=scale * np.array([[1.0, 1e-3]]), d=np.zeros((1, 1)))
    assert Reduction(drop_below=1e-1).reduce(Model(linear)).linear.order == 1
    assert Reduction(drop_below=1e-6).reduce(Model(linear)).linear.order == 2


@pytest.mark.parametrize(
    "bad", [{"truncate_to": 0}, {"drop_below": 0.0}, {"balanced": False, "truncate_to": 2}]
)
def test_reduction_refuses(bad: dict) -> None:
    with pytest.raises(BadRequest, match="reduction"):
        Reduction(**bad)
