"""Laws that every plant obeys, tested for each choice of the configuration group `plant`."""

import numpy as np
import pytest

from ssm_study.conformance import construct_choice, list_choices
from ssm_study.plants.plant import Plant

SAMPLES = 30
HALF = 15


@pytest.fixture(params=list_choices("plant"))
def plant(request: pytest.FixtureRequest) -> Plant:
    """One plant for each choice of the configuration group `plant`."""
    chosen_plant: Plant = construct_choice("plant", request.param)
    return chosen_plant


def random_inputs(plant: Plant, cases: int) -> np.ndarray:
    """Random input sequences within a plant's default excitation amplitude."""
    rng = np.random.default_rng(0)
    shape = (cases, SAMPLES, len(plant.inputs))
    levels = rng.uniform(-1, 1, shape)
    amplitude = np.array(plant.input_amplitude)
    return plant.equilibrium().u + levels * amplitude


def test_the_equilibrium_is_a_fixed_point(plant: Plant) -> None:
    """A plant that starts at its equilibrium with the equilibrium input stays at the
    equilibrium."""
    rest = plant.equilibrium()
    held = np.tile(rest.u, (1, SAMPLES, 1))
    x, y = plant.simulate(held)
    resting_states = np.tile(rest.x, (SAMPLES, 1))
    resting_outputs = np.tile(rest.y, (SAMPLES, 1))
    np.testing.assert_allclose(x[0], resting_states, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(y[0], resting_outputs, rtol=1e-9, atol=1e-12)


def test_shapes_and_names_agree(plant: Plant) -> None:
    """A plant's inputs, outputs and states have as many channels as names."""
    x, y = plant.simulate(random_inputs(plant, 3))
    assert x.shape == (3, SAMPLES, len(plant.states))
    assert y.shape == (3, SAMPLES, len(plant.outputs))
    assert len(plant.input_amplitude) == len(plant.inputs)
    assert len(plant.noise_variance) == len(plant.outputs)
    for channel in (*plant.inputs, *plant.outputs, *plant.states, *plant.disturbances):
        assert channel.name.isidentifier()
        assert channel.unit


def test_a_batch_equals_its_rows(plant: Plant) -> None:
    """Simulating a batch of input sequences gives the same as simulating each by itself."""
    u = random_inputs(plant, 3)
    _, together = plant.simulate(u)
    outputs = []
    for i in range(3):
        single_case = u[i : i + 1]
        _, y = plant.simulate(single_case)
        outputs.append(y)
    one_by_one = np.concatenate(outputs)
    np.testing.assert_array_equal(together, one_by_one)


def test_two_halves_equal_the_whole(plant: Plant) -> None:
    """Simulating a plant in two halves of the time gives the same as simulating it at once."""
    u = random_inputs(plant, 2)
    x, _ = plant.simulate(u)
    second_input = u[:, HALF:]
    second_half = x[:, HALF:]
    again, _ = plant.simulate(second_input, x0=x[:, HALF])
    np.testing.assert_allclose(again, second_half, rtol=1e-12, atol=1e-14)


def test_equilibrium_states_give_outputs(plant: Plant) -> None:
    """The equilibrium state that a plant returns for a given output produces that output."""
    offsets = np.linspace(*plant.initial_range, 5)
    each_output = np.ones(len(plant.outputs))
    of_each_output = offsets[:, None] * each_output
    wanted_output = plant.equilibrium().y + of_each_output
    states = plant.equilibrium_states(wanted_output)
    np.testing.assert_allclose(plant.output(states), wanted_output, rtol=1e-12)


def test_outputs_do_not_depend_on_later_inputs(plant: Plant) -> None:
    """An output sample does not depend on the input that is applied after it."""
    u = random_inputs(plant, 1)
    changed = u.copy()
    largest_step = np.array(plant.input_amplitude)
    changed[:, HALF] = plant.equilibrium().u + largest_step
    _, y = plant.simulate(u)
    _, y_changed = plant.simulate(changed)
    after = HALF + 1
    before_change = y[:, :after]
    after_change = y[:, after:]
    np.testing.assert_array_equal(before_change, y_changed[:, :after])
    assert not np.array_equal(after_change, y_changed[:, after:])


def test_disturbances_act(plant: Plant) -> None:
    """Every disturbance that a plant declares has an effect on its output."""
    u = random_inputs(plant, 1)
    undisturbed, _ = plant.simulate(u)
    for push in 1e-3 * np.eye(len(plant.disturbances)):
        constant_push = np.tile(push, (1, SAMPLES, 1))
        disturbed, _ = plant.simulate(u, d=constant_push)
        assert not np.array_equal(disturbed, undisturbed)
