"""Coherence and dead time: what a record says of the answer to the input, on logs where both are
known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from structured_cases import model
from test_loop_prediction import linear_model

from ssm_study.data.assembly import assemble_dataset
from ssm_study.evidence import records
from ssm_study.evidence.finding import CANNOT_JUDGE, EvidenceCase, Finding
from ssm_study.evidence.fit import LAGS, judge_whiteness, unmodelled_output_share
from ssm_study.evidence.metrics import collect_findings
from ssm_study.evidence.records import _range_sentences
from ssm_study.evidence.response import dead_time_samples, judge_response, multiple_coherence
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.signals import Channel, Trajectory
from ssm_study.systems import StateSpace

RNG = np.random.default_rng(0)
WHITE = RNG.uniform(-1, 1, 6000)
HEIGHTS = RNG.uniform(-1, 1, 1200)
DURATIONS = RNG.integers(1, 12, 1200)
LEVELS = np.repeat(HEIGHTS, DURATIONS)[:6000]


def case(u: np.ndarray, y: np.ndarray, slow: float = 0.9, source: str = "recorded") -> EvidenceCase:
    """The log of one input and one output with the model `y[k] = slow y[k-1] + 0.1 u[k-1]`."""
    inputs = u[:, None]
    outputs = y[:, None]
    log = Trajectory(u=inputs, y=outputs, step_s=0.1)
    rest = np.zeros(1)
    input_channel = Channel(name="a", unit="")
    output_channel = Channel(name="b", unit="")
    training = [log[:4000]]
    validation = [log[4000:5000]]
    test = [log[5000:]]
    records = (training, validation, test)
    channels = ((input_channel,), (output_channel,))
    metadata = {"source": source}
    data = assemble_dataset(records, (rest, rest), channels, 0, metadata=metadata)
    a = np.array([[slow]])
    b = np.array([[0.1]])
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    lag = StateSpace(a=a, b=b, c=c, d=d)
    model = replace(linear_model(0), linear=lag)
    validation = Simulation.simulate_records(model, data.validation, 0)
    test = Simulation.simulate_records(model, data.test, 0)
    return EvidenceCase(data=data, model=model, validation=validation, test=test)


def answer(u: np.ndarray, late: int = 0, noise: float = 0.01) -> np.ndarray:
    waiting = np.zeros(late)
    samples = len(u)
    delayed = np.concatenate([waiting, u])[:samples]
    y = scipy.signal.lfilter([0, 0.1], [1, -0.9], delayed)
    rng = np.random.default_rng(1)
    white_noise = rng.standard_normal(len(u))
    return y + noise * white_noise


def answered(u: np.ndarray, late: int = 0, noise: float = 0.01) -> EvidenceCase:
    """The log of this input and the lag's answer to it."""
    y = answer(u, late, noise)
    return case(u, y)


def sentences_with(words: str, findings: list[Finding]) -> list[str]:
    """The sentences among the findings that hold these words."""
    return [finding.sentence for finding in findings if words in finding.sentence]


@pytest.mark.parametrize("late", [0, 1, 3, 7, 12])
@pytest.mark.parametrize("u", [WHITE, LEVELS], ids=["white", "levels"])
def test_the_dead_time_is_counted_in_samples(u, late):
    log = answered(u, late)
    assert dead_time_samples(log) == late


def test_a_dead_time_beyond_the_order_is_a_doubt_with_its_remedy():
    late = answered(LEVELS, 5)
    (doubt,) = judge_response(late)
    assert doubt.level == "doubt"
    assert "answers 5 samples late" in doubt.sentence
    assert "use model=delayed model.dead_time=5" in doubt.sentence

    within_the_order = judge_response(answered(LEVELS, 1))
    assert within_the_order == []


TOO_SLOW = (0.3, "3 samples of 0.1 s: sample more often")
TOO_FAST = (0.998, "data.decimate=5 keeps one sample in 5")
SAMPLING_RATES = [TOO_SLOW, (0.9, None), TOO_FAST]


@pytest.mark.parametrize(("slow", "said"), SAMPLING_RATES)
def test_a_log_sampled_too_slowly_or_too_fast_is_told_what_to_do(slow, said):
    """A lag has lost nine tenths of its response after ln(0.1) / ln(slow) samples, and one more."""
    y = scipy.signal.lfilter([0, 0.1], [1, -slow], LEVELS)
    recorded_log = case(LEVELS, y, slow)
    recorded = judge_response(recorded_log)
    simulated_log = case(LEVELS, y, slow, "simulated")
    simulated = judge_response(simulated_log)

    notes = [finding for finding in recorded if "bulk" in finding.sentence]
    is_noted = said is not None
    assert len(notes) == is_noted
    for note in notes:
        assert note.level == "note"
        assert said in note.sentence
    assert sentences_with("bulk", simulated) == []


@pytest.mark.parametrize("noise", [3.0, 100.0])
def test_where_noise_hides_the_answer_no_dead_time_is_claimed(noise):
    slow_levels = LEVELS[:1500].repeat(4)
    noisy = answered(slow_levels, 6, noise)
    assert dead_time_samples(noisy) == 0


def test_an_input_too_smooth_to_tell_its_samples_apart_claims_no_dead_time():
    angles = np.arange(6000) / 300
    smooth = np.sin(angles)
    log = answered(smooth, 5)
    assert dead_time_samples(log) == 0


def test_a_record_that_noise_hides_is_a_doubt_and_a_good_one_is_none():
    noisy = judge_response(answered(WHITE, noise=1.0))
    quiet = judge_response(answered(WHITE))
    assert sentences_with("of the band up to", noisy)
    assert quiet == []


def band_end_hz(numerator: list[float], denominator: list[float]) -> float:
    """Last frequency where a transfer function has a tenth of its largest gain, at steps of
    pi / 125 from the first on: pieces of 250 samples, of 0.1 s."""
    grid = np.linspace(0, np.pi, 126)[1:]
    angles, response = scipy.signal.freqz(numerator, denominator, grid)
    gains = np.abs(response)
    tenth = 0.1 * gains.max()
    in_band = angles[gains >= tenth]
    cycles_a_sample = in_band.max() / (2 * np.pi)
    return cycles_a_sample / 0.1


def test_the_band_ends_where_the_model_answers_with_a_tenth_of_its_largest_gain():
    """`|0.1 / (exp(j w) - 0.9)|`."""
    ends_hz = band_end_hz([0.1], [1, -0.9])
    findings = judge_response(answered(WHITE, noise=3.0))
    (sentence,) = sentences_with("band", findings)
    assert f"of the band up to {ends_hz:.3g} Hz that" in sentence


def test_the_band_is_that_of_the_whole_answer_not_of_each_state_by_itself():
    """`0.1 / (z - 0.9) - 0.1 / (z - 0.5)`: the states cancel with their phases."""
    noisy = answered(WHITE, noise=3.0)
    a = np.diag([0.9, 0.5])
    b = np.full((2, 1), 0.1)
    c = np.array([[1.0, -1.0]])
    d = np.zeros((1, 1))
    two_states = StateSpace(a=a, b=b, c=c, d=d)
    model = replace(noisy.model, linear=two_states)

    findings = judge_response(replace(noisy, model=model))

    denominator = np.poly([0.9, 0.5])
    ends_hz = band_end_hz([0, 0, 0.04], denominator)
    (sentence,) = sentences_with("band", findings)
    assert f"of the band up to {ends_hz:.3g} Hz that" in sentence


def test_pieces_shorter_than_the_model_s_response_say_nothing():
    """A response longer than a piece counts as noise in it: pieces of 250 samples, a response of
    460."""
    hidden = answered(WHITE, noise=1.0)
    a = np.array([[0.995]])
    linear = replace(hidden.model.linear, a=a)
    slow = replace(hidden.model, linear=linear)
    changed_hidden = replace(hidden, model=slow)
    assert judge_response(changed_hidden) == []


def test_a_band_that_is_not_excited_is_a_doubt():
    white_noise = RNG.standard_normal(6000)
    low_pass = scipy.signal.butter(4, 0.01)
    slow = scipy.signal.lfilter(*low_pass, white_noise)

    findings = judge_response(answered(slow, noise=0.02))

    assert sentences_with("excite it there", findings)


def judge_answered(u: np.ndarray) -> list[Finding]:
    """Findings about the records of a log with this input."""
    log = answered(u)
    mismatch = measure_model_error(log.model, log.data.validation)
    return records.judge_records(log, mismatch)


def test_a_test_input_where_training_has_no_power_is_a_doubt():
    """White over the frequencies after training on the lowest; the share is that of the test
    record's power."""
    b, a = scipy.signal.butter(8, 0.25)
    slow = scipy.signal.lfilter(b, a, WHITE)
    in_training = np.arange(6000) < 4500
    mixed = np.where(in_training, slow, WHITE)
    words = "lies where training has none"

    for scale in (0.1, 1.0):  # a share knows no unit
        findings = judge_answered(scale * mixed)
        (sentence,) = sentences_with(words, findings)
        share, _ = sentence.split(" %", 1)
        share_percent = float(share)
        assert 60 < share_percent < 80
    of_white = judge_answered(WHITE)
    assert sentences_with(words, of_white) == []


def test_coherence_is_the_share_of_power_that_the_inputs_explain():
    """`y = u_1 + u_2 + n`, all white: two thirds with unit variances, of either output the
    least."""
    u = RNG.standard_normal((100_000, 2))
    n = RNG.standard_normal((100_000, 1))
    summed = u.sum(axis=1, keepdims=True)
    with_noise = summed + n
    without_noise = 100 * u[:, :1]
    y = np.hstack([with_noise, without_noise])

    coherence = multiple_coherence([(u, y)], 64)
    np.testing.assert_allclose(coherence, 2 / 3, atol=0.05)


def test_where_the_input_rests_in_one_record_the_others_tell():
    u = RNG.standard_normal((20_000, 1))
    white_noise = RNG.standard_normal((2000, 1))
    no_input = np.zeros((2000, 1))
    weak_output = 1e-3 * white_noise
    resting = (no_input, weak_output)

    of_both = multiple_coherence([(u, u), resting], 64)
    of_the_resting = multiple_coherence([resting], 64)

    np.testing.assert_allclose(of_both, 1, atol=1e-3)
    np.testing.assert_allclose(of_the_resting, 0, atol=1e-9)


def test_what_the_error_owes_to_the_input_is_its_share_of_the_output_s_power():
    """An output of twice what the model says: the error is half of it, and a short filter of the
    input."""
    y = scipy.signal.lfilter([0, 0.2], [1, -0.3], WHITE)
    held_out = y[5000:]
    scored = np.concatenate([y[4500 + LAGS : 5000], held_out[500 + LAGS :]])
    validated = y[4000:5000]
    deviations = [validated - validated.mean(), held_out - held_out.mean()]
    centred = np.concatenate(deviations)
    power = (scored**2).sum()
    variance = (centred**2).mean()
    varied = len(scored) * variance

    log = case(WHITE, y, slow=0.3)
    owed = unmodelled_output_share(log)

    error_power = power / 4
    expected = error_power / varied
    assert owed == pytest.approx(expected, rel=1e-4)


def test_a_model_with_neurons_is_judged():
    """One that has nothing to do with the log: no judgement of the plant."""
    data = answered(LEVELS).data
    other = model()
    validation = Simulation.simulate_records(other, data.validation, 0)
    test = Simulation.simulate_records(other, data.test, 0)
    mismatch = measure_model_error(other, data.validation)
    judgement = collect_findings(data, other, validation, test, mismatch)

    assert judgement.level == CANNOT_JUDGE


def test_inputs_that_oppose_each_other_have_their_own_response():
    """The response of `x+ = 0.9 x + u_1 - u_2` is that of either input alone: 90 % of the sum of
    `0.9^k` are over after 22 samples."""
    a = np.array([[0.9]])
    c = np.ones((1, 1))
    for gains in ([1.0], [1.0, -1.0]):
        b = np.array([gains])
        inputs = len(gains)
        d = np.zeros((1, inputs))
        linear = StateSpace(a=a, b=b, c=c, d=d)
        assert linear.impulse_response_length() == 23  # the first answers at sample 1


def test_a_short_record_is_said_to_have_the_lags_it_has():
    late = answered(LEVELS)
    record = late.validation.records[0][:60]
    drift = np.linspace(-1, 1, 60)
    drifted = record.y + drift[:, None]
    runs = {"records": (record,), "simulated": (drifted,)}
    part = replace(late.validation, **runs)
    short = replace(late, validation=part)
    (doubt,) = judge_whiteness(short)
    assert "of 14 lags" in doubt.sentence


@pytest.mark.parametrize("moved", ["input", "output"])
def test_a_test_record_beyond_the_training_records_is_told_of_the_signal_that_is(moved):
    """Twice the input far away; or the same input, and an output that something else has lifted."""
    u = LEVELS.copy()
    y = answer(LEVELS)
    if moved == "input":
        u[5000:] *= 2.0
    else:
        training_y = y[:4000]
        swing = np.ptp(training_y)
        y[5000:] += 3.0 * swing
    log = case(u, y)
    (sentence,) = _range_sentences(log)
    assert f"test record's {moved} is beyond the training records" in sentence

    unmoved = answered(LEVELS)
    assert list(_range_sentences(unmoved)) == []


LONGER = records.WINDOW + 1


@pytest.mark.parametrize("kept", [records.WINDOW, LONGER])
def test_a_test_record_that_is_the_end_of_a_training_record_is_found_to_its_last_sample(kept):
    separate = answered(WHITE)
    assert list(records._repetition_sentences(separate)) == []

    record = separate.data.training[0]
    last_u = record.u[-kept:]
    last_y = record.y[-kept:]
    end = replace(record, u=last_u, y=last_y)
    data = replace(separate.data, test=(end,))
    repeated = replace(separate, data=data)
    (sentence,) = records._repetition_sentences(repeated)
    assert sentence.startswith("100 % of the test record is part of the training records")
