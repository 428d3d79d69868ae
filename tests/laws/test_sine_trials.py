"""Single sines after the choice: the gain of one line, what noise hides is not zero, and a mismatch
that a broadband record dithers away refutes a prediction."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recorded import assert_as_recorded

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "oracles"))
from loop_cases import motor
from test_coverage import BALLS, MODEL, design, records, scaled_model

from ssm_study.bounds.frequency import frequency_response
from ssm_study.certificates.certificate import Design
from ssm_study.data.simulated import PERIOD, SINE_SHARES, simulate_sine_records
from ssm_study.models.identified import SSM
from ssm_study.robustness.coverage import measure_error_spectra
from ssm_study.robustness.coverage_items import (
    requirement_from_measured_sine,
    requirement_from_sine,
)
from ssm_study.robustness.coverage_spectra import line_spectrum
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.record_errors import RecordErrors
from ssm_study.robustness.sensitivity import error_to_input_response
from ssm_study.robustness.sine_trials import (
    SineMismatch,
    add_sines_to_mismatch,
    frequencies_to_test,
    frequency_of_smallest_margin,
    line_of_smallest_margin,
    measure_errors_at_sines,
    peak_frequencies,
    sensitive_spectral_lines,
)
from ssm_study.signals import Trajectory
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate
from ssm_study.synthesis.sine_judgement import (
    sine_columns,
    sine_coverage_columns,
    spectral_lines_to_test,
)
from ssm_study.synthesis.withheld_coverage import reported_coverage

SSM_MODEL = SSM.from_linear(MODEL, 0.01)
FAST = design(input_weight=1e-3)
SHARE = 0.2
NOISY_RECORDS = records(scaled_model(SHARE), noise=1e-3)
MISMATCH = measure_model_error(SSM_MODEL, NOISY_RECORDS)


def sine(answer, line: int, amplitude: float, noise: float, seed: int = 0) -> Trajectory:
    samples = np.arange(PERIOD)
    angles = 2 * np.pi * line * samples / PERIOD
    wave = amplitude * np.sin(angles)
    u = np.tile(wave[:, None], (3, 1))
    rng = np.random.default_rng(seed)
    white_noise = rng.standard_normal(u.shape)
    y = answer(u) + noise * white_noise
    return Trajectory(u=u, y=y, step_s=0.01, name="sine")


def measure_sines(*trials: Trajectory) -> list[SineMismatch]:
    """The mismatch of the model at each sine."""
    return measure_errors_at_sines(SSM_MODEL, trials, MISMATCH, PERIOD)


def error_gain(line: int) -> float:
    """The gain of the error's response at a line: a share of the model's own."""
    angles = np.array([2 * np.pi * line / PERIOD])
    response = frequency_response(MODEL, angles)
    return SHARE * abs(response[0, 0, 0])


def input_responses(angles: np.ndarray) -> np.ndarray:
    """Absolute response of the input to the error, in the fast design's loop."""
    loop = error_to_input_response(SSM_MODEL.linear, FAST.gain_pair, 1.0, 1.0)
    responses = frequency_response(loop, angles)
    return np.abs(responses[:, 0, 0])


@pytest.mark.parametrize("line", [5, 43, 128, 400])  # 128 repeats within a period, too
def test_a_sine_shows_the_gain_of_its_line(line: int) -> None:
    trial = sine(scaled_model(SHARE), line, 0.5, 1e-3)
    (measured,) = measure_sines(trial)
    expected = 2 * np.pi * line / PERIOD
    assert measured.angle == pytest.approx(expected)
    expected = 0.5 / np.sqrt(2)
    assert measured.amplitude == pytest.approx(expected, rel=1e-3)
    exact = error_gain(line)
    upper_limit = 1.05 * exact + 1e-3
    assert exact * 0.999 < measured.gain < upper_limit


@cache
def small_sines(share: float) -> list[SineMismatch]:
    """Forty small sines of one line measured, each with its noise."""
    answer = scaled_model(share)
    trials = [sine(answer, 43, 0.01, 1e-3, seed) for seed in range(40)]
    return measure_sines(*trials)


def gains_of_small_sines(share: float) -> np.ndarray:
    return np.array([trial.gain for trial in small_sines(share)])


def test_what_noise_hides_is_not_zero() -> None:
    """Without any mismatch the limit is that of the noise, and an upper one nearly always."""
    gains = gains_of_small_sines(0.0)
    assert gains.min() > 0
    noise_of_a_line = np.sqrt(2 / PERIOD)
    scale = 1e-3 / 0.01 * noise_of_a_line
    median = np.median(gains)
    assert 0.3 * scale < median < 3 * scale
    limits = gains_of_small_sines(SHARE)
    is_above = limits > error_gain(43)
    mean = np.mean(is_above)
    assert mean > 0.9


@pytest.mark.parametrize("share", [0.0, SHARE])
def test_a_limit_lies_two_standard_errors_above_what_repeats(share: float) -> None:
    measured = small_sines(share)
    powers = np.array([trial.error_power for trial in measured])
    limits = np.array([trial.gain**2 for trial in measured])
    repeats = np.maximum(powers, 0.0)
    twice = np.median(limits - repeats)
    stated = pytest.approx(twice / 2, rel=0.3)
    deviation = powers.std()
    assert deviation == stated


def test_a_sine_that_shows_more_than_the_records_refutes_the_prediction() -> None:
    before = predict_margins(SSM_MODEL, FAST.gain_pair, BALLS, MISMATCH)
    assert before.predicts_stability()
    first_line, *_ = sensitive_spectral_lines(SSM_MODEL, FAST.gain_pair, BALLS, PERIOD)
    angle = 2 * np.pi * first_line / PERIOD
    angles = np.array([angle])
    (peak,) = input_responses(angles)
    harmful = SineMismatch(angle=angle, amplitude=0.3, gain=1.2 / peak)
    facts = sine_columns(FAST, SSM_MODEL, BALLS, MISMATCH, [harmful])
    assert facts["predicted_stable"] is False
    assert facts["sine_margin"] < 1
    harmless = replace(harmful, gain=1e-6)
    facts = sine_columns(FAST, SSM_MODEL, BALLS, MISMATCH, [harmless])
    margin = before.resolved_margin
    expected = {"predicted_stable": True, "sine_margin": margin}
    assert facts == expected
    without_sines = sine_columns(FAST, SSM_MODEL, BALLS, MISMATCH, [])
    assert without_sines == {}


def test_a_sine_below_every_record_has_a_view_of_its_own() -> None:
    smallest = MISMATCH.views[0]
    amplitude = smallest.amplitude / 10
    tiny = SineMismatch(angle=0.3, amplitude=amplitude, gain=5.0)
    mismatch = add_sines_to_mismatch(MISMATCH, [tiny])
    views = mismatch.views
    expected = len(MISMATCH.views) + 1
    assert len(views) == expected
    amplitude = views[0].amplitude
    assert amplitude == tiny.amplitude
    actual = views[1].by_frequency
    np.testing.assert_array_equal(actual, smallest.by_frequency)
    by_frequency = views[0].by_frequency
    angles = np.linspace(0, np.pi, 33)
    interpolated_values = np.interp(0.3, angles, by_frequency)
    assert interpolated_values == pytest.approx(5.0)


def test_the_trials_lie_at_the_peaks_of_the_sensitivity() -> None:
    lines = sensitive_spectral_lines(SSM_MODEL, FAST.gain_pair, BALLS, PERIOD)
    assert 1 <= len(lines) <= 2
    angles = 2 * np.pi * np.arange(4, PERIOD // 2) / PERIOD
    size = input_responses(angles)
    at_lines = [size[line - 4] for line in lines]
    largest = max(at_lines)
    assert largest > 0.99 * size.max()


def test_the_line_where_the_records_decide_the_margin_is_tried_last() -> None:
    """The frequency of the largest `g |T_ue|`, which the peak of `|T_ue|` alone may miss."""
    lines = spectral_lines_to_test(FAST, SSM_MODEL, BALLS, MISMATCH, PERIOD)
    at_peaks = sensitive_spectral_lines(SSM_MODEL, FAST.gain_pair, BALLS, PERIOD)
    assert lines[: len(at_peaks)] == at_peaks
    judged = (FAST, SSM_MODEL, BALLS, MISMATCH, PERIOD)
    assert spectral_lines_to_test(*judged, only_peaks=True) == at_peaks
    deciding = line_of_smallest_margin(SSM_MODEL, FAST.gain_pair, BALLS, MISMATCH, PERIOD)
    assert deciding in lines
    mismatch = mismatch_in_one_band(7)
    line = line_of_smallest_margin(SSM_MODEL, FAST.gain_pair, BALLS, mismatch, PERIOD)
    assert line is not None
    angle = 2 * np.pi * line / PERIOD
    band_angle = 7 * np.pi / 32
    assert abs(angle - band_angle) < np.pi / 32


def mismatch_in_one_band(band: int) -> Mismatch:
    """Records whose model error is large in one frequency band and has no phase to use."""
    view = MISMATCH.views[-1]
    gain_at_one_band = 1e-6 * np.ones(33)
    gain_at_one_band[band] = 0.1
    no_linear_part = 0 * view.linear
    peaked = replace(
        view, by_frequency=gain_at_one_band, linear=no_linear_part, rest=gain_at_one_band
    )
    return replace(MISMATCH, views=(peaked,))


def test_a_real_plant_is_also_tried_where_its_records_leave_the_smallest_margin() -> None:
    """After the peaks of the sensitivity, and only once: not beside a peak."""
    gains = FAST.gain_pair
    peaks = peak_frequencies(SSM_MODEL, gains, BALLS)[:2]
    far_from_peaks = mismatch_in_one_band(7)
    deciding = frequency_of_smallest_margin(SSM_MODEL, gains, BALLS, far_from_peaks)
    assert deciding is not None
    assert min(abs(peak / deciding - 1) for peak in peaks) > 0.1
    angles = frequencies_to_test(SSM_MODEL, gains, BALLS, far_from_peaks)
    assert angles == (*peaks, deciding)
    band_of_peak = round(peaks[0] * 32 / np.pi)
    near_a_peak = mismatch_in_one_band(band_of_peak)
    angles = frequencies_to_test(SSM_MODEL, gains, BALLS, near_a_peak)
    assert angles == tuple(peaks)
    silent = replace(MISMATCH, views=())
    angles = frequencies_to_test(SSM_MODEL, gains, BALLS, silent)
    assert angles == tuple(peaks)


def test_records_without_a_mismatch_decide_at_no_line() -> None:
    view = MISMATCH.views[-1]
    zero = np.zeros(33)
    no_linear_part = 0 * view.linear
    silent = replace(view, by_frequency=zero, linear=no_linear_part, rest=zero)
    mismatch = replace(MISMATCH, views=(silent,))
    line = line_of_smallest_margin(SSM_MODEL, FAST.gain_pair, BALLS, mismatch, PERIOD)
    assert line is None


def test_where_no_noise_is_known_nothing_is_tried() -> None:
    unknown = replace(MISMATCH, noise=())
    assert spectral_lines_to_test(FAST, SSM_MODEL, BALLS, unknown, PERIOD) == []
    lines = spectral_lines_to_test(FAST, SSM_MODEL, BALLS, MISMATCH, PERIOD)
    assert len(lines) > 0


def test_the_simulated_sines_repeat_and_reach_down_to_a_hundredth() -> None:
    plant = motor()
    rng = np.random.default_rng(0)
    deviation = np.zeros(1)
    lines = [43, 128]
    trials = simulate_sine_records(plant, rng, deviation, lines)
    expected = 2 * len(SINE_SHARES)
    assert len(trials) == expected
    assert min(SINE_SHARES) == 0.01
    for trial in trials:
        u = trial.u[:, 0]
        actual = u[PERIOD : 2 * PERIOD]
        expected = u[2 * PERIOD :]
        np.testing.assert_array_equal(actual, expected)
    rest = plant.equilibrium().u
    reaches = [np.abs(trial.u - rest).max() for trial in trials]
    largest = float(max(reaches))
    expected = plant.input_amplitude[0]
    assert largest == pytest.approx(expected, rel=1e-3)
    rng = np.random.default_rng(0)
    deviation = np.zeros(1)
    sine_records = simulate_sine_records(plant, rng, deviation, [])
    assert sine_records == ()


@pytest.fixture(scope="module")
def covered() -> tuple[Design, float]:
    """A design whose proof covers the records, and its coverage."""
    noisy_records = records(scaled_model(SHARE), noise=1e-3)
    premise = measure_error_spectra(SSM_MODEL, (), MISMATCH, 0, noisy_records)
    proved = add_coverage_certificate(FAST, SSM_MODEL, BALLS, premise)
    coverage = reported_coverage(proved, SSM_MODEL, premise)
    assert coverage is not None
    assert coverage > 1
    return proved, coverage


@pytest.mark.parametrize("centre", [0.0, -0.25])
def test_a_sine_asks_of_the_disc_what_its_record_asks(centre: float) -> None:
    """Two routes: from the stored powers of the sine, and from its record's spectrum."""
    trial = sine(scaled_model(SHARE), 43, 0.5, 1e-3)
    (measured,) = measure_sines(trial)
    item = requirement_from_measured_sine(measured, centre)
    errors = RecordErrors.from_record(SSM_MODEL, trial, 0)
    last_two_periods = replace(errors, start=PERIOD, period=PERIOD)
    noise = np.array(MISMATCH.noise)
    spectrum = line_spectrum(last_two_periods, noise)
    other = requirement_from_sine(spectrum, centre)
    assert item is not None
    input_power = other.input_power.sum()
    power_ratio = other.seen / input_power
    np.testing.assert_allclose(item.seen, power_ratio, rtol=1e-9)
    model_power_ratio = other.model_power / input_power
    np.testing.assert_allclose(item.model_power, model_power_ratio, rtol=1e-9)
    np.testing.assert_allclose(item.angles, other.angles)


def test_the_proof_covers_only_what_it_covers_at_the_sines(covered: tuple[Design, float]) -> None:
    proved, coverage = covered
    trial = sine(scaled_model(SHARE), 43, 0.5, 1e-3)
    (usual,) = measure_sines(trial)
    facts = sine_coverage_columns(proved, [usual], coverage)
    assert facts["sine_coverage"] > 1
    assert usual.error_power is not None
    larger_gain = 2 * facts["sine_coverage"]
    error_power = usual.error_power * larger_gain**2
    larger = replace(usual, error_power=error_power)
    facts = sine_coverage_columns(proved, [usual, larger], coverage)
    smaller_coverage = facts["coverage"]
    assert smaller_coverage == facts["sine_coverage"]
    assert smaller_coverage == pytest.approx(0.5, rel=0.1)
    assert "one sine at" in facts["coverage_reference"]


def test_without_a_coverage_or_powers_the_sines_change_none(covered: tuple[Design, float]) -> None:
    proved, coverage = covered
    gain_alone = SineMismatch(angle=0.3, amplitude=0.3, gain=5.0)
    null = {"sine_coverage": None}
    assert sine_coverage_columns(proved, [gain_alone], coverage) == null
    assert sine_coverage_columns(proved, [], coverage) == {}
    powers = {"error_power": 25.0, "model_power": 1.0}
    no_power = {"cross_power": 0.0, "noise_power": 0.0}
    harmful = replace(gain_alone, **powers, **no_power)
    assert sine_coverage_columns(proved, [harmful], None) == null
    assert sine_coverage_columns(FAST, [harmful], coverage) == null
    facts = sine_coverage_columns(proved, [harmful], coverage)
    assert facts["coverage"] < 1


def test_small_sines_have_the_recorded_mismatch() -> None:
    assert_as_recorded("sine_trials", small_sines(0.0), 1e-3)
