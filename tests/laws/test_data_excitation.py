"""The laws of `Excitation`, for every yaml of conf/excitation, and what is special to each kind."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plants_cases import choices, from_yaml

from ssm_study.data.excitations.excitation import PRBS, SignalRequest
from ssm_study.data.excitations.file_signal import OwnSignal
from ssm_study.data.excitations.multisine import Multisine
from ssm_study.data.metrics import (
    SlopesNotIdentifiable,
    input_coverage,
    persistency_order,
    warn_if_two_level,
)
from ssm_study.refusal import BadRequest

REQUEST = SignalRequest(samples=600, step_s=0.01, amplitude=(4.0, 0.5), clock_s=0.05)
EVERY = pytest.mark.parametrize("name", choices("excitation"))


@EVERY
def test_signals_stay_within_the_amplitude_and_use_it(name: str) -> None:
    rng = np.random.default_rng(0)
    u = from_yaml("excitation", name).signal(REQUEST, rng)
    assert u.shape == (600, 2)
    upper_limit = np.array(REQUEST.amplitude) * (1 + 1e-12)
    assert (np.abs(u) <= upper_limit).all()
    lower_limit = 0.7 * np.array(REQUEST.amplitude)
    largest = np.abs(u).max(axis=0)
    assert (largest > lower_limit).all()


@EVERY
def test_equal_generators_give_equal_signals_and_others_do_not(name: str) -> None:
    excitation = from_yaml("excitation", name)
    rng = np.random.default_rng(3)
    first = excitation.signal(REQUEST, rng)
    rng = np.random.default_rng(3)
    expected = excitation.signal(REQUEST, rng)
    np.testing.assert_array_equal(first, expected)
    rng = np.random.default_rng(4)
    second = excitation.signal(REQUEST, rng)
    assert not np.array_equal(first, second)


@EVERY
def test_channels_differ(name: str) -> None:
    rng = np.random.default_rng(0)
    u = from_yaml("excitation", name).signal(REQUEST, rng)
    correlation = np.corrcoef(u.T)[0, 1]
    assert np.abs(correlation) < 0.9


@EVERY
def test_every_excitation_identifies_order_eight(name: str) -> None:
    """With a clock of twice the sampling time; band-limited signals reach less at slower clocks,
    and should."""
    rng = np.random.default_rng(0)
    faster = replace(REQUEST, clock_s=0.02)
    u = from_yaml("excitation", name).signal(faster, rng)
    assert persistency_order(u) >= 17


def test_levels_are_held_for_the_clock() -> None:
    rng = np.random.default_rng(0)
    u = from_yaml("excitation", "prbs").signal(REQUEST, rng)
    differences = np.diff(u[:, 0])
    indices = np.flatnonzero(differences)
    changes = indices + 1
    assert (changes % 5 == 0).all()


def test_a_prbs_is_a_maximum_length_sequence() -> None:
    """Its circular autocorrelation is -1/(2^n - 1) at every shift but zero."""
    length = 2**7 - 1
    request = SignalRequest(samples=length, step_s=1.0, amplitude=(1.0,), clock_s=1.0)
    prbs = PRBS(register_bits=7)
    rng = np.random.default_rng(0)
    u = prbs.signal(request, rng)[:, 0]
    spectrum = np.abs(np.fft.fft(u))
    correlation = np.fft.ifft(spectrum**2).real / length
    actual = correlation[1:]
    np.testing.assert_allclose(actual, -1 / length, atol=1e-12)


def test_coverage_tells_two_levels_from_many() -> None:
    plant = from_yaml("plant", "dc_motor")
    data = from_yaml("data", "simulated", "trajectories=4", "test_samples=400")
    aprbs = from_yaml("excitation", "aprbs")
    many = data.build(plant, aprbs, 0)
    prbs = from_yaml("excitation", "prbs")
    two = data.build(plant, prbs, 0)
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


ONE = SignalRequest(samples=1000, step_s=0.01, amplitude=(2.0,), clock_s=0.05)


def test_a_multisine_has_equal_power_in_its_band_and_none_outside() -> None:
    multisine = Multisine(band_low_hz=1.0, band_high_hz=5.0)
    rng = np.random.default_rng(0)
    u = multisine.signal(ONE, rng)
    frequencies = np.fft.rfftfreq(len(u), ONE.step_s)
    spectrum = np.fft.rfft(u[:, 0])
    amplitude = 2 * np.abs(spectrum) / len(u)
    inside = (frequencies > 0.99) & (frequencies < 5.01)
    assert inside.sum() == 41
    expected = amplitude[inside].mean()
    np.testing.assert_allclose(amplitude[inside], expected, rtol=1e-9)
    actual = amplitude[~inside]
    np.testing.assert_allclose(actual, 0.0, atol=1e-12)


def crest_factor(u: np.ndarray) -> float:
    """`max |u| / rms(u)`: 1 for two levels, sqrt(2) for a sine."""
    largest = np.abs(u).max()
    mean = np.mean(u**2)
    return float(largest / np.sqrt(mean))


@pytest.mark.parametrize("seed", range(5))
def test_clipping_lowers_the_crest_factor(seed: int) -> None:
    multisine = Multisine(crest_iterations=0)
    rng = np.random.default_rng(seed)
    random = multisine.signal(ONE, rng)[:, 0]
    rng = np.random.default_rng(seed)
    signal = Multisine().signal(ONE, rng)
    clipped = signal[:, 0]
    assert crest_factor(clipped) < 0.75 * crest_factor(random)
    assert crest_factor(clipped) < 2.0


def test_a_chirp_sweeps_its_band() -> None:
    rng = np.random.default_rng(0)
    chirp = from_yaml("excitation", "chirp", "low_hz=1.0", "high_hz=4.0")
    u = chirp.signal(ONE, rng)
    signs = np.sign(u[:, 0])
    differences = np.diff(signs)
    crossings = np.flatnonzero(differences)
    differences = np.diff(crossings)
    halves = differences * ONE.step_s
    first_hz = 0.5 / halves[0]
    assert first_hz == pytest.approx(1.0, rel=0.2)
    last_hz = 0.5 / halves[-1]
    assert last_hz == pytest.approx(4.0, rel=0.2)


def test_a_staircase_holds_uniform_levels() -> None:
    rng = np.random.default_rng(0)
    staircase = from_yaml("excitation", "staircase")
    u = staircase.signal(ONE, rng)[:, 0]
    actual = np.unique(u)
    expected = np.linspace(-2.0, 2.0, 11)
    np.testing.assert_allclose(actual, expected, atol=1e-12)
    differences = np.diff(u)
    indices = np.flatnonzero(differences)
    differences = np.diff(indices)
    assert (differences == 15).all()


def test_a_file_is_taken_as_it_is(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(-3, 3, 1500)
    table = pd.DataFrame({"volt": values})
    table.to_csv(tmp_path / "u.csv", index=False)
    path = str(tmp_path / "u.csv")
    own_signal = OwnSignal(path=path, column="volt")
    rng = np.random.default_rng(0)
    u = own_signal.signal(ONE, rng)[:, 0]
    position_of_largest = np.argmax(values == u[0])
    start = int(position_of_largest)
    expected = values[start : start + 1000]
    np.testing.assert_array_equal(u, expected)
    plant = from_yaml("plant", "dc_motor")
    asked = from_yaml("data", "simulated", "samples=1000", "trajectories=2")
    path = str(tmp_path / "u.csv")
    own = OwnSignal(path=path, column="volt")
    for record in asked.build(plant, own, 0).training:  # from rest on, as the file has it
        rest = plant.equilibrium().u[0]
        applied = record.u[:, 0] - rest
        difference = np.abs(values - applied[0])
        position_of_smallest = difference.argmin()
        start = int(position_of_smallest)
        expected = values[start : start + 1000]
        np.testing.assert_allclose(applied, expected, atol=1e-12)
    path = str(tmp_path / "u.csv")
    scaled = OwnSignal(path=path, column="volt", amplitude=1.0)
    rng = np.random.default_rng(0)
    largest = np.abs(scaled.signal(ONE, rng)).max()
    assert largest <= 1.0
    long = SignalRequest(samples=2000, step_s=0.01, amplitude=(1.0,), clock_s=0.1)
    path = str(tmp_path / "u.csv")
    own_signal = OwnSignal(path=path, column="volt")
    rng = np.random.default_rng(0)
    with pytest.raises(BadRequest, match="has 1500 rows and records of 2000 samples"):
        own_signal.signal(long, rng)
    path = str(tmp_path / "u.csv")
    own_signal = OwnSignal(path=path, column="volt")
    rng = np.random.default_rng(0)
    with pytest.raises(BadRequest, match="the plant has 2 inputs"):
        own_signal.signal(REQUEST, rng)


def test_a_band_without_lines_is_refused() -> None:
    multisine = Multisine(band_low_hz=1.0, band_high_hz=1.05)
    rng = np.random.default_rng(0)
    with pytest.raises(BadRequest, match="holds 1 frequencies"):
        multisine.signal(ONE, rng)
    with pytest.raises(BadRequest, match="not below band_high_hz"):
        Multisine(band_low_hz=2.0, band_high_hz=1.0)
