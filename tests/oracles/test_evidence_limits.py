"""Each limit of a finding from both sides: the last case that says nothing beside the first that
does."""

from dataclasses import replace

import numpy as np
import pytest
from test_evidence_false_reasons import sentences
from test_evidence_response import LEVELS, WHITE, answer, case

from ssm_study.data.assembly import assemble_dataset
from ssm_study.evidence import autonomous_motion, fit, records, response
from ssm_study.evidence.finding import EvidenceCase, findings_by_size
from ssm_study.models.metrics import Simulation
from ssm_study.signals import Channel, DataSet, Trajectory
from ssm_study.systems import StateSpace

MODEL = case(WHITE, WHITE).model
INPUT = Channel(name="a", unit="")
OUTPUT = Channel(name="b", unit="")
REST = (np.zeros(1), np.zeros(1))
SLIGHTLY = 2.0**-10


def alternate(samples: int) -> np.ndarray:
    """One, minus one, and so on: mean zero, deviation one."""
    return np.resize([1.0, -1.0], samples)


def record_of(signal: np.ndarray) -> Trajectory:
    """A record whose output is its input."""
    column = signal[:, None]
    return Trajectory(u=column, y=column, step_s=0.1)


def data_of(*signals: np.ndarray) -> DataSet:
    """One record that trains, one that validates, one that tests."""
    parts = tuple([record_of(signal)] for signal in signals)
    return assemble_dataset(parts, REST, ((INPUT,), (OUTPUT,)), 0)


def miss(records: tuple[Trajectory, ...], error: np.ndarray) -> Simulation:
    """The free run that misses a record by this error."""
    run = records[0].y - error[:, None]
    return Simulation(records=records, simulated=(run,), start_up_samples=0)


def case_of(data: DataSet, error: np.ndarray, test_error: np.ndarray) -> EvidenceCase:
    validation = miss(data.validation, error)
    test = miss(data.test, test_error)
    return EvidenceCase(data=data, model=MODEL, validation=validation, test=test)


def case_of_one(signal: np.ndarray, error: np.ndarray | float = 0.0) -> EvidenceCase:
    """The same signal trains, validates and tests, with the same error."""
    data = data_of(signal, signal, signal)
    errors = error * np.ones(len(signal))
    return case_of(data, errors, errors)


def missing_shares(validation: float, test: float, samples: int = 300) -> EvidenceCase:
    """Free runs that miss these shares of validation and test: the fits are 100 (1 - share)."""
    signal = alternate(samples)
    data = data_of(signal, signal, signal)
    return case_of(data, validation * signal, test * signal)


def levels_of(findings) -> list[str]:
    return [finding.level for finding in findings]


SIZES = [(0.9, []), (1.0, ["doubt"]), (1.9, ["doubt"]), (2.0, ["cannot judge"])]


@pytest.mark.parametrize(("size", "expected"), SIZES)
def test_a_number_at_its_limit_counts(size, expected):
    findings = findings_by_size(size, 1.0, 2.0, "a")
    assert levels_of(findings) == expected


@pytest.fixture
def no_filter(monkeypatch):
    """A linear filter that fits nothing."""
    monkeypatch.setattr(fit, "fir_fit_percent", lambda _: 0.0)


ABOVE_HALF = 0.5 + SLIGHTLY
PARTS_APART = [(0.5, 300, False), (ABOVE_HALF, 300, True), (0.6, 299, False)]


@pytest.mark.usefixtures("no_filter")
@pytest.mark.parametrize(("share", "samples", "is_doubted"), PARTS_APART)
def test_two_parts_may_differ_by_25_points_of_fit(share, samples, is_doubted):
    judged = missing_shares(0.25, share, samples)
    text = sentences(fit.judge_fit(judged))
    assert text.startswith("Validation fits by 75 %") is is_doubted


FILTERS = [(60.0, []), (60.1, ["doubt"])]


@pytest.mark.parametrize(("linear", "expected"), FILTERS)
def test_a_filter_may_be_ten_points_better(linear, expected, monkeypatch):
    monkeypatch.setattr(fit, "fir_fit_percent", lambda _: linear)
    judged = missing_shares(0.25, 0.5)
    findings = fit.judge_fit(judged)
    assert levels_of(findings) == expected


BELOW_HALF = 0.5 - SLIGHTLY
POOR = [(BELOW_HALF, []), (0.5, ["doubt"]), (0.795, ["doubt"]), (0.805, ["cannot judge"])]


@pytest.mark.parametrize(("share", "expected"), POOR)
def test_a_fit_of_half_is_a_doubt_and_a_fifth_forbids_a_judgement(share, expected):
    judged = missing_shares(share, share)
    findings = fit.judge_poor_fit(judged)
    assert levels_of(findings) == expected


REMEDIES = [(0.5, 60.0, False), (0.5, 60.1, True), (2.0, 10.0, False), (2.0, 10.1, True)]


@pytest.mark.parametrize(("share", "linear", "is_blamed"), REMEDIES)
def test_the_model_is_blamed_where_a_filter_is_better(share, linear, is_blamed, monkeypatch):
    """Ten points better than the model, and than the mean."""
    monkeypatch.setattr(fit, "fir_fit_percent", lambda _: linear)
    judged = missing_shares(share, share)
    remedy = fit.poor_fit_remedy(judged)
    assert ("this model" in remedy) is is_blamed


def test_noise_that_no_input_explains_is_owed_to_none():
    rng = np.random.default_rng(0)
    signal = WHITE[:2000]
    noise = 0.5 * rng.standard_normal(2000)
    judged = case_of_one(signal, noise)
    assert fit.unmodelled_output_share(judged) < 0.05


STARTS = [(0.595, []), (0.605, ["doubt"])]


@pytest.mark.parametrize(("share", "expected"), STARTS)
def test_two_starts_may_differ_by_ten_points(share, expected, monkeypatch):
    other = missing_shares(share, share).test
    monkeypatch.setattr(fit, "simulate_from_alternative_states", lambda *_: other)
    judged = missing_shares(0.5, 0.5)
    findings = fit.judge_initial_state(judged)
    assert levels_of(findings) == expected


PULSES = [(4, ""), (5, "(4 of 25 lags)")]


@pytest.mark.parametrize(("pulses", "words"), PULSES)
def test_an_error_may_be_correlated_at_three_lags(pulses, words):
    """Equal pulses in a row are correlated at all lags shorter than the row."""
    error = np.zeros(400)
    error[:pulses] = 1.0
    judged = case_of_one(alternate(400), error)
    text = sentences(fit.judge_whiteness(judged))
    assert bool(text) == bool(words)
    assert words in text


def words_on_levels(signal: np.ndarray) -> str:
    """Sentences on the levels of an input."""
    judged = case_of_one(signal)
    return " ".join(records._input_level_sentences(judged))


def test_an_input_changes_at_least_ten_times():
    words = "The input changes 9 times"
    ten_heights = np.linspace(-1, 1, 10)
    assert words in words_on_levels(ten_heights.repeat(30))
    eleven_heights = np.linspace(-1, 1, 11)
    assert words_on_levels(eleven_heights.repeat(30)) == ""


def test_an_input_has_at_least_three_levels():
    two_levels = alternate(300)
    assert "two levels" in words_on_levels(two_levels)
    three_levels = np.resize([-1.0, 0.0, 1.0], 300)
    assert words_on_levels(three_levels) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_percent_of_the_samples_are_on_the_other_side(sign):
    signal = np.full(100, sign)
    signal[0] = -sign
    words = "one side of its equilibrium"
    assert words in words_on_levels(signal)
    signal[1] = -sign
    assert words not in words_on_levels(signal)


BEYOND = [(5, 2.0, 0), (6, 2.0, 2), (6, 1.1, 0)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("beyond", "farthest", "count"), BEYOND)
def test_a_twentieth_of_the_test_record_may_be_a_twentieth_beyond(beyond, farthest, count, sign):
    signal = alternate(100)
    tested = signal.copy()
    tested[:beyond] = sign * farthest
    data = data_of(signal, signal, tested)
    judged = case_of(data, signal, signal)
    text = " ".join(records._range_sentences(judged))
    assert text.count("6 % of the test record's") == count
    assert text.count("is beyond") == count


LENGTHS = [(199, 1, "199 training samples"), (200, 1, "")]
LENGTHS += [(299, 150, "lasts 150 samples"), (300, 150, "")]


@pytest.mark.parametrize(("samples", "lasting", "words"), LENGTHS)
def test_records_hold_200_samples_and_two_responses(samples, lasting, words, monkeypatch):
    monkeypatch.setattr(StateSpace, "impulse_response_length", lambda _: lasting)
    judged = case_of_one(alternate(samples))
    text = " ".join(records._length_sentences(judged))
    assert bool(text) == bool(words)
    assert words in text


def words_on_drift(error: np.ndarray) -> str:
    """Sentence on an error that drifts."""
    signal = alternate(len(error))
    judged = case_of_one(signal, error)
    return " ".join(records._drift_sentences(judged))


def test_a_drift_is_that_of_the_means_of_the_first_and_the_last_quarter():
    error = np.zeros(400)
    error[100:300] = 5.0
    error[80:100] = 2.0
    assert "drifts by 0.40 output scales" in words_on_drift(error)
    error[80:100] = 0.9
    assert words_on_drift(error) == ""


def test_a_piece_shorter_than_a_quarter_of_the_longest_has_no_drift():
    signal = alternate(400)
    for samples, is_said in ((100, True), (99, False)):
        data = data_of(signal, signal, alternate(samples))
        drift = np.linspace(-1, 1, samples)
        judged = case_of(data, np.zeros(400), drift)
        drifts = list(records._drift_sentences(judged))
        assert bool(drifts) is is_said


def test_a_twentieth_of_the_test_record_may_have_trained(monkeypatch):
    judged = case_of_one(alternate(300))
    for share, words in ((0.05, ""), (0.06, "6 % of the test record")):
        monkeypatch.setattr(records, "repeated_test_share", lambda _, share=share: share)
        text = " ".join(records._repetition_sentences(judged))
        assert text.startswith(words)
        assert bool(text) == bool(words)


SATURATED = [(50, 0.5, 0), (51, 0.5, 2), (51, 0.02, 0)]


@pytest.mark.parametrize(("values", "share", "count"), SATURATED)
def test_a_fine_output_may_stand_at_its_limit_for_two_percent(values, share, count, monkeypatch):
    monkeypatch.setattr(records, "saturated_share", lambda *_: share)
    levels = np.linspace(-1, 1, values)
    signal = np.resize(levels, 300)
    judged = case_of_one(signal)
    findings = list(records._saturation_findings(judged))
    assert len(findings) == count


STAYS = [(3, 4, 12 / 72), (2, 4, 0.0), (3, 1, 0.0)]


@pytest.mark.parametrize(("cycles", "standing", "share"), STAYS)
def test_a_sensor_ends_where_three_motions_stay_longer_than_a_sample(cycles, standing, share):
    up = np.arange(10.0)
    top = np.full(standing, 10.0)
    down = up[::-1]
    cycle = np.concatenate([up, top, down])
    signal = np.tile(cycle, cycles)
    judged = case_of_one(signal)
    moving = np.arange(len(signal), dtype=float)
    record = replace(judged.data.training[0], u=moving[:, None])
    data = replace(judged.data, training=(record,))
    moved = replace(judged, data=data)
    assert records.saturated_share(moved, 0, 10.0) == share


RESPONSES = [(3, "sample more often"), (4, ""), (999, ""), (1000, "data.decimate=5 keeps one")]


@pytest.mark.parametrize(("lasting", "words"), RESPONSES)
def test_a_response_lasts_between_three_and_a_thousand_samples(lasting, words, monkeypatch):
    log = case(LEVELS, answer(LEVELS))
    monkeypatch.setattr(StateSpace, "impulse_response_length", lambda _: lasting)
    text = sentences(response._sampling_findings(log))
    assert bool(text) == bool(words)
    assert words in text


LATE = [(1, []), (2, ["note"]), (4, ["note"]), (5, ["doubt"])]


@pytest.mark.parametrize(("late", "expected"), LATE)
def test_a_dead_time_of_two_samples_is_a_note_up_to_the_models_order(late, expected, monkeypatch):
    monkeypatch.setattr(type(MODEL), "order", 4)
    monkeypatch.setattr(response, "dead_time_samples", lambda _: late)
    judged = case_of_one(alternate(300))
    findings = response._dead_time_findings(judged)
    assert levels_of(findings) == expected


def test_a_dead_time_needs_two_samples_a_lag():
    y = answer(WHITE, late=3, noise=0.0)
    log = case(WHITE, y)
    for samples, late in ((123, 0), (124, 3)):
        record = log.data.training[0][:samples]
        data = replace(log.data, training=(record,))
        short = replace(log, data=data)
        assert response.dead_time_samples(short) == late


INCOHERENT = [(62, ""), (63, "in 50 % of the band up to 5 Hz")]


@pytest.mark.parametrize(("frequencies", "words"), INCOHERENT)
def test_half_of_the_band_may_be_incoherent(frequencies, words, monkeypatch):
    """Spectra of 4000 samples have 125 frequencies, the last at half the sampling rate."""
    values = np.full(126, 0.3)
    values[1 : frequencies + 1] = 0.29
    values[0] = 0.0
    monkeypatch.setattr(response, "multiple_coherence", lambda *_: values)
    monkeypatch.setattr(response, "largest_gains", lambda _, angles: np.ones(len(angles)))
    log = case(LEVELS, answer(LEVELS))
    text = sentences(response._coherence_findings(log))
    assert bool(text) == bool(words)
    assert words in text


OWN_MOTIONS = [(0.9, 0.5, ""), (0.9, 0.49, "it moves by itself. "), (0.5, 0.41, "")]
OWN_MOTIONS += [(0.1, -0.2, "Neither the input"), (0.11, -0.2, "it moves by itself. ")]


@pytest.mark.parametrize(("own", "by_input", "words"), OWN_MOTIONS)
def test_half_of_the_power_follows_from_the_input(own, by_input, words, monkeypatch):
    """Or the input says as much as the state in which a piece begins."""
    shares = (own, by_input)
    monkeypatch.setattr(autonomous_motion, "predicted_power_shares", lambda _: shares)
    judged = case_of_one(alternate(300))
    text = sentences(autonomous_motion.judge_autonomous_motion(judged))
    assert bool(text) == bool(words)
    assert words in text
