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
    return Network(
        weights=tuple(rng.normal(size=(h, m)) for m, h in itertools.pairwise(sizes)),
        biases=tuple(rng.normal(size=h) for h in widths),
        negative_slopes=tuple(rng.uniform(0.0, 0.5, size=h) for h in widths),
        positive_slopes=tuple(rng.uniform(0.5, 1.0, size=h) for h in widths),
    )


def random_scaffold(kind: str, seed: int, channels: int) -> Scaffold:
    rng = np.random.default_rng(seed)
    widths = tuple(int(h) for h in rng.integers(1, 7, size=rng.integers(1, 4)))
    if kind == "linear":
        return LinearScaffold(gain=rng.normal(size=(channels, channels)))
    if kind == "mlp":
        return MlpScaffold(network=network(rng, channels, channels, widths))
    if kind == "monotone":
        points = np.sort(rng.normal(size=(channels, 5)), axis=1)
        return MonotoneScaffold(
            breakpoints=points, slopes=rng.uniform(0.1, 1.0, size=(channels, 6))
        )
    multipliers = tuple(rng.uniform(0.5, 2.0, size=h) for h in widths)
    return ResidualScaffold(
        alpha=0.5,
        beta=0.4,
        network=network(rng, channels, channels, widths),
        multipliers=multipliers,
    )


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 4))
def test_zero_maps_to_zero_exactly(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    zeros = np.random.default_rng(seed).normal(size=(7, channels))
    zeros[3] = 0.0
    assert (scaffold(zeros)[3] == 0.0).all()


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 4))
def test_the_jacobian_is_the_derivative(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    rng = np.random.default_rng(seed + 1)
    v = rng.normal(size=channels)
    direction = rng.normal(size=channels)
    step = 1e-7  # far smaller than the distance to the next break point, almost surely
    slope = (scaffold(v + step * direction) - scaffold(v - step * direction)) / (2 * step)
    np.testing.assert_allclose(scaffold.jacobian(v) @ direction, slope, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 4))
def test_json_keeps_every_bit(kind: str, seed: int, channels: int) -> None:
    scaffold = random_scaffold(kind, seed, channels)
    again = Scaffold.from_json(json.loads(json.dumps(scaffold.to_json())))
    v = np.random.default_rng(seed).normal(size=(20, channels))
    assert (again(v) == scaffold(v)).all()
    assert again.to_json() == scaffold.to_json()


@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_a_monotone_scaffold_is_the_integral_of_its_slopes(seed: int, channels: int) -> None:
    scaffold = random_scaffold("monotone", seed, channels)
    assert isinstance(scaffold, MonotoneScaffold)
    for c in range(channels):
        knots = np.concatenate([[-3.0], np.clip(scaffold.breakpoints[c], -3, 3), [3.0]])
        values = scaffold(np.repeat(knots[:, None], channels, axis=1))[:, c]
        np.testing.assert_allclose(np.diff(values), scaffold.slopes[c] * np.diff(knots), atol=1e-12)


@pytest.mark.parametrize("gain", [0.5, 3.0, -0.5, -3.0])
def test_gains_around_a_monotone_scaffold_become_part_of_it(gain: float) -> None:
    scaffold = random_scaffold("monotone", 0, 1)
    v = np.linspace(-3, 3, 41)[:, None]
    m = np.array([[gain]])
    np.testing.assert_allclose(scaffold.before(m)(v), scaffold(gain * v), atol=1e-12)
    np.testing.assert_allclose(scaffold.after(m)(v), gain * scaffold(v), atol=1e-12)


def random_model(seed: int, kind_in: str = "mlp", kind_out: str = "linear") -> SSM:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(4, 4))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
    linear = StateSpace(
        a=a, b=rng.normal(size=(4, 2)), c=rng.normal(size=(3, 4)), d=rng.normal(size=(3, 2))
    )
    return SSM(
        linear=linear,
        scaffold_in=random_scaffold(kind_in, seed, 2),
        scaffold_out=random_scaffold(kind_out, seed + 1, 3),
        scale=Scale(
            input_scale=np.array([2.0, 0.5]),
            output_scale=np.array([1.0, 3.0, 0.1]),
            input_equilibrium=np.array([0.3, -1.0]),
            output_equilibrium=np.array([5.0, 0.0, 1.0]),
        ),
        step_s=0.01,
    )


@pytest.mark.parametrize("kind_out", KINDS)
def test_a_model_rests_at_its_equilibrium_and_survives_json(kind_out: str) -> None:
    model = random_model(3, kind_out=kind_out)
    resting = np.broadcast_to(model.scale.input_equilibrium, (5, 2))
    assert (model.simulate(resting) == model.scale.output_equilibrium).all()
    again = SSM.from_json(json.loads(json.dumps(model.to_json())))
    u = np.random.default_rng(0).normal(size=(2, 30, 2))
    assert (again.simulate(u) == model.simulate(u)).all()


def test_stepping_the_pieces_is_the_simulation() -> None:
    model = random_model(4)
    u = np.random.default_rng(1).normal(size=(25, 2))
    x = np.random.default_rng(2).normal(size=4)
    y = []
    expected = model.simulate(u, x)
    for sample in u:
        ubar = model.lift(sample)
        y.append(model.read(x, ubar))
        x = model.advance(x, ubar)
    np.testing.assert_allclose(np.stack(y), expected, rtol=1e-12)
