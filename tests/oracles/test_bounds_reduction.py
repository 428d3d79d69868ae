"""Reduction: the linear part absorbs what it can of a scaffolding, and states are dropped."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.bounds.gramians import (
    balanced_realization,
    controllability_gramian,
    hankel_singular_values,
)
from ssm_study.bounds.network import Network
from ssm_study.bounds.reduction import Reduction
from ssm_study.bounds.slopes import certified_balls, jacobian_ball
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def two_channel(inner, outer=None) -> SSM:
    rng = np.random.default_rng(0)
    a = np.diag([0.9, -0.5, 0.3])
    b = rng.normal(size=(3, 2))
    c = rng.normal(size=(2, 3))
    d = rng.normal(size=(2, 2))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    scaffold_out = outer or LinearScaffold.identity(2)
    scale = Scale.identity(2, 2)
    step_s = 0.1
    maps = {"scaffold_in": inner, "scaffold_out": scaffold_out}
    return SSM(linear=linear, scale=scale, step_s=step_s, **maps)


def model_with_map(side: str, scaffold) -> SSM:
    """The model with this map on the side of the input or of the output."""
    if side == "in":
        return two_channel(scaffold)
    identity = LinearScaffold.identity(2)
    return two_channel(identity, scaffold)


def relative_radius_of(model: SSM, side: str) -> float:
    balls = certified_balls(model)
    return getattr(balls, f"{side}put").relative_radius


def assert_equal_responses(changed: SSM, model: SSM, seed: int) -> None:
    """Two models answer a random input alike."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(200, 2))
    actual = changed.simulate(u)
    expected = model.simulate(u)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


def near_linear(seed: int, centre: np.ndarray) -> MlpScaffold:
    """`N(v)` close to `centre v`: leaky slopes between 0.8 and 1 around an almost linear
    network."""
    rng = np.random.default_rng(seed)
    coupling_in = 0.2 * rng.normal(size=(2, 2))
    first = np.vstack([np.eye(2), coupling_in])
    coupling_out = 0.1 * rng.normal(size=(2, 2))
    last = np.hstack([centre / 0.9, coupling_out])
    negative_slopes = (np.full(4, 0.8),)
    positive_slopes = (np.ones(4),)
    weights = (first, last)
    biases = (rng.normal(size=4),)
    slopes = {"negative_slopes": negative_slopes, "positive_slopes": positive_slopes}
    network = Network(weights=weights, biases=biases, **slopes)
    return MlpScaffold(network=network)


KINKS = np.array([[0.5], [-0.5]])
SLOPES = np.array([[1.0, 0.5], [-1.0, -2.0]])
SIGNS = MonotoneScaffold(breakpoints=KINKS, slopes=SLOPES)


MIRROR = np.diag([1.0, -1.0])
ROTATIONS_AND_SIGNS = {
    "rotation": LinearScaffold(gain=TURN),
    "rotating network": near_linear(1, TURN),
    "mirroring network": near_linear(2, MIRROR),
    "one falling channel": SIGNS,
}
turned_maps = pytest.mark.parametrize(
    "inner", ROTATIONS_AND_SIGNS.values(), ids=ROTATIONS_AND_SIGNS
)


@turned_maps
@pytest.mark.parametrize("side", ["in", "out"])
def test_rotations_and_signs_are_absorbed(inner, side: str) -> None:
    """Singular values alone would pass these as they are; the ball around alpha I refuses them
    until absorbed."""
    model = model_with_map(side, inner)
    assert relative_radius_of(model, side) >= 1
    turned = model.absorb_map_centres()
    assert relative_radius_of(turned, side) < 0.6
    assert_equal_responses(turned, model, 1)


@pytest.mark.parametrize("side", ["in", "out"])
def test_channels_of_different_gain_keep_their_map(side: str) -> None:
    """One channel steeper than one, one flatter, one falling: pieces are turned around for the
    falling one alone."""
    breakpoints = np.array([[-0.3, 0.8], [0.2, 0.9]])
    steep = [2.0, 3.0, 4.0]
    falling = [-3.0, -2.0, -1.0]
    flat = [0.1, 0.2, 0.3]
    slopes = np.array([steep, falling])
    with_falling = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    slopes = np.array([steep, flat])
    with_flat = replace(with_falling, slopes=slopes)
    for scaffold in (with_falling, with_flat):
        model = model_with_map(side, scaffold)
        turned = model.absorb_map_centres()
        assert turned.linear is not model.linear
        assert_equal_responses(turned, model, 2)


def test_reduction_absorbs_unless_told_not_to() -> None:
    gain = np.array([[0.0, -2.0], [2.0, 0.0]])
    inner = LinearScaffold(gain=gain)
    model = two_channel(inner)
    reduction = Reduction(balanced=False)
    balls = certified_balls(reduction.reduce_model(model))
    relative_radius = balls.input.relative_radius
    assert relative_radius == 0
    reduction = Reduction(balanced=False, absorb=False)
    assert reduction.reduce_model(model) is model


def test_a_scalar_gain_is_an_exact_bound() -> None:
    gain = np.array([[-0.3]])
    scaffold = LinearScaffold(gain=gain)
    bound = jacobian_ball(scaffold)
    assert bound.lower == bound.upper == -0.3


def test_what_cannot_be_absorbed_is_left_for_synthesis_to_refuse() -> None:
    breakpoints = np.zeros((2, 1))
    slopes = np.array([[-1.0, 1.0], [1.0, 1.0]])
    folding = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    model = two_channel(folding).absorb_map_centres()
    balls = certified_balls(model)
    relative_radius = balls.input.relative_radius
    assert relative_radius >= 1


def test_a_scaffolding_that_is_not_square_is_refused() -> None:
    gain = np.ones((2, 1))
    scaffold = LinearScaffold(gain=gain)
    with pytest.raises(BadRequest, match="square"):
        jacobian_ball(scaffold)


@given(st.integers(0, 10**6), st.integers(2, 8))
def test_balanced_coordinates_and_the_truncation_bound(seed: int, order: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    a *= 0.9 / spectral_radius
    b = rng.normal(size=(order, 1))
    c = rng.normal(size=(1, order))
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    hankel = hankel_singular_values(linear)
    upper_limit = 1e-6 * hankel[0]
    if hankel[-1] < upper_limit:
        return
    balanced = balanced_realization(linear)
    balanced_values = hankel_singular_values(balanced)
    np.testing.assert_allclose(balanced_values, hankel, rtol=1e-5)
    b = balanced.c.T
    of_input = controllability_gramian(balanced.a, balanced.b)
    of_output = controllability_gramian(balanced.a.T, b)
    expected = np.diag(hankel)
    atol = 1e-5 * hankel[0]
    for w in (of_input, of_output):
        np.testing.assert_allclose(w, expected, atol=atol)
    reduced = balanced_realization(linear, order - 1)
    angles = np.linspace(0, np.pi, 200)
    z = np.exp(1j * angles)
    gaps = []
    for point in z:
        gap = response(linear, point) - response(reduced, point)
        gaps.append(abs(gap))
    tail = 2 * hankel[-1]
    upper_limit = tail * (1 + 1e-6) + 1e-9
    assert max(gaps) <= upper_limit


def response(linear: StateSpace, z: complex) -> complex:
    identity = np.eye(linear.order)
    difference = z * identity - linear.a
    solution = np.linalg.solve(difference, linear.b)
    values = linear.c @ solution + linear.d
    return values[0, 0]


class Model:
    """A linear part alone."""

    def __init__(self, linear: StateSpace) -> None:
        self.linear = linear

    @property
    def system_with_disturbances(self) -> StateSpace:
        return self.linear

    def with_system_and_disturbances(self, system: StateSpace) -> "Model":
        return Model(system)


def reduced_order(reduction: Reduction, linear: StateSpace) -> int:
    """The number of states that a reduction leaves."""
    model = Model(linear)
    return reduction.reduce_model(model).linear.order


def test_balancing_refuses_what_has_no_gramian_and_drops_what_carries_nothing() -> None:
    a = np.array([[1.1]])
    b = np.ones((1, 1))
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    unstable = StateSpace(a=a, b=b, c=c, d=d)
    with pytest.raises(BadRequest, match="spectral_radius"):
        balanced_realization(unstable)
    a = np.diag([0.9, 0.5])
    b = np.array([[1.0], [1e-12]])
    c = np.ones((1, 2))
    d = np.zeros((1, 1))
    dead = StateSpace(a=a, b=b, c=c, d=d)
    values = hankel_singular_values(dead)
    largest = f"{values[0]:.3g}"
    words = rf"of the largest \({largest}\).*truncate_to"
    with pytest.raises(BadRequest, match=words):
        balanced_realization(dead)

    assert reduced_order(Reduction(), dead) == 1
    unbalanced = Reduction(balanced=False)
    assert reduced_order(unbalanced, dead) == 2


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_states_are_dropped_by_their_share_of_the_largest(scale: float) -> None:
    """Two decoupled states, one a thousandth as strong; what unit the output has does not
    matter."""

    a = np.diag([0.5, -0.5])
    b = np.array([[1.0], [1.0]])
    c = scale * np.array([[1.0, 1e-3]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    coarse = Reduction(drop_below=1e-1)
    assert reduced_order(coarse, linear) == 1
    fine = Reduction(drop_below=1e-6)
    assert reduced_order(fine, linear) == 2


REFUSED_REDUCTIONS = [
    {"truncate_to": 0},
    {"drop_below": 0.0},
    {"balanced": False, "truncate_to": 2},
]


@pytest.mark.parametrize("bad", REFUSED_REDUCTIONS)
def test_reduction_refuses(bad: dict) -> None:
    with pytest.raises(BadRequest, match="reduction"):
        Reduction(**bad)
