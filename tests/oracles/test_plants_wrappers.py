"""Wrappers: each against the plain plant with the same thing done to its signals by hand."""

import numpy as np
import pytest
from plants_cases import choices, from_yaml

from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance, RandomDisturbance
from ssm_study.plants.plant import Plant
from ssm_study.plants.wrapper import DelayedInput, SaturatedInput
from ssm_study.refusal import BadRequest

PLAIN = ["dc_motor", "cascaded_tanks", "stribeck_drive", "quadruple_tank"]
SAMPLES = 40


def test_the_plain_plants_are_there() -> None:
    plants = set(choices("plant"))
    assert set(PLAIN) <= plants


@pytest.fixture(params=PLAIN)
def plant(request: pytest.FixtureRequest) -> Plant:
    return from_yaml("plant", request.param)


def inputs(plant: Plant, cases: int = 2) -> np.ndarray:
    rng = np.random.default_rng(0)
    channels = len(plant.inputs)
    levels = rng.uniform(-1, 1, (cases, SAMPLES, channels))
    amplitude = np.array(plant.input_amplitude)
    deviation = levels * amplitude
    return plant.equilibrium().u + deviation


def test_saturation_clips(plant: Plant) -> None:
    rest = plant.equilibrium().u
    amplitude = np.array(plant.input_amplitude)
    half = 0.5 * amplitude
    lower = list(rest - half)
    upper = list(rest + half)
    limited = SaturatedInput(plant=plant, lower=lower, upper=upper)
    u = inputs(plant)
    limited_run = limited.simulate(u)
    actual = limited_run[1]
    clipped = np.clip(u, rest - half, rest + half)
    response = plant.simulate(clipped)
    expected = response[1]
    np.testing.assert_array_equal(actual, expected)
    response = limited.simulate(u)
    free_run = plant.simulate(u)
    assert not np.array_equal(response[1], free_run[1])


NUMBERS_OF_SAMPLES = [1, 3]


@pytest.mark.parametrize("samples", NUMBERS_OF_SAMPLES)
def test_delay_shifts(plant: Plant, samples: int) -> None:
    u = inputs(plant)
    equilibrium = plant.equilibrium()
    waiting = np.tile(equilibrium.u, (2, samples, 1))
    undelayed = u[:, :-samples]
    both = [waiting, undelayed]
    shifted = np.concatenate(both, axis=1)
    delayed = DelayedInput(plant=plant, samples=samples)
    delayed_run = delayed.simulate(u)
    actual = delayed_run[1]
    shifted_run = plant.simulate(shifted)
    expected = shifted_run[1]
    np.testing.assert_array_equal(actual, expected)


def test_a_random_disturbance_holds_and_repeats() -> None:
    disturbance = RandomDisturbance(amplitude=2.0, hold_s=0.05, seed=1)
    time_s = np.arange(1000) * 0.01
    d = disturbance.signal(time_s)
    differences = np.diff(d)
    indices = np.flatnonzero(differences)
    differences = np.diff(indices)
    is_a_multiple = differences % 5 == 0
    assert is_a_multiple.all()
    assert -2.0 <= d.min() < -1.5
    assert 1.5 < d.max() <= 2.0
    expected = disturbance.signal(time_s)
    np.testing.assert_array_equal(d, expected)


def test_wrappers_stack(plant: Plant) -> None:
    rest = plant.equilibrium().u
    amplitude = np.array(plant.input_amplitude)
    reach = 2 * amplitude
    lower = list(rest - reach)
    upper = list(rest + reach)
    limited = SaturatedInput(plant=plant, lower=lower, upper=upper)
    stack = DelayedInput(plant=limited, samples=2)
    x, y = stack.simulate(inputs(plant))
    expected = len(stack.states)
    states_and_delays = len(plant.states) + 2 * len(plant.inputs)
    number_of_states = x.shape[2]
    assert number_of_states == expected == states_and_delays
    delayed_input = DelayedInput(plant=plant, samples=2)
    response = delayed_input.simulate(inputs(plant))
    expected = response[1]
    np.testing.assert_array_equal(y, expected)


def reach_only_beyond_rest(plant: Plant) -> object:
    return SaturatedInput(plant=plant, lower=1.0, upper=2.0)


def limit_two_inputs(plant: Plant) -> object:
    return SaturatedInput(plant=plant, lower=[-1.0, -1.0], upper=1.0)


def delay_by_nothing(plant: Plant) -> object:
    return DelayedInput(plant=plant, samples=0)


def hold_for_no_time(_: Plant) -> object:
    return RandomDisturbance(amplitude=1.0, hold_s=0.0)


def repeat_never(_: Plant) -> object:
    return PeriodicDisturbance(amplitude=1.0, frequency_hz=0.0)


def begin_before_zero(_: Plant) -> object:
    return RampDisturbance(slope_per_s=1.0, from_s=-0.5, until_s=1.0)


def end_as_it_begins(_: Plant) -> object:
    return RampDisturbance(slope_per_s=1.0, from_s=1.0, until_s=1.0)


REFUSED_WRAPPERS = [
    (begin_before_zero, "not in order"),
    (end_as_it_begins, "not in order"),
    (reach_only_beyond_rest, "do not enclose rest"),
    (limit_two_inputs, "the plant has 1 inputs"),
    (delay_by_nothing, "samples = 0"),
    (hold_for_no_time, "hold_s = 0.0"),
    (repeat_never, "frequency_hz = 0.0"),
]


@pytest.mark.parametrize(("build", "says"), REFUSED_WRAPPERS)
def test_refused(build, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says):
        build(from_yaml("plant", "dc_motor"))


def test_a_ramp_is_zero_before_it_begins_and_constant_after_its_end() -> None:
    ramp = RampDisturbance(slope_per_s=2.0, from_s=1.0, until_s=3.0)
    time_s = np.array([0.0, 1.0, 1.5, 3.0, 10.0])
    expected = [0.0, 0.0, 1.0, 4.0, 4.0]
    np.testing.assert_allclose(ramp.signal(time_s), expected, atol=1e-15)
