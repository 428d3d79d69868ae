"""Each inequality of the measured disc, and each spectrum behind it, against its formula."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.robustness.bands import ANGLES, BANDS, assign_lines_to_bands, band_means
from ssm_study.robustness.coverage import (
    EMPTY,
    NO_MISMATCH,
    DiscWeights,
    ModelErrorSpectra,
    running_constraint_sum,
    squared_gain,
)
from ssm_study.robustness.coverage_items import (
    GROUPS,
    DiscRequirement,
    PeriodicErrorPower,
    requirement_from_measured_sine,
    requirement_from_sine,
    requirements_from_averaged_spectrum,
    requirements_from_periods,
)
from ssm_study.robustness.coverage_spectra import (
    AveragedSpectrum,
    MismatchSpectrum,
    averaged_spectrum,
    averaged_spectrum_in_loop,
    line_spectrum,
)
from ssm_study.robustness.record_errors import RecordErrors
from ssm_study.robustness.single_sines import SineMismatch

RNG = np.random.default_rng(0)
PERIOD = 128
LINES = PERIOD // 2 + 1
CENTRE = -0.3


def spectrum_of(noise: float = 0.1, input_power: Any = None) -> MismatchSpectrum:
    """Line spectra of two periods with two outputs."""
    shape = (2, LINES, 2)
    rng = np.random.default_rng(3)
    model = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    error = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    sides = np.full(LINES, 2.0)
    sides[[0, -1]] = 1.0
    powers = np.ones(LINES) if input_power is None else input_power
    return MismatchSpectrum(
        name="record",
        amplitude=1.0,
        angles=np.linspace(0, np.pi, LINES),
        sides=sides,
        model=model,
        error=error,
        input_power=powers,
        noise=np.full(LINES, noise),
    )


def requirement_of(seen: float, model: float = 1.0, input_: float = 1.0) -> DiscRequirement:
    """Inequality of two lines."""
    angles = np.array([0.5, 1.0])
    return DiscRequirement(
        record="record",
        place=f"seen {seen:g}",
        is_band=True,
        angles=angles,
        model_power=np.full(2, model),
        input_power=np.full(2, input_),
        seen=seen,
        dark=False,
    )


FILTER = np.array([[0.7, 1.0], [0.2, 0.1]])
WEIGHTS = DiscWeights(floor=0.2, output=FILTER, input=np.array([[0.3]]))


def test_a_weight_is_the_squared_gain_of_its_filter() -> None:
    angles = np.linspace(0, np.pi, 7)
    z = np.exp(1j * angles)
    response = 0.2 / (z - 0.7) + 0.1
    expected = np.abs(response) ** 2
    actual = squared_gain(FILTER, angles)
    np.testing.assert_allclose(actual, expected)
    of_output = WEIGHTS.output_weight(angles)
    np.testing.assert_allclose(of_output, 0.04 + expected)
    expected = np.full(7, 0.09)
    actual = WEIGHTS.input_weight(angles)
    np.testing.assert_allclose(actual, expected)


@given(st.floats(0.1, 10.0), st.floats(0.1, 10.0))
def test_a_radius_is_the_root_of_what_is_seen_over_its_reference(seen: float, scale: float) -> None:
    item = requirement_of(seen)
    reference = WEIGHTS.output_weight(item.angles).sum() + 2 * 0.09
    radius = WEIGHTS.required_radius(item)
    expected = pytest.approx(np.sqrt(seen / reference))
    assert radius == expected
    louder = requirement_of(scale**2 * seen)
    expected = pytest.approx(scale * radius)
    actual = WEIGHTS.required_radius(louder)
    assert actual == expected


def test_nothing_seen_needs_no_disc_and_no_reference_no_finite_one() -> None:
    silent = requirement_of(0.0, model=0.0, input_=0.0)
    assert WEIGHTS.required_radius(silent) == 0.0
    without_reference = requirement_of(1.0, model=0.0, input_=0.0)
    expected = np.inf
    actual = WEIGHTS.required_radius(without_reference)
    assert actual == expected
    items = [requirement_of(seen) for seen in (1.0, 4.0, 2.0)]
    need, label = WEIGHTS.largest_required_radius(items)
    expected = WEIGHTS.required_radius(items[1])
    assert need == expected
    assert label == "record, seen 4"
    expected = (0.0, "")
    actual = WEIGHTS.largest_required_radius([])
    assert actual == expected


def test_a_running_sum_is_deviation_less_reference() -> None:
    u, m, e = RNG.standard_normal((3, 50, 1))
    static = DiscWeights(floor=0.2, output=np.array([[0.5]]), input=np.array([[0.3]]))
    sums = running_constraint_sum(static, CENTRE, 1.5, u, m, e)
    deviation = (e - CENTRE * m) ** 2
    reference = (0.04 + 0.25) * m**2 + 0.09 * u**2
    expected = np.cumsum(deviation - 2.25 * reference)
    np.testing.assert_allclose(sums, expected)


@pytest.mark.parametrize("period", [PERIOD, PERIOD + 1])
def test_lines_have_the_power_of_the_signal(period: int) -> None:
    """Parseval: a line counts twice unless it is the mean or pi."""
    signal = RNG.standard_normal((period, 1))
    twice = np.concatenate([signal, signal])
    errors = RecordErrors(
        name="r", moving=twice, u=twice, model=2 * twice, e=3 * twice, start=0, period=period
    )
    noise = np.linspace(1.0, 2.0, BANDS)
    spectrum = line_spectrum(errors, noise)
    total = (signal**2).sum()
    ratio = (spectrum.sides @ spectrum.input_power) / total
    expected = pytest.approx(4 * ratio)
    actual = (spectrum.sides @ spectrum.model_power) / total
    assert actual == expected
    assert ratio == pytest.approx(period)
    expected = period * np.interp(spectrum.angles, ANGLES, noise)
    np.testing.assert_allclose(spectrum.noise, expected)
    expected = pytest.approx(np.sqrt(total / period))
    assert spectrum.amplitude == expected


def test_powers_of_two_periods_follow_their_formulas() -> None:
    record = spectrum_of()
    powers = PeriodicErrorPower.from_record(record, CENTRE)
    first, second = record.error - CENTRE * record.model
    repeats = record.sides * (first * second.conj()).real.sum(axis=1)
    np.testing.assert_allclose(powers.repeats, repeats)
    both = (np.abs(first) ** 2).sum(axis=1) + (np.abs(second) ** 2).sum(axis=1)
    expected = record.sides * both / 2
    np.testing.assert_allclose(powers.measured, expected)
    variance = record.sides * (record.sides * 0.01 / 2 + 0.1 * np.maximum(repeats, 0.0))
    np.testing.assert_allclose(powers.variance, variance)
    lines = np.zeros(LINES, dtype=bool)
    lines[3:9] = True
    certain = powers.error_power_at_lines(lines, is_doubtful=False)
    expected = pytest.approx(max(repeats[lines].sum(), 0.0))
    assert certain == expected
    doubtful = powers.error_power_at_lines(lines, is_doubtful=True)
    left = repeats[lines].sum() - 3 * np.sqrt(variance[lines].sum())
    expected = pytest.approx(max(left, 0.0))
    assert doubtful == expected
    dark = powers.error_power_at_lines(lines, is_doubtful=True, is_unexcited=True)
    expected = pytest.approx(powers.measured[lines].sum())
    assert dark == expected


def test_a_band_is_dark_below_a_hundredth_of_the_mean_drive() -> None:
    drive = np.ones(LINES)
    bands, counts = assign_lines_to_bands(LINES)
    drive[1:][bands == 4] = 0.009
    drive[1:][bands == 5] = 0.0101
    powers = PeriodicErrorPower.from_record(spectrum_of(input_power=drive), CENTRE)
    expected = [4]
    values = np.flatnonzero(powers.dark).tolist()
    assert values == expected
    assert powers.has_lines.all()
    assert powers.bands[0] == -1
    assert counts.sum() == LINES - 1
    means = band_means(drive)
    expected = pytest.approx(0.009)
    assert means[4] == expected


def test_bands_then_groups_then_the_total_are_required() -> None:
    record = spectrum_of()
    items = requirements_from_periods(record, CENTRE, has_no_doubt=True)
    per_size = [-(-BANDS // size) for size in GROUPS]
    expected = BANDS + sum(per_size) + 1
    assert len(items) == expected
    count = [item.is_band for item in items].count(True)
    assert count == BANDS
    first_group = items[BANDS]
    assert first_group.place == f"0.00 to {ANGLES[1]:.2f} rad/sample"
    last_group = items[-2]
    assert last_group.place.endswith(f"to {ANGLES[-1]:.2f} rad/sample")
    total = items[-1]
    expected = LINES - 1
    count = len(total.angles)
    assert count == expected
    covered = sum(len(item.angles) for item in items[:BANDS])
    assert covered == LINES - 1
    assert items[3].place == f"around {ANGLES[3]:.2f} rad/sample"
    weights = record.sides[1:] * record.model_power[1:]
    expected = pytest.approx(weights.sum())
    actual = total.model_power.sum()
    assert actual == expected
    doubtful = requirements_from_periods(record, CENTRE, has_no_doubt=False)
    expected = total.seen
    actual = doubtful[-1].seen
    assert actual == expected, "in total whatever repeats counts"
    pairs = zip(doubtful[:-1], items[:-1], strict=True)
    assert all(small.seen <= large.seen for small, large in pairs)


def test_a_group_is_dark_where_all_its_bands_are() -> None:
    drive = np.ones(LINES)
    bands, _ = assign_lines_to_bands(LINES)
    drive[1:][(bands == 2) | (bands == 3) | (bands == 5)] = 0.0
    record = spectrum_of(input_power=drive)
    items = requirements_from_periods(record, CENTRE, has_no_doubt=True)
    dark = [item.place for item in items if item.dark]
    bands_alone = [f"around {ANGLES[k]:.2f} rad/sample" for k in (2, 3, 5)]
    group = f"{ANGLES[2]:.2f} to {ANGLES[3]:.2f} rad/sample"
    assert dark == [*bands_alone, group]


def test_a_sine_counts_at_its_line_alone() -> None:
    drive = np.ones(LINES)
    drive[0] = 1e6
    drive[7] = 50.0
    record = spectrum_of(noise=0.0, input_power=drive)
    item = requirement_from_sine(record, CENTRE)
    expected = [record.angles[7]]
    values = item.angles.tolist()
    assert values == expected
    assert item.place == f"one sine at {record.angles[7]:.2f} rad/sample"
    powers = PeriodicErrorPower.from_record(record, CENTRE)
    expected = pytest.approx(max(powers.repeats[7], 0.0))
    assert item.seen == expected


@given(st.floats(-1, 1), st.floats(0, 0.1))
def test_a_measured_sine_leaves_three_standard_errors_out(centre: float, noise: float) -> None:
    sine = SineMismatch(
        angle=0.5,
        amplitude=0.25,
        gain=1.0,
        error_power=2.0,
        model_power=4.0,
        cross_power=0.5,
        noise_power=noise,
    )
    item = requirement_from_measured_sine(sine, centre)
    assert item is not None
    repeats = 2.0 - 2 * centre * 0.5 + centre**2 * 4.0
    error = 3 * np.sqrt(noise**2 / 2 + noise * repeats)
    expected = pytest.approx(max(repeats - error, 0.0))
    assert item.seen == expected
    assert item.label == "input of rms 0.25, one sine at 0.50 rad/sample"
    expected = [1.0]
    values = item.input_power.tolist()
    assert values == expected
    expected = [4.0]
    values = item.model_power.tolist()
    assert values == expected
    assert not item.dark
    for name in ("error_power", "cross_power"):
        older = replace(sine, **{name: None})
        assert requirement_from_measured_sine(older, centre) is None


def averaged_of(**changes: Any) -> AveragedSpectrum:
    """Averaged spectra of four bins."""
    values = {
        "model_power": np.array([1.0, 2.0, 3.0, 4.0]),
        "error_power": np.array([4.0, 3.0, 2.0, 1.0]),
        "cross": np.array([0.5, 0.5, -0.5, -0.5]),
        "input_power": np.array([1.0, 1.0, 1.0, 0.005]),
        "drawn": np.zeros(4),
        "sure": np.ones(4),
    }
    angles = np.linspace(0, np.pi, 4)
    return AveragedSpectrum(name="r", amplitude=1.0, angles=angles, **values | changes)


def test_noise_is_taken_off_before_an_average_is_made_sure() -> None:
    record = averaged_of()
    plain = record.error_power - 2 * CENTRE * record.cross + CENTRE**2 * record.model_power
    actual = record.error_power_about_centre(CENTRE)
    np.testing.assert_allclose(actual, plain)
    drawn = np.array([1.0, 9.0, 0.0, 0.0])
    noisy = averaged_of(drawn=drawn, sure=np.full(4, 1.2))
    expected = 1.2 * np.maximum(plain - 1.2 * drawn, 0.0)
    actual = noisy.error_power_about_centre(CENTRE)
    np.testing.assert_allclose(actual, expected)


def test_every_bin_and_the_total_are_required() -> None:
    record = averaged_of()
    *bins, total = requirements_from_averaged_spectrum(record, CENTRE)
    seen = record.error_power_about_centre(CENTRE)
    actual = [item.seen for item in bins]
    np.testing.assert_allclose(actual, seen)
    expected = pytest.approx(seen.sum())
    assert total.seen == expected
    expected = [False, False, False, True]
    actual = [item.dark for item in bins]
    assert actual == expected
    assert not total.dark
    assert not total.is_band
    assert total.label == "r, in total"
    expected = [1] * 4
    actual = [len(item.angles) for item in bins]
    assert actual == expected
    expected = [0.005]
    values = bins[3].input_power.tolist()
    assert values == expected


def test_in_a_loop_noise_is_known_or_white_as_in_the_quietest_bands() -> None:
    signal = RNG.standard_normal((2000, 1))
    errors = RecordErrors(name="r", moving=signal, u=signal, model=signal, e=2 * signal)
    in_open_loop = averaged_spectrum(errors)
    assert not in_open_loop.drawn.any()
    assert (in_open_loop.sure == 1).all()
    expected = 4 * in_open_loop.model_power
    np.testing.assert_allclose(in_open_loop.error_power, expected)
    expected = 2 * in_open_loop.model_power
    np.testing.assert_allclose(in_open_loop.cross, expected)
    in_loop = averaged_spectrum_in_loop(errors, None)
    sides = np.full(len(in_loop.angles), 2.0)
    sides[[0, -1]] = 1.0
    quiet = np.quantile(in_loop.error_power[1:-1], 0.25) / 2
    np.testing.assert_allclose(in_loop.drawn, sides * quiet)
    bands = len(in_loop.angles)
    factor = 1 + 3 * np.sqrt(1.06 * bands / 2000)
    expected = np.full(bands, factor)
    np.testing.assert_allclose(in_loop.sure, expected)
    known = averaged_spectrum_in_loop(errors, np.full(BANDS, 0.5))
    np.testing.assert_allclose(known.drawn, sides * 1000.0)


def test_records_that_say_nothing_have_a_reason() -> None:
    averaged = averaged_of()
    spectra = ModelErrorSpectra(repeating=(), averaged=(averaged,))
    assert spectra.insufficient_records_reason(0.0) is None
    assert not spectra.separates_noise
    known = replace(spectra, reason="no rest")
    assert known.insufficient_records_reason(0.0) == "no rest"
    still = averaged_of(model_power=np.zeros(4))
    empty = replace(spectra, averaged=(still,))
    assert empty.insufficient_records_reason(0.0) == EMPTY
    exact = averaged_of(error_power=np.zeros(4), cross=np.zeros(4))
    matched = replace(spectra, averaged=(exact,))
    assert matched.insufficient_records_reason(0.0) == NO_MISMATCH


def test_only_the_largest_repeating_record_counts_without_doubt() -> None:
    large = spectrum_of(noise=1.0)
    small = replace(large, amplitude=0.5)
    spectra = ModelErrorSpectra(repeating=(small, large), averaged=(), sines=(large,))
    assert spectra.separates_noise
    items = spectra.requirements(CENTRE)
    doubtful = requirements_from_periods(small, CENTRE, has_no_doubt=False)
    certain = requirements_from_periods(large, CENTRE, has_no_doubt=True)
    sine = requirement_from_sine(large, CENTRE)
    expected = [item.seen for item in (*doubtful, *certain, sine)]
    actual = [item.seen for item in items]
    assert actual == expected
