"""Wrappers: each against the plain plant with the same thing done to its signals by hand."""

import numpy as np
import pytest
from plants_cases import choices, from_yaml

from ssm_study.plants.disturbance import PeriodicDisturbance, RandomDisturbance
from ssm_study.plants.plant import Plant
from ssm_study.plants.wrapper import DelayedInput, SaturatedInput
from ssm_study.refusal import BadRequest

PLAIN = ["dc_motor", "cascaded_tanks", "stribeck_drive", "quadruple_tank"]
SAMPLES = 40


def test_the_plain_plants_are_there() -> None:
    assert set(PLAIN) <= set(choices("plant"))


@pytest.fixture(params=PLAIN)
def plant(request: pytest.FixtureRequest) -> Plant:
    return from_yaml("plant", request.param)


def inputs(plant: Plant, cases: int = 2) -> np.ndarray:
    rng = np.random.default_rng(0)
    levels = rng.uniform(-1, 1, (cases, SAMPLES, len(plant.inputs)))
    deviation = levels * np.array(plant.input_amplitude)
    return plant.equilibrium().u + deviation


def test_saturation_clips(plant: Plant) -> None:
    rest = plant.equilibrium().u
    half = 0.5 * np.array(plant.input_amplitude)
    lower = list(rest - half)
    upper = list(rest + half)
    limited = SaturatedInput(plant=plant, lower=lower, upper=upper)
    u = inputs(plant)
    actual = limited.simulate(u)[1]
    clipped = np.clip(u, rest - half, rest + half)
    response = plant.simulate(clipped)
    expected = response[1]
    np.testing.assert_array_equal(actual, expected)
    response = limited.simulate(u)
    assert not np.array_equal(response[1], plant.simulate(u)[1])


@pytest.mark.parametrize("samples", [1, 3])
def test_delay_shifts(plant: Plant, samples: int) -> None:
    u = inputs(plant)
    waiting = np.tile(plant.equilibrium().u, (2, samples, 1))
    shifted = np.concatenate([waiting, u[:, :-samples]], axis=1)
    delayed = DelayedInput(plant=plant, samples=samples)
    actual = delayed.simulate(u)[1]
    expected = plant.simulate(shifted)[1]
    np.testing.assert_array_equal(actual, expected)


def test_a_random_disturbance_holds_and_repeats() -> None:
    disturbance = RandomDisturbance(amplitude=2.0, hold_s=0.05, seed=1)
    d = disturbance.signal(np.arange(1000) * 0.01)
    differences = np.diff(d)
    indices = np.flatnonzero(differences)
    differences = np.diff(indices)
    assert (differences % 5 == 0).all()
    largest = np.abs(d).max()
    assert 1.5 < largest <= 2.0
    expected = disturbance.signal(np.arange(1000) * 0.01)
    np.testing.assert_array_equal(d, expected)


def test_wrappers_stack(plant: Plant) -> None:
    rest = plant.equilibrium().u
    reach = 2 * np.array(plant.input_amplitude)
    lower = list(rest - reach)
    upper = list(rest + reach)
    limited = SaturatedInput(plant=plant, lower=lower, upper=upper)
    stack = DelayedInput(plant=limited, samples=2)
    x, y = stack.simulate(inputs(plant))
    expected = len(stack.states)
    states_and_delays = len(plant.states) + 2 * len(plant.inputs)
    assert x.shape[2] == expected == states_and_delays
    delayed_input = DelayedInput(plant=plant, samples=2)
    response = delayed_input.simulate(inputs(plant))
    expected = response[1]
    np.testing.assert_array_equal(y, expected)


REFUSED_WRAPPERS = [
    (lambda p: SaturatedInput(plant=p, lower=1.0, upper=2.0), "do not enclose rest"),
    (lambda p: SaturatedInput(plant=p, lower=[-1.0, -1.0], upper=1.0), "there are 1 inputs"),
    (lambda p: DelayedInput(plant=p, samples=0), "samples = 0"),
    (lambda _: RandomDisturbance(amplitude=1.0, hold_s=0.0), "hold_s = 0.0"),
    (lambda _: PeriodicDisturbance(amplitude=1.0, frequency_hz=0.0), "frequency_hz = 0.0"),
]


@pytest.mark.parametrize(("build", "says"), REFUSED_WRAPPERS)
def test_refused(build, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says):
        build(from_yaml("plant", "dc_motor"))
