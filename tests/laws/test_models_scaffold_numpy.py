"""Every scaffolding in explicit numbers: zero at zero, its own Jacobian, lossless JSON."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.bounds.network import Network
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.scaffolds.residual import ResidualScaffold
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.signals import Scale
from ssm_study.systems import StateSpace

KINDS = ("linear", "mlp", "monotone", "residual")


def network(
    rng: np.random.Generator, inputs: int, outputs: int, widths: tuple[int, ...]
) -> Network:
    sizes = (inputs, *widths, outputs)
    weights = tuple(rng.normal(size=(h, m)) for m, h in itertools.pairwise(sizes))
    biases = tuple(rng.normal(size=h) for h in widths)
    negative_slopes = tuple(rng.uniform(0.0, 0.5, size=h) for h in widths)
    positive_slopes = tuple(rng.uniform(0.5, 1.0, size=h) for h in widths)
    return Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )


def random_scaffold(kind: str, seed: int, channels: int) -> Scaffold:
    rng = np.random.default_rng(seed)
    layers = rng.integers(1, 4)
    drawn_widths = rng.integers(1, 7, size=layers)
    widths = tuple(int(h) for h in drawn_widths)
    if kind == "linear":
        gain = rng.normal(size=(channels, channels))
        return LinearScaffold(gain=gain)
    if kind == "mlp":
        mlp_scaffold_network = network(rng, channels, channels, widths)
        return MlpScaffold(network=mlp_scaffold_network)
    if kind == "monotone":
        drawn_points = rng.normal(size=(channels, 5))
        points = np.sort(drawn_points, axis=1)
        slopes = rng.uniform(0.1, 1.0, size=(channels, 6))
        return MonotoneScaffold(breakpoints=points, slopes=slopes)
    multipliers = tuple(rng.uniform(0.5, 2.0, size=h) for h in widths)
    residual_scaffold_network = network(rng, channels, channels, widths)
    return ResidualScaffold(
        alpha=0.5, beta=0.4, network=residual_scaffold_network, multipliers=multipliers
    )


SEEDS = st.integers(0, 10_000)
CHANNELS = st.integers(1, 4)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS, channels=CHANNELS)
def test_zero_maps_to_zero_exactly(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    rng = np.random.default_rng(seed)
    zeros = rng.normal(size=(7, channels))
    zeros[3] = 0.0
    mapped = scaffold(zeros)[3]
    is_zero = mapped == 0.0
    assert is_zero.all()


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS, channels=CHANNELS)
def test_the_jacobian_is_the_derivative(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    rng = np.random.default_rng(seed + 1)
    v = rng.normal(size=channels)
    direction = rng.normal(size=channels)
    step = 1e-7  # far smaller than the distance to the next break point, almost surely
    ahead = scaffold(v + step * direction)
    behind = scaffold(v - step * direction)
    difference = ahead - behind
    slope = difference / (2 * step)
    actual = scaffold.jacobian(v) @ direction
    np.testing.assert_allclose(actual, slope, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS, channels=CHANNELS)
def test_json_keeps_every_bit(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    document = scaffold.to_json()
    text = json.dumps(document)
    content = json.loads(text)
    again = Scaffold.from_json(content)
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(20, channels))
    is_equal = again(v) == scaffold(v)
    assert is_equal.all()
    expected = scaffold.to_json()
    assert again.to_json() == expected


FEWER_CHANNELS = st.integers(1, 3)


@given(seed=SEEDS, channels=FEWER_CHANNELS)
def test_a_monotone_scaffold_is_the_integral_of_its_slopes(seed: int, channels: int) -> None:
    scaffold = random_scaffold("monotone", seed, channels)
    assert isinstance(scaffold, MonotoneScaffold)
    for c in range(channels):
        breakpoints = scaffold.breakpoints[c]
        inside = np.clip(breakpoints, -3, 3)
        knots = np.concatenate([[-3.0], inside, [3.0]])
        column = knots[:, None]
        on_every_channel = np.repeat(column, channels, axis=1)
        values = scaffold(on_every_channel)[:, c]
        actual = np.diff(values)
        differences = np.diff(knots)
        expected = scaffold.slopes[c] * differences
        np.testing.assert_allclose(actual, expected, atol=1e-12)


GAINS = [0.5, 3.0, -0.5, -3.0]


@pytest.mark.parametrize("gain", GAINS)
def test_gains_around_a_monotone_scaffold_become_part_of_it(gain: float) -> None:
    scaffold = random_scaffold("monotone", 0, 1)
    even_points = np.linspace(-3, 3, 41)
    v = even_points[:, None]
    m = np.array([[gain]])
    actual = scaffold.compose_with_input_matrix(m)(v)
    expected = scaffold(gain * v)
    np.testing.assert_allclose(actual, expected, atol=1e-12)
    actual = scaffold.compose_with_output_matrix(m)(v)
    expected = gain * scaffold(v)
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def random_model(seed: int, kind_in: str = "mlp", kind_out: str = "linear") -> SSM:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(4, 4))
    eigenvalues = np.linalg.eigvals(a)
    moduli = np.abs(eigenvalues)
    spectral_radius = moduli.max()
    a *= 0.9 / spectral_radius
    b = rng.normal(size=(4, 2))
    c = rng.normal(size=(3, 4))
    d = rng.normal(size=(3, 2))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    scaffold_in = random_scaffold(kind_in, seed, 2)
    scaffold_out = random_scaffold(kind_out, seed + 1, 3)
    input_scales = [2.0, 0.5]
    input_scale = np.array(input_scales)
    output_scales = [1.0, 3.0, 0.1]
    output_scale = np.array(output_scales)
    input_equilibria = [0.3, -1.0]
    input_equilibrium = np.array(input_equilibria)
    output_equilibria = [5.0, 0.0, 1.0]
    output_equilibrium = np.array(output_equilibria)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    return SSM(
        linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out, scale=scale, step_s=0.01
    )


@pytest.mark.parametrize("kind_out", KINDS)
def test_a_model_rests_at_its_equilibrium_and_survives_json(kind_out: str) -> None:
    model = random_model(3, kind_out=kind_out)
    input_equilibrium = model.scale.input_equilibrium
    resting = np.broadcast_to(input_equilibrium, (5, 2))
    response = model.simulate(resting)
    expected = model.scale.output_equilibrium
    assert (response == expected).all()
    document = model.to_json()
    text = json.dumps(document)
    content = json.loads(text)
    again = SSM.from_json(content)
    rng = np.random.default_rng(0)
    u = rng.normal(size=(2, 30, 2))
    response = again.simulate(u)
    expected = model.simulate(u)
    assert (response == expected).all()


def test_stepping_the_pieces_is_the_simulation() -> None:
    model = random_model(4)
    rng = np.random.default_rng(1)
    u = rng.normal(size=(25, 2))
    rng = np.random.default_rng(2)
    x = rng.normal(size=4)
    y = []
    expected = model.simulate(u, x)
    for sample in u:
        ubar = model.map_input(sample)
        output = model.output_at(x, ubar)
        y.append(output)
        x = model.next_state(x, ubar)
    actual = np.stack(y)
    np.testing.assert_allclose(actual, expected, rtol=1e-12)
