"""Offsets that stay after the input has moved: a valve that sticks rests at rest input, and away
from rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from test_evidence_response import LEVELS, answer, case

from ssm_study.data.excitations.user_excitation import IdentificationExperiment
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.finding import EvidenceCase
from ssm_study.evidence.records import judge_records
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.return_to_rest import (
    AT_REST,
    SURE,
    _distances_from_rest,
    _last_quarter_and_noise,
    oscillations_and_offsets_after_returns,
)
from ssm_study.signals import Scale, Trajectory

RESTING = np.zeros(600)
MOVING_LEVELS = LEVELS[:5400]
THEN_REST = np.concatenate([MOVING_LEVELS, RESTING])


def said(u: np.ndarray, y: np.ndarray) -> list[str]:
    log = case(u, y)
    validation = log.data.validation
    mismatch: Mismatch = measure_model_error(log.model, validation)
    findings = judge_records(log, mismatch)
    sentences = [finding.sentence for finding in findings]
    return [sentence for sentence in sentences if "scales off at rest input" in sentence]


STICTIONS = [0.0, 0.3]


@pytest.mark.parametrize("stick", STICTIONS)
def test_an_output_that_stays_off_after_the_last_motion_is_a_doubt(stick):
    """The stem follows where it is pushed by more than `stick`; the input ends at less, the output
    stays there."""
    stem = 0.0
    out = np.zeros(len(THEN_REST))
    u = THEN_REST.copy()
    u[5300:5400] = 0.25
    u[5200:5300] = -0.1
    for k, pushed in enumerate(u):
        difference = abs(pushed - stem)
        stem = pushed if difference > stick else stem
        out[k] = stem
    doubts = said(u, answer(out))
    assert bool(doubts) == (stick > 0)
    log = case(u, answer(out))
    line = np.linspace(-1.5, 0, 600)
    ramp = line[:, None]
    y = ramp**3
    zero_input = np.zeros((600, 1))
    rest = Trajectory(u=zero_input, y=y, step_s=0.1)
    validation = log.data.validation
    test = log.data.test
    records = (*test, rest)
    mismatch = measure_model_error(log.model, validation, 0, records)
    output_scales = log.model.scale.output_scale
    output_scale = output_scales[0]
    expected = (0.25 / output_scale,) if stick else ()
    expected_offset = pytest.approx(expected, abs=0.01)
    assert mismatch.stuck == expected_offset
    output_scale = log.model.scale.output_scale
    expected = 1.5**3 / output_scale[0]
    expected_distance = pytest.approx(expected)
    assert mismatch.farthest == expected_distance
    is_off = mismatch.largest_offset > 0
    assert is_off == (stick > 0)


def test_a_record_that_ends_before_the_answer_does_says_nothing():
    resting = np.zeros(20)
    moving = LEVELS[:5980]
    u = np.concatenate([moving, resting])
    doubts = said(u, answer(u))
    assert doubts == []


EXCITED_RECORD = IdentificationExperiment(lower=-1.2, upper=1.0, rest=0.1, step_s=0.1, settle_s=4.5)
EXCITED = EXCITED_RECORD.input_signal()
UNKNOWN = "whether the output rests by itself is unknown"


def fitted_log(
    folder: Path, u: np.ndarray, y: np.ndarray, slow: float = 0.9
) -> tuple[EvidenceCase, Mismatch, str]:
    """The log as a user fits it: cut, about its mean, with the lag for its model; and what is said
    of its rests."""
    signals = [u, y]
    columns = np.column_stack(signals)
    np.savetxt(folder / "log.csv", columns, delimiter=",", header="u,y", comments="")
    path = str(folder / "log.csv")
    recorded_data = RecordedData(path=path, input="u", output="y", step_s=0.1, start_up_samples=20)
    data = recorded_data.build(0)
    fitted = case(LEVELS, answer(LEVELS), slow)
    lag_model = fitted.model
    model = replace(lag_model, scale=data.scale)
    validation = Simulation.simulate_records(model, data.validation, 20)
    test = Simulation.simulate_records(model, data.test, 20)
    parts = {"validation": validation, "test": test}
    log = EvidenceCase(data=data, model=model, **parts)
    mismatch = measure_model_error(model, data.validation, 20, data.mismatch_records)
    findings = judge_records(log, mismatch)
    sentences = [finding.sentence for finding in findings]
    text = " ".join(sentence for sentence in sentences if "rest input" in sentence)
    return log, mismatch, text


SLOWEST_POLES = [0.9, 0.98]


@pytest.mark.parametrize("slow", SLOWEST_POLES)
def test_the_log_made_for_the_purpose_shows_that_the_output_rests(tmp_path, slow):
    """Its returns are cut apart, and its mean is not its rest; also where the model is slower than
    the plant."""
    log, mismatch, doubts = fitted_log(tmp_path, EXCITED, answer(EXCITED), slow)
    scale = log.data.scale
    u = np.array([0.1])
    scaled_input = scale.scaled_input(u)
    distance = np.abs(scaled_input)
    assert np.any(distance > 1e-3)
    assert mismatch.left_at_rest is not None
    assert mismatch.left_at_rest < AT_REST
    assert mismatch.stuck == ()
    assert doubts == ""


def test_a_log_that_ends_moving_or_rests_once_is_told_so(tmp_path):
    ends_moving = EXCITED[:-90]
    moving = EXCITED[90:1890] + 0.01
    resting = np.full(90, 0.1)
    once = np.concatenate([moving, resting])
    for u in (ends_moving, once):
        _, mismatch, doubts = fitted_log(tmp_path, u, answer(u))
        assert mismatch.left_at_rest is None
        assert UNKNOWN in doubts


def add_swing(u: np.ndarray) -> np.ndarray:
    time = np.arange(len(u))
    return answer(u) + 0.3 * np.sin(0.2 * time)


def add_drift(u: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(3)
    steps = rng.standard_normal(len(u))
    return answer(u) + 0.05 * np.cumsum(steps)


def add_integral(u: np.ndarray) -> np.ndarray:
    return answer(u) + 0.01 * np.cumsum(u - 0.1)


NOT_AT_REST = [
    (add_swing, "does not come to rest by itself"),
    (add_drift, "rest"),
    (add_integral, "scales off at rest input"),
]


NAMES_OF_PLANTS = ["swings", "drifts", "integrates"]


@pytest.mark.parametrize(("wrong", "said"), NOT_AT_REST, ids=NAMES_OF_PLANTS)
def test_a_plant_that_does_not_return_is_told_so_by_the_same_log(tmp_path, wrong, said):
    _, mismatch, doubts = fitted_log(tmp_path, EXCITED, wrong(EXCITED))
    assert said in doubts
    assert UNKNOWN not in doubts
    assert not mismatch.plant_comes_to_rest or mismatch.largest_offset > 1


SWINGS = [0.0, 0.01]


@pytest.mark.parametrize("hunts", SWINGS)
def test_a_faint_swing_is_a_doubt_and_no_refusal(hunts):
    """A burner that hunts by a hundredth of its range was sound, and no loop settled in a band
    narrower than that."""
    log = case(LEVELS, answer(LEVELS))
    samples = np.arange(600)
    k = samples[:, None]
    output_scale = log.model.scale.output_scale
    sine = np.sin(0.2 * k)
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(k.shape)
    change = hunts * sine + 0.001 * white_noise
    y = output_scale * change
    validation = log.data.validation
    trajectory = Trajectory(u=0.0 * k, y=y, step_s=0.1)
    mismatch = measure_model_error(log.model, validation, 0, (trajectory,))
    assert mismatch.plant_comes_to_rest
    expected = pytest.approx(hunts, rel=0.1, abs=1e-3)
    assert mismatch.left_at_rest == expected
    findings = judge_records(log, mismatch)
    sentences = [finding.sentence for finding in findings]
    text = " ".join(sentences)
    is_said = "a small limit cycle, or a slow decay" in text
    assert is_said == (hunts > 0)


@pytest.mark.parametrize("hunts", SWINGS)
def test_a_faint_swing_that_motion_sets_off_counts(hunts):
    """A decay from a given output starts the mode that hunts at zero: the rest after a motion shows
    it."""
    noisy_answer = answer(THEN_REST, noise=0.001)
    log = case(THEN_REST, noisy_answer)
    test_records = log.data.test
    last = test_records[-1]
    samples = np.arange(len(last))
    k = samples[:, None]
    output_scale = log.model.scale.output_scale
    sine = np.sin(0.9 * k)
    is_at_rest = last.u == 0
    amplitude = output_scale * is_at_rest
    swing = amplitude * hunts * sine
    y = last.y + swing
    u = np.zeros((600, 1))
    time = np.arange(600)
    exponent = -time / 20
    decaying = np.exp(exponent)
    decay_column = decaying[:, None]
    decay = Trajectory(u=u, y=decay_column, step_s=0.1)
    validation = log.data.validation
    changed_last = replace(last, y=y)
    records = (*validation, changed_last)
    mismatch = measure_model_error(log.model, records, 0, (decay,))
    expected = pytest.approx(hunts, rel=0.1, abs=1e-3)
    assert mismatch.left_at_rest == expected


def test_short_returns_of_an_output_that_moves_on_say_nothing(tmp_path):
    """Shorter than the response: the output may still be on its way, which is no friction, and no
    rest either."""
    numerator = [0, 0.01]
    denominator = [1, -0.99]
    slowly = scipy.signal.lfilter(numerator, denominator, EXCITED)
    _, mismatch, doubts = fitted_log(tmp_path, EXCITED, slowly, slow=0.99)
    assert mismatch.left_at_rest is None
    assert mismatch.stuck == ()
    assert UNKNOWN in doubts


FAR_AND_NEAR = [(0.25, [0.0]), (0.1, [])]


@pytest.mark.parametrize(("start", "said"), FAR_AND_NEAR)
def test_a_short_return_shows_a_rest_where_it_comes_from_far(start, said):
    """Where the first sample after the step lies decides."""
    u = np.eye(41, 1)
    impulse = np.eye(41, 1, -1)
    y = start * impulse
    record = Trajectory(u=u, y=y, step_s=0.1)
    scale = Scale.identity(1, 1)
    still, offsets = oscillations_and_offsets_after_returns(scale, [record], 1000)
    assert still == pytest.approx(said)
    assert offsets == []


@pytest.mark.parametrize(("response_length", "motions"), [(20, [0.0]), (21, [])])
def test_a_return_is_long_from_two_responses_on(response_length, motions):
    """Forty samples follow the step, and begin too near to count otherwise."""
    u = np.eye(41, 1)
    y = 0.1 * np.eye(41, 1, -1)
    record = Trajectory(u=u, y=y, step_s=0.1)
    scale = Scale.identity(1, 1)
    still, _ = oscillations_and_offsets_after_returns(scale, [record], response_length)
    assert still == pytest.approx(motions)


ENDS = [(0.0, [0.0, 0.0]), (1.0, [])]


@pytest.mark.parametrize(("start", "said"), ENDS)
def test_what_counts_as_far_is_counted_from_where_the_return_ends(start, said):
    """Two short returns at another input than the equilibrium's, where the output rests at one."""
    begins = np.arange(41) < 2
    values = np.where(begins, start, 1.0)
    y = values[:, None]
    impulse = np.eye(41, 1)
    u = 1.0 + impulse
    record = Trajectory(u=u, y=y, step_s=0.1)
    scale = Scale.identity(1, 1)
    records = [record, record]
    still, offsets = oscillations_and_offsets_after_returns(scale, records, 1000)
    assert still == pytest.approx(said)
    assert offsets == []


@pytest.mark.parametrize("stick", STICTIONS)
def test_short_returns_that_end_apart_and_move_no_more_are_a_doubt(tmp_path, stick):
    """A slow model makes them short; a valve that sticks leaves each elsewhere, and the log was
    called sound."""
    stem = 0.1
    out = np.zeros(len(EXCITED))
    for k, pushed in enumerate(EXCITED):
        difference = abs(pushed - stem)
        stem = pushed if difference > stick else stem
        out[k] = stem
    log_of_stick = answer(out)
    _, mismatch, doubts = fitted_log(tmp_path, EXCITED, log_of_stick, slow=0.995)
    is_unknown = mismatch.left_at_rest is None
    assert is_unknown == (stick > 0)
    is_said = "scales apart, where none seems to move: friction, play or a slow mode" in doubts
    assert is_said == (stick > 0)


def test_no_view_is_taken_of_returns_on_which_the_model_was_trained(tmp_path):
    """The first amplitude does not repeat itself, so the log is not made of repeated periods
    alone."""
    excited = EXCITED.copy()
    decreasing = np.linspace(0.9, 0.8, 880)
    excited[120:1000] *= decreasing
    log, mismatch, _ = fitted_log(tmp_path, excited, answer(excited))
    mismatch_records = log.data.mismatch_records
    assert len(mismatch_records) == 3
    validation = log.data.validation
    alone = measure_model_error(log.model, validation, 20)
    assert mismatch.gain == alone.gain
    assert mismatch.spread == alone.spread
    expected = len(alone.views)
    assert len(mismatch.views) == expected


TIMES = [1.1, 1.5]


@pytest.mark.parametrize("times", TIMES)
def test_a_loop_that_starts_beyond_what_training_reached_is_told_how_far(times):
    log = case(LEVELS, answer(LEVELS))
    training = log.data.training
    training_y = training[0].y
    sizes = np.abs(training_y)
    largest = sizes.max()
    shape = (60, 1)
    farthest = np.full(shape, times * largest)
    u = np.zeros(shape)
    trial = Trajectory(u=u, y=farthest, step_s=0.1)
    data = replace(log.data, mismatch_records=(trial,))
    begun = replace(log, data=data)
    validation = log.data.validation
    mismatch = measure_model_error(log.model, validation)
    findings = judge_records(begun, mismatch)
    sentences = [finding.sentence for finding in findings]
    says_how_far = any(f"starts {times} times as far out" in sentence for sentence in sentences)
    assert says_how_far == (times > 1.2)
    says_that_it_is_far = any("times as far out" in sentence for sentence in sentences)
    assert says_that_it_is_far == (times > 1.2)


COUNTS = [2, 3, 6]


@pytest.mark.parametrize("count", COUNTS)
def test_noise_is_taken_off_a_return_and_off_the_mean_of_the_others(count):
    """The difference of a mean of variance v from the mean of n others has the variance v + v /
    n."""
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((400, 1))
    noise = 0.01 * white_noise
    levels = rng.uniform(-1, 1, count)
    outputs = [level + noise for level in levels]
    tail, variance = _last_quarter_and_noise(outputs[0])
    last_means = [_last_quarter_and_noise(y)[0].mean() for y in outputs]
    means = np.array(last_means)
    means_of_others = [np.delete(means, i).mean() for i in range(count)]
    others = np.array(means_of_others)
    first_variance = float(variance[0])
    variance_of_mean = first_variance / len(tail)
    share_of_others = 1 / (count - 1)
    factor = 1 + share_of_others
    variance_of_difference = variance_of_mean * factor
    doubt = SURE * np.sqrt(variance_of_difference)
    difference = np.abs(means - others)
    expected = difference - doubt
    distances = _distances_from_rest(outputs, is_centred=False)
    expected_distances = pytest.approx(expected)
    assert distances == expected_distances
