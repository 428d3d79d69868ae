"""The laws of `Excitation`, for every yaml of conf/excitation, and what is special to each kind."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plants_cases import choices, from_yaml

from ssm_study.data.excitations.excitation import PRBS, SignalRequest
from ssm_study.data.excitations.file_signal import FileSignal
from ssm_study.data.excitations.multisine import Multisine
from ssm_study.data.metrics import (
    UnidentifiableSlopesWarning,
    input_coverage,
    persistency_order,
    warn_of_two_level_input,
)
from ssm_study.refusal import BadRequest

SAMPLED = {"samples": 600, "step_s": 0.01}
REQUEST = SignalRequest(amplitude=(4.0, 0.5), clock_s=0.05, **SAMPLED)
AMPLITUDE = np.array(REQUEST.amplitude)
EVERY = pytest.mark.parametrize("name", choices("excitation"))


def make_signal(name: str, request: SignalRequest) -> np.ndarray:
    """The signal of a yaml, drawn from seed zero."""
    rng = np.random.default_rng(0)
    excitation = from_yaml("excitation", name)
    return excitation.signal(request, rng)


@EVERY
def test_signals_stay_within_the_amplitude_and_use_it(name: str) -> None:
    u = make_signal(name, REQUEST)
    assert u.shape == (600, 2)
    upper_limit = AMPLITUDE * (1 + 1e-12)
    size = np.abs(u)
    assert (size <= upper_limit).all()
    lower_limit = 0.7 * AMPLITUDE
    largest = size.max(axis=0)
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
    u = make_signal(name, REQUEST)
    correlations = np.corrcoef(u.T)
    correlation = correlations[0, 1]
    assert np.abs(correlation) < 0.9


@EVERY
def test_every_excitation_identifies_order_eight(name: str) -> None:
    """With a clock of twice the sampling time; band-limited signals reach less at slower clocks,
    and should."""
    faster = replace(REQUEST, clock_s=0.02)
    u = make_signal(name, faster)
    assert persistency_order(u) >= 17


@pytest.mark.parametrize(("samples", "inputs", "order"), [(11, 1, 6), (20, 2, 7)])
def test_a_short_record_excites_as_many_rows_as_it_has_columns(
    samples: int, inputs: int, order: int
) -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((samples, inputs))
    assert persistency_order(u) == order


def test_levels_are_held_for_the_clock() -> None:
    u = make_signal("prbs", REQUEST)
    differences = np.diff(u[:, 0])
    indices = np.flatnonzero(differences)
    changes = indices + 1
    assert (changes % 5 == 0).all()


def test_a_prbs_is_a_maximum_length_sequence() -> None:
    """Its circular autocorrelation is -1/(2^n - 1) at every shift but zero."""
    length = 2**7 - 1
    unit_step = {"samples": length, "step_s": 1.0}
    request = SignalRequest(amplitude=(1.0,), clock_s=1.0, **unit_step)
    prbs = PRBS(register_bits=7)
    rng = np.random.default_rng(0)
    signal = prbs.signal(request, rng)
    spectrum = np.abs(np.fft.fft(signal[:, 0]))
    power = spectrum**2
    correlation = np.fft.ifft(power).real / length
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
    assert warn_of_two_level_input(many) is None
    with pytest.warns(UnidentifiableSlopesWarning, match="armature_voltage: 2 levels only"):
        warn_of_two_level_input(two)


@pytest.mark.parametrize("sines", [1, 3])
def test_a_sum_of_sines_is_persistently_exciting_of_twice_their_number(sines: int) -> None:
    t = np.arange(1000)
    u = np.zeros(1000)
    for k in range(sines):
        frequency = 0.05 + 0.07 * k
        u += np.sin(2 * np.pi * frequency * t + k)
    assert persistency_order(u[:, None]) == 2 * sines


OF_ONE_INPUT = {"step_s": 0.01, "clock_s": 0.05}
ONE = SignalRequest(samples=1000, amplitude=(2.0,), **OF_ONE_INPUT)


def test_a_multisine_has_equal_power_in_its_band_and_none_outside() -> None:
    multisine = Multisine(band_low_hz=1.0, band_high_hz=5.0)
    rng = np.random.default_rng(0)
    u = multisine.signal(ONE, rng)
    samples = len(u)
    frequencies = np.fft.rfftfreq(samples, ONE.step_s)
    spectrum = np.fft.rfft(u[:, 0])
    amplitude = 2 * np.abs(spectrum) / samples
    inside = (frequencies > 0.99) & (frequencies < 5.01)
    assert inside.sum() == 41
    in_band = amplitude[inside]
    expected = in_band.mean()
    np.testing.assert_allclose(in_band, expected, rtol=1e-9)
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
    signal = multisine.signal(ONE, rng)
    random_crest = crest_factor(signal[:, 0])
    rng = np.random.default_rng(seed)
    signal = Multisine().signal(ONE, rng)
    clipped_crest = crest_factor(signal[:, 0])
    assert clipped_crest < 0.75 * random_crest
    assert clipped_crest < 2.0


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
    signal = staircase.signal(ONE, rng)
    u = signal[:, 0]
    actual = np.unique(u)
    expected = np.linspace(-2.0, 2.0, 11)
    np.testing.assert_allclose(actual, expected, atol=1e-12)
    differences = np.diff(u)
    indices = np.flatnonzero(differences)
    differences = np.diff(indices)
    assert (differences == 15).all()


def position_of(value: float, values: np.ndarray) -> int:
    """The position of the entry that is nearest to a value."""
    difference = np.abs(values - value)
    return int(difference.argmin())


def test_a_file_is_taken_as_it_is(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(-3, 3, 1500)
    table = pd.DataFrame({"volt": values})
    path = tmp_path / "u.csv"
    table.to_csv(path, index=False)
    column = {"path": str(path), "column": "volt"}
    own_signal = FileSignal(**column)
    rng = np.random.default_rng(0)
    u = own_signal.signal(ONE, rng)[:, 0]
    start = position_of(u[0], values)
    expected = values[start : start + 1000]
    np.testing.assert_array_equal(u, expected)
    plant = from_yaml("plant", "dc_motor")
    spec = from_yaml("data", "simulated", "samples=1000", "trajectories=2")
    data = spec.build(plant, own_signal, 0)
    rest = plant.equilibrium().u[0]
    for record in data.training:  # from rest on, as the file has it
        applied = record.u[:, 0] - rest
        start = position_of(applied[0], values)
        expected = values[start : start + 1000]
        np.testing.assert_allclose(applied, expected, atol=1e-12)
    scaled = FileSignal(amplitude=1.0, **column)
    rng = np.random.default_rng(0)
    size = np.abs(scaled.signal(ONE, rng))
    assert size.max() <= 1.0
    long = replace(ONE, samples=2000, amplitude=(1.0,), clock_s=0.1)
    rng = np.random.default_rng(0)
    with pytest.raises(BadRequest, match="has 1500 rows, fewer than the 2000 samples"):
        own_signal.signal(long, rng)
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
