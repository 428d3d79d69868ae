"""Coverage from records by frequency, two ways; plants that must not come out as covered."""

from dataclasses import replace

import numpy as np
import pytest
from coverage_cases import (
    BALLS,
    MODEL,
    OUTPUT_ALONE,
    PERIOD,
    ZERO,
    design,
    linear,
    period,
    premise,
    records,
    respond,
    scaled_model,
)

from ssm_study.certificates.certificate import Design
from ssm_study.models.identified import SSM
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.coverage import (
    EMPTY,
    INTEGRATES,
    NO_MISMATCH,
    NOT_AT_REST,
    DiscWeights,
    ModelErrorSpectra,
    measure_error_spectra,
    running_constraint_sum,
)
from ssm_study.robustness.coverage_items import requirements_from_periods
from ssm_study.robustness.coverage_spectra import MismatchSpectrum, averaged_spectrum_in_loop
from ssm_study.robustness.coverage_table import coverage_table
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.record_errors import RecordErrors
from ssm_study.signals import Trajectory
from ssm_study.synthesis.measured_discs_run import (
    add_coverage_certificate,
    coverage_columns,
    disc_weights,
)
from ssm_study.systems import StateSpace


def covered(answer, **options) -> dict:
    known = premise(answer, **options)
    model = SSM.from_linear(MODEL, 0.01)
    certified = add_coverage_certificate(design(), model, BALLS, known)
    return coverage_columns(certified, model, known)


@pytest.mark.parametrize("share", [0.3, -0.4])
@pytest.mark.parametrize("centre", [0.0, -0.25])
def test_a_gain_that_is_wrong_needs_as_much_in_every_item(share: float, centre: float) -> None:
    items = premise(scaled_model(share)).requirements(centre)
    assert len(items) > 100
    for item in items:
        if item.model_power.sum() > 1e-9:
            need, _ = OUTPUT_ALONE.largest_required_radius([item])
            expected = abs(share - centre)
            assert need == pytest.approx(expected, rel=1e-6)


def test_every_line_but_the_mean_is_in_one_band() -> None:
    measured = premise(scaled_model(0.3))
    items = measured.requirements(0.0)
    record = items[0].record
    bands = [item for item in items if item.is_band and item.record == record]
    lines = np.concatenate([band.angles for band in bands])
    numbers = np.arange(1, PERIOD // 2 + 1)
    angles = 2 * np.pi * numbers / PERIOD
    actual = np.sort(lines)
    np.testing.assert_allclose(actual, angles)
    assert not any(0.0 in item.angles for item in items)


def test_an_offset_that_friction_leaves_is_no_mismatch_of_the_disc() -> None:
    """It stays where model and input have come to rest, so no disc bounds it."""
    needs = []
    for offset in (0.0, 0.3):
        measured = premise(lambda u, offset=offset: 1.2 * respond(MODEL, u) + offset)
        items = measured.requirements(0.0)
        output_alone = OUTPUT_ALONE.largest_required_radius(items)
        needs.append(output_alone[0])
    without_offset, with_offset = needs
    assert with_offset == pytest.approx(without_offset, rel=1e-6)


def test_noise_is_told_from_mismatch_where_an_input_repeats() -> None:
    noisy = premise(scaled_model(0.3), noise=0.02)
    requirements = noisy.requirements(0.0)
    totals = [item for item in requirements if item.label.endswith("in total")]
    need, _ = OUTPUT_ALONE.largest_required_radius(totals[1:])
    assert need == pytest.approx(0.3, rel=0.1)
    small = [item for item in requirements if item.label.startswith("input of rms 0.0")]
    highest = [item for item in small if "around 3.14" in item.label]
    assert highest[0].seen == 0.0


def test_a_record_that_does_not_repeat_counts_its_noise() -> None:
    rng = np.random.default_rng(2)
    u = rng.uniform(-1, 1, (2000, 1))
    model = SSM.from_linear(MODEL, 0.01)
    needs = []
    for noise in (0.0, 0.05):
        white_noise = rng.standard_normal(u.shape)
        y = 1.3 * respond(MODEL, u) + noise * white_noise
        trajectory = Trajectory(u=u, y=y, step_s=0.01)
        made = (trajectory,)
        mismatch = measure_model_error(model, made)
        known = measure_error_spectra(model, made, mismatch)
        assert not known.repeating
        items = known.requirements(0.0)
        need, _ = OUTPUT_ALONE.largest_required_radius(items)
        needs.append(need)
    without_noise, with_noise = needs
    assert without_noise == pytest.approx(0.3, rel=1e-6)
    assert with_noise > 1.0


def test_running_sums_grow_over_a_period_by_what_the_lines_say() -> None:
    """Parseval, the filters in their steady state: two routes to one number."""
    output = np.array([[0.7, 1.0], [0.2, 0.1]])
    weights_input = np.array([[0.5, 1.0], [0.1, 0.05]])
    weights = DiscWeights(floor=0.2, output=output, input=weights_input)
    centre = -0.25
    kappa = 1.3
    rng = np.random.default_rng(1)
    one = period(rng)
    one = one - one.mean()  # the mean is in no item
    u = np.concatenate([one, one, one])
    m = respond(MODEL, u)
    c = np.array([[1.1, 0.2]])
    plant = StateSpace(a=MODEL.a, b=MODEL.b, c=c, d=ZERO)
    e = respond(plant, u) - m
    sums = running_constraint_sum(weights, centre, kappa, u, m, e)
    second_period = sums[2 * PERIOD - 1]
    third_period = sums[3 * PERIOD - 1]
    growth = third_period - second_period
    of_plant = premise(linear(plant), amplitudes=(1.0,), shape=one)
    items = of_plant.requirements(centre)
    total = next(item for item in items if item.label.endswith("in total"))
    powers = weights.output_weight(total.angles)
    reference = powers @ total.model_power
    powers = weights.input_weight(total.angles)
    reference += powers @ total.input_power
    difference = total.seen - kappa**2 * reference
    expected = difference / PERIOD
    assert growth == pytest.approx(expected, rel=1e-6)


def test_a_model_that_is_a_little_wrong_is_covered() -> None:
    facts = covered(scaled_model(0.1))
    assert facts["coverage"] > 1
    assert "rms" in facts["coverage_reference"]


def resonance(size: float) -> StateSpace:
    """A mode of ratio 0.995 a sample at 2.26 rad/sample."""
    angle = 2.26
    radius = 0.995
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = [cosine, -sine]
    second_row = [sine, cosine]
    turn = radius * np.array([first_row, second_row])
    b = np.array([[size], [0.0]])
    c = np.array([[1.0, 0.5]])
    return StateSpace(a=turn, b=b, c=c, d=ZERO)


def radius_on(mode: StateSpace) -> float:
    """Spectral radius of the loop on the plant with that mode: of plant, mode and estimate."""
    gains = design().gains
    k = gains["k"]
    observer_gain = gains["l"]
    drive = MODEL.b @ k
    none = np.zeros((2, 2))
    estimate = MODEL.a + drive + observer_gain @ MODEL.c
    plant_row = [MODEL.a, none, drive]
    mode_row = [none, mode.a, mode.b @ k]
    from_plant = -observer_gain @ MODEL.c
    from_mode = -observer_gain @ mode.c
    observer_row = [from_plant, from_mode, estimate]
    rows = [plant_row, mode_row, observer_row]
    block_matrix = np.block(rows)
    eigenvalues = np.linalg.eigvals(block_matrix)
    spectral_radius = np.abs(eigenvalues).max()
    return float(spectral_radius)


SIZES = [-0.8, -0.2, -0.1, -0.05, 0.0, 0.05, 0.8]


@pytest.mark.parametrize("size", SIZES)
def test_a_lightly_damped_mode_that_loses_the_loop_is_not_covered(size: float) -> None:
    """The record is broadband; the loop swings at one frequency."""
    mode = resonance(size)
    facts = covered(lambda u: 1.001 * respond(MODEL, u) + respond(mode, u))
    coverage = facts["coverage"]
    if radius_on(mode) >= 1:
        assert coverage is None or coverage < 1
    if size == 0:
        assert facts["coverage"] > 1


def test_the_loop_is_lost_on_some_of_these_modes() -> None:
    losing = resonance(-0.05)
    assert radius_on(losing) > 1
    harmless = resonance(0.05)
    assert radius_on(harmless) < 1


def shape_without_high_frequencies() -> np.ndarray:
    """One period of an input without power above 1.2 rad/sample."""
    rng = np.random.default_rng(1)
    one_period = period(rng)
    lines = np.fft.rfft(one_period, axis=0)
    count = len(lines)
    angles = np.linspace(0, np.pi, count)
    lines[angles > 1.2] = 0
    return np.fft.irfft(lines, n=PERIOD, axis=0)


def test_a_band_without_excitation_is_no_coverage() -> None:
    """The input has no power above 1.2 rad/sample, the sensor's noise has: the band is named."""
    shape = shape_without_high_frequencies()
    facts = covered(scaled_model(0.05), shape=shape, noise=0.05)
    assert facts["coverage"] is None
    assert "next to no power" in facts["coverage_reason"]


UNEXCITED_MODES = [(-0.05, 0.05), (-0.05, 1e-4), (-0.2, 0.0)]


@pytest.mark.parametrize(("size", "noise"), UNEXCITED_MODES)
def test_a_mode_that_no_record_excites_is_no_coverage(size: float, noise: float) -> None:
    """A lightly damped mode above the excitation, on which this loop is lost."""
    mode = resonance(size)
    assert radius_on(mode) > 1
    shape = shape_without_high_frequencies()
    noisy = {"shape": shape, "noise": noise}
    facts = covered(lambda u: 1.05 * respond(MODEL, u) + respond(mode, u), **noisy)
    assert facts["coverage"] is None
    assert "next to no power" in facts["coverage_reason"]


def test_the_table_of_bands_is_the_premise_beside_the_proof() -> None:
    """A gain that is wrong by a tenth is measured as that in every band."""
    known = premise(scaled_model(0.1))
    model = SSM.from_linear(MODEL, 0.01)
    certified = add_coverage_certificate(design(), model, BALLS, known)
    part = certified.extra_certificates["coverage"]
    weights = disc_weights(part)
    rows = coverage_table(known, weights, part.centre, part.kappa)
    expected = 2 * len(ANGLES)
    assert len(rows) == expected
    for row in rows:
        expected = abs(0.1 - part.centre)
        assert row.measured == pytest.approx(expected, rel=1e-6)
        expected = row.need / part.kappa
        ratio = row.measured / row.proved_radius
        assert ratio == pytest.approx(expected)
    largest = max(row.need for row in rows)
    decisive = [row for row in rows if row.need == largest]
    assert decisive == [row for row in rows if row.decides]
    items = known.requirements(part.centre)
    upper_limit, _ = weights.largest_required_radius(items)
    assert largest <= upper_limit
    assert largest < part.kappa


def van_der_pol(u: np.ndarray) -> np.ndarray:
    x = np.array([0.5, 0.0])
    y = np.empty_like(u)
    for k in range(len(u)):
        y[k] = x[0]
        for _ in range(4):
            position, velocity = x
            damped = (1 - position**2) * velocity
            acceleration = damped - position + u[k, 0]
            x = x + 0.05 * np.array([velocity, acceleration])
    return y


def test_a_plant_with_a_cycle_of_its_own_is_never_covered() -> None:
    known = premise(van_der_pol)
    facts = covered(van_der_pol)
    assert known.reason == NOT_AT_REST
    expected = {"coverage": None, "coverage_reason": NOT_AT_REST}
    assert facts == expected


def test_a_model_that_integrates_has_no_premise() -> None:
    a = np.diag([1.0, 0.5])
    b = np.ones((2, 1))
    c = np.ones((1, 2))
    integrating = StateSpace(a=a, b=b, c=c, d=ZERO)
    model = SSM.from_linear(integrating, 0.01)
    made = records(scaled_model(0.1))
    mismatch = measure_model_error(model, made)
    shown = replace(mismatch, left_at_rest=None)
    known = measure_error_spectra(model, made, shown)
    assert known.insufficient_records_reason(0.0) == INTEGRATES


def test_an_empty_premise_is_refused() -> None:
    nothing = ModelErrorSpectra(repeating=(), averaged=())
    assert nothing.insufficient_records_reason(0.0) == EMPTY
    of_the_model = premise(scaled_model(0.0))
    assert of_the_model.insufficient_records_reason(0.0) == NO_MISMATCH
    model = SSM.from_linear(MODEL, 0.01)
    designed = design()
    unchanged = add_coverage_certificate(designed, model, BALLS, nothing)
    assert unchanged.extra_certificates == {}
    coverage = coverage_columns(designed, model, nothing)["coverage"]
    assert coverage is None


def test_stored_weights_are_not_trusted() -> None:
    """Ten times the weights at a tenth of kappa are the same proof; at the same kappa they are
    none, and a premise that is emptied takes the number away."""
    known = premise(scaled_model(0.1))
    model = SSM.from_linear(MODEL, 0.01)
    made = add_coverage_certificate(design(), model, BALLS, known)
    part = made.extra_certificates["coverage"]
    assert part.holds(**part.variables)

    def times(weight: np.ndarray, factor: float) -> np.ndarray:
        scaled = weight.copy()
        scaled[-1] *= factor
        return scaled

    floor = 10 * part.floor
    weight_output = times(part.weight_output, 10.0)
    weight_input = times(part.weight_input, 10.0)
    weights = {"weight_output": weight_output, "weight_input": weight_input}
    wider = replace(part, floor=floor, **weights)
    assert not wider.holds(**wider.variables)
    kappa = part.kappa / 10
    same = replace(wider, kappa=kappa)
    extra_certificates = {"coverage": same}
    forged = replace(made, extra_certificates=extra_certificates)
    honest = coverage_columns(made, model, known)
    coverage = coverage_columns(forged, model, known)["coverage"]
    assert coverage == pytest.approx(honest["coverage"])
    no_records = ModelErrorSpectra(repeating=(), averaged=())
    emptied = coverage_columns(made, model, no_records)
    expected = {"coverage": None, "coverage_reason": EMPTY}
    assert emptied == expected


def test_a_certificate_reads_back_to_the_same_numbers() -> None:
    known = premise(scaled_model(0.1))
    model = SSM.from_linear(MODEL, 0.01)
    made = add_coverage_certificate(design(), model, BALLS, known)
    stored = made.to_json()
    again = Design.from_json(stored)
    columns_of_again = coverage_columns(again, model, known)
    assert columns_of_again == coverage_columns(made, model, known)
    assert again.to_json() == stored


def test_a_short_period_has_bands_without_lines() -> None:
    """No item speaks of a band that no line lies in, and those that do are finite."""
    lines = 17  # a period of 32 samples, the shortest that counts: half of the bands hold no line
    rng = np.random.default_rng(0)
    real = rng.normal(size=(2, lines, 1))
    imaginary = rng.normal(size=(2, lines, 1))
    model = real + 1j * imaginary
    angles = np.linspace(0, np.pi, lines)
    both_sides = np.full(lines - 2, 2.0)
    sides = np.concatenate([[1.0], both_sides, [1.0]])
    answers = {"model": model, "error": 0.1 * model}
    powers = {"input_power": np.ones(lines), "noise": np.zeros(lines)}
    grid = {"angles": angles, "sides": sides}
    record = MismatchSpectrum(name="short", amplitude=1.0, **grid, **answers, **powers)
    items = requirements_from_periods(record, 0.0, has_no_doubt=True)
    for item in items:
        assert len(item.angles) > 0
        assert np.isfinite(item.seen)
        assert not item.dark
    of_bands = [item for item in items if " around " in item.label]
    assert len(of_bands) < len(ANGLES)


def test_white_noise_in_a_loop_is_taken_from_the_quietest_quarter_of_the_bands() -> None:
    rng = np.random.default_rng(0)
    still = np.zeros((20_000, 1))
    error = 0.3 * rng.standard_normal((20_000, 1))
    run = RecordErrors(name="a", moving=still, u=still, model=still, e=error)
    known = averaged_spectrum_in_loop(run, np.full(len(ANGLES), 0.09))
    read = averaged_spectrum_in_loop(run, None)
    ratio = read.drawn / known.drawn
    assert 0.7 < ratio.min() <= ratio.max() < 1.0
    assert np.mean(known.error_power < read.drawn) == pytest.approx(0.25, abs=0.02)
