"""The laws of `Excitation`, for every yaml of conf/excitation, and what is special to each kind."""

import numpy as np
import pytest
from plants_cases import choices, from_yaml

from ssm_study.data.coverage import SlopesNotIdentifiable, input_coverage, persistency_order, warn_if_two_level
from ssm_study.data.excitation import PRBS, Request

REQUEST = Request(samples=600, step_s=0.01, amplitude=(4.0, 0.5), clock_s=0.05)
EVERY = pytest.mark.parametrize("name", choices("excitation"))


@EVERY
def test_signals_stay_within_the_amplitude_and_use_it(name: str) -> None:
    u = from_yaml("excitation", name).signal(REQUEST, np.random.default_rng(0))
    assert u.shape == (600, 2)
    assert (np.abs(u) <= np.array(REQUEST.amplitude) * (1 + 1e-12)).all()
    assert (np.abs(u).max(axis=0) > 0.7 * np.array(REQUEST.amplitude)).all()


@EVERY
def test_equal_generators_give_equal_signals_and_others_do_not(name: str) -> None:
    excitation = from_yaml("excitation", name)
    first = excitation.signal(REQUEST, np.random.default_rng(3))
    np.testing.assert_array_equal(first, excitation.signal(REQUEST, np.random.default_rng(3)))
    assert not np.array_equal(first, excitation.signal(REQUEST, np.random.default_rng(4)))


@EVERY
def test_channels_differ(name: str) -> None:
    u = from_yaml("excitation", name).signal(REQUEST, np.random.default_rng(0))
    assert np.abs(np.corrcoef(u.T)[0, 1]) < 0.9


@EVERY
def test_every_excitation_identifies_order_eight(name: str) -> None:
    u = from_yaml("excitation", name).signal(REQUEST, np.random.default_rng(0))
    assert persistency_order(u) >= 17


def test_levels_are_held_for_the_clock() -> None:
    u = from_yaml("excitation", "prbs").signal(REQUEST, np.random.default_rng(0))
    changes = np.flatnonzero(np.diff(u[:, 0])) + 1
    assert (changes % 5 == 0).all()


def test_a_prbs_is_a_maximum_length_sequence() -> None:
    """Its circular autocorrelation is -1/(2^n - 1) at every shift but zero."""
    length = 2**7 - 1
    request = Request(samples=length, step_s=1.0, amplitude=(1.0,), clock_s=1.0)
    u = PRBS(register_bits=7).signal(request, np.random.default_rng(0))[:, 0]
    correlation = np.fft.ifft(np.abs(np.fft.fft(u)) ** 2).real / length
    np.testing.assert_allclose(correlation[1:], -1 / length, atol=1e-12)


def test_coverage_tells_two_levels_from_many() -> None:
    plant, data = from_yaml("plant", "dc_motor"), from_yaml("data", "simulated", "trajectories=4", "test_samples=400")
    many = data.build(plant, from_yaml("excitation", "aprbs"), 0)
    two = data.build(plant, from_yaml("excitation", "prbs"), 0)
    assert input_coverage(many) > 0.8
    assert input_coverage(two) == pytest.approx(0.1)
    assert warn_if_two_level(many) is None
    with pytest.warns(SlopesNotIdentifiable, match="armature_voltage: 2 levels only"):
        warn_if_two_level(two)


@pytest.mark.parametrize("sines", [1, 3])
def test_a_sum_of_sines_is_persistently_exciting_of_twice_their_number(sines: int) -> None:
    t = np.arange(1000)
    u = sum(np.sin(2 * np.pi * (0.05 + 0.07 * k) * t + k) for k in range(sines))[:, None]
    assert persistency_order(u - 0.0) == 2 * sines
