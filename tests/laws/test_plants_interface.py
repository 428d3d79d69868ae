"""The laws of `Plant`, for every yaml of conf/plant."""

import numpy as np
import pytest
from plants_cases import choices, from_yaml

from ssm_study.plants.plant import Plant

SAMPLES = 30
pytestmark = pytest.mark.parametrize("name", choices("plant"))


def inputs(plant: Plant, cases: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1, 1, (cases, SAMPLES, len(plant.inputs)))
    return plant.equilibrium().u + levels * np.array(plant.input_amplitude)


def test_the_equilibrium_is_a_fixed_point(name: str) -> None:
    plant = from_yaml("plant", name)
    rest = plant.equilibrium()
    x, y = plant.simulate(np.tile(rest.u, (1, SAMPLES, 1)))
    np.testing.assert_allclose(x[0], np.tile(rest.x, (SAMPLES, 1)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(y[0], np.tile(rest.y, (SAMPLES, 1)), rtol=1e-9, atol=1e-12)


def test_shapes_and_names_agree(name: str) -> None:
    plant = from_yaml("plant", name)
    x, y = plant.simulate(inputs(plant, 3))
    assert x.shape == (3, SAMPLES, len(plant.states))
    assert y.shape == (3, SAMPLES, len(plant.outputs))
    assert len(plant.input_amplitude) == len(plant.inputs)
    assert len(plant.noise_variance) == len(plant.outputs)
    for channel in (*plant.inputs, *plant.outputs, *plant.states, *plant.disturbances):
        assert channel.name.isidentifier()
        assert channel.unit


def test_a_batch_equals_its_rows(name: str) -> None:
    plant = from_yaml("plant", name)
    u = inputs(plant, 3)
    together = plant.simulate(u)[1]
    alone = np.concatenate([plant.simulate(u[i : i + 1])[1] for i in range(3)])
    np.testing.assert_array_equal(together, alone)


def test_two_halves_equal_the_whole(name: str) -> None:
    plant = from_yaml("plant", name)
    u = inputs(plant, 2)
    x, _ = plant.simulate(u)
    again, _ = plant.simulate(u[:, SAMPLES // 2 :], x0=x[:, SAMPLES // 2])
    np.testing.assert_allclose(again, x[:, SAMPLES // 2 :], rtol=1e-12, atol=1e-14)


def test_states_at_reads_back(name: str) -> None:
    plant = from_yaml("plant", name)
    low, high = plant.initial_range
    offsets = np.linspace(low, high, 5)[:, None] * np.ones(len(plant.outputs))
    wanted = plant.equilibrium().y + offsets
    np.testing.assert_allclose(plant.output(plant.states_at(wanted)), wanted, rtol=1e-12)


def test_the_output_never_sees_the_input_that_acts_after_it(name: str) -> None:
    plant = from_yaml("plant", name)
    u = inputs(plant, 1)
    changed = u.copy()
    changed[:, SAMPLES // 2] = plant.equilibrium().u + np.array(plant.input_amplitude)
    y, y_changed = plant.simulate(u)[1], plant.simulate(changed)[1]
    np.testing.assert_array_equal(y[:, : SAMPLES // 2 + 1], y_changed[:, : SAMPLES // 2 + 1])
    assert not np.array_equal(y[:, SAMPLES // 2 + 1 :], y_changed[:, SAMPLES // 2 + 1 :])


def test_disturbances_act(name: str) -> None:
    plant = from_yaml("plant", name)
    u = inputs(plant, 1)
    still = plant.simulate(u)[0]
    for j in range(len(plant.disturbances)):
        d = np.zeros((1, SAMPLES, len(plant.disturbances)))
        d[..., j] = 1e-3
        assert not np.array_equal(plant.simulate(u, d=d)[0], still)
