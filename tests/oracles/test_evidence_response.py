"""Coherence and dead time: what a record says of the answer to the input, on logs where both are
known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from structured_cases import model
from test_loop_prediction import linear_model

from ssm_study.data.assembly import assemble_dataset
from ssm_study.evidence import feedback, records
from ssm_study.evidence.finding import CANNOT_JUDGE, Case, Finding
from ssm_study.evidence.fit import LAGS, judge_whiteness, unmodelled_input_share
from ssm_study.evidence.metrics import collect_findings
from ssm_study.evidence.records import _judge_range
from ssm_study.evidence.response import dead_time_samples, judge_response, multiple_coherence
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.signals import Channel, Trajectory
from ssm_study.systems import StateSpace

RNG = np.random.default_rng(0)
WHITE = RNG.uniform(-1, 1, 6000)
HEIGHTS = RNG.uniform(-1, 1, 1200)
DURATIONS = RNG.integers(1, 12, 1200)
LEVELS = np.repeat(HEIGHTS, DURATIONS)[:6000]


def case(u: np.ndarray, y: np.ndarray, slow: float = 0.9, source: str = "recorded") -> Case:
    """The log of one input and one output with the model `y[k] = slow y[k-1] + 0.1 u[k-1]`."""
    log = Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)
    rest = np.zeros(1)
    input_channel = Channel(name="a", unit="")
    output_channel = Channel(name="b", unit="")
    records = ([log[:4000]], [log[4000:5000]], [log[5000:]])
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
    return Case(data=data, model=model, validation=validation, test=test)


def answer(u: np.ndarray, late: int = 0, noise: float = 0.01) -> np.ndarray:
    waiting = np.zeros(late)
    delayed = np.concatenate([waiting, u])[: len(u)]
    y = scipy.signal.lfilter([0, 0.1], [1, -0.9], delayed)
    rng = np.random.default_rng(1)
    white_noise = rng.standard_normal(len(u))
    return y + noise * white_noise


def answered(u: np.ndarray, late: int = 0, noise: float = 0.01) -> Case:
    """The log of this input and the lag's answer to it."""
    return case(u, answer(u, late, noise))


def sentences_with(words: str, findings: list[Finding]) -> list[str]:
    """The sentences among the findings that hold these words."""
    return [finding.sentence for finding in findings if words in finding.sentence]


@pytest.mark.parametrize("late", [0, 1, 3, 7, 12])
@pytest.mark.parametrize("u", [WHITE, LEVELS], ids=["white", "levels"])
def test_the_dead_time_is_counted_in_samples(u, late):
    log = answered(u, late)
    assert dead_time_samples(log) == late


def test_a_dead_time_beyond_the_order_is_a_doubt_with_its_remedy():
    (doubt,) = judge_response(answered(LEVELS, 5))
    assert doubt.level == "doubt"
    assert "answers 5 samples late" in doubt.sentence
    assert "use model=delayed model.dead_time=5" in doubt.sentence

    within_the_order = judge_response(answered(LEVELS, 1))
    assert within_the_order == []


@pytest.mark.parametrize(
    ("slow", "said"),
    [
        (0.3, "3 samples of 0.1 s: sample more often"),
        (0.9, None),
        (0.998, "data.decimate=5 keeps one sample in 5"),
    ],
)
def test_a_log_sampled_too_slowly_or_too_fast_is_told_what_to_do(slow, said):
    """A lag has lost nine tenths of its response after ln(0.1) / ln(slow) samples, and one more."""
    y = scipy.signal.lfilter([0, 0.1], [1, -slow], LEVELS)
    recorded = judge_response(case(LEVELS, y, slow))
    simulated = judge_response(case(LEVELS, y, slow, "simulated"))

    notes = [finding for finding in recorded if "bulk" in finding.sentence]
    assert len(notes) == (said is not None)
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
    smooth = np.sin(np.arange(6000) / 300)
    assert dead_time_samples(answered(smooth, 5)) == 0


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
    in_band = angles[gains >= 0.1 * gains.max()]
    return in_band.max() / (2 * np.pi) / 0.1


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

    ends_hz = band_end_hz([0, 0, 0.04], np.poly([0.9, 0.5]))
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
    mismatch = measure_mismatch(log.model, log.data.validation)
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
        share_percent = float(sentence.split(" %")[0])
        assert 60 < share_percent < 80
    assert sentences_with(words, judge_answered(WHITE)) == []


def test_coherence_is_the_share_of_power_that_the_inputs_explain():
    """`y = u_1 + u_2 + n`, all white: two thirds with unit variances, of either output the
    least."""
    u = RNG.standard_normal((100_000, 2))
    n = RNG.standard_normal((100_000, 1))
    with_noise = u.sum(axis=1, keepdims=True) + n
    without_noise = 100 * u[:, :1]
    y = np.hstack([with_noise, without_noise])

    coherence = multiple_coherence([(u, y)], 64)
    np.testing.assert_allclose(coherence, 2 / 3, atol=0.05)


def test_where_the_input_rests_in_one_record_the_others_tell():
    u = RNG.standard_normal((20_000, 1))
    white_noise = RNG.standard_normal((2000, 1))
    resting = (np.zeros((2000, 1)), 1e-3 * white_noise)

    of_both = multiple_coherence([(u, u), resting], 64)
    of_the_resting = multiple_coherence([resting], 64)

    np.testing.assert_allclose(of_both, 1, atol=1e-3)
    np.testing.assert_allclose(of_the_resting, 0, atol=1e-9)


def in_loop(reference: np.ndarray, noise: float, delay: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The same lag under `u = r - y + 0.05 sum (r - y)`, the law `delay` samples late."""
    y = 0.0
    whole = 0.0
    rng = np.random.default_rng(7)
    log = np.zeros((len(reference), 2))
    late = [0.0] * delay
    for k, asked in enumerate(reference):
        measured = y + noise * rng.standard_normal()
        whole += 0.05 * (asked - measured)
        late.append(asked - measured + whole)
        u = late.pop(0)
        log[k] = u, measured
        y = 0.9 * y + 0.1 * np.tanh(1.5 * u)
    return log[:, 0], log[:, 1]


def test_what_the_error_owes_to_the_input_is_its_share_of_the_output_s_power():
    """An output of twice what the model says: the error is half of it, and a short filter of the
    input."""
    y = scipy.signal.lfilter([0, 0.2], [1, -0.3], WHITE)
    held_back = (y[4000:5000], y[5000:])
    scored = np.concatenate([part[500 + LAGS :] for part in held_back])
    centred = np.concatenate([part - part.mean() for part in held_back])
    power = (scored**2).sum()
    varied = len(scored) * (centred**2).mean()

    owed = unmodelled_input_share(case(WHITE, y, slow=0.3))

    error_power = power / 4
    assert owed == pytest.approx(error_power / varied, rel=1e-4)


REFERENCES = {
    "steps": LEVELS.repeat(5)[:6000],
    "sine": 0.5 * np.sin(0.05 * np.arange(6000)),
    "none": np.zeros(6000),
}


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("reference", REFERENCES)
def test_a_log_made_in_a_closed_loop_is_a_doubt_and_the_same_input_in_open_loop_is_none(
    reference, delay
):
    u, y = in_loop(REFERENCES[reference], 0.03, delay)
    (doubt,) = feedback.judge_feedback(case(u, y))
    assert doubt.level == "doubt"
    assert "as in a closed-loop log: name its set point" in doubt.sentence

    open_loop = answered(u, noise=0.03)
    assert list(feedback.judge_feedback(open_loop)) == []


@pytest.mark.parametrize("pole", [1.02, 1.05, 1.2])
@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_a_plant_that_a_loop_keeps_from_running_away_is_refused_with_the_reason(pole, noise):
    set_point = LEVELS.repeat(10)[:6000]
    rng = np.random.default_rng(1)
    x = 0.0
    log = np.zeros((6000, 2))
    for k in range(6000):
        y = x + noise * rng.standard_normal()
        error = set_point[k] - y
        log[k] = error, y
        x = pole * x + 0.3 * error
    doubted, refused = feedback.judge_feedback(case(*log.T))
    assert doubted.level == "doubt"
    assert refused.level == "cannot judge"
    words = refused.sentence.split("a mode at ")[1]
    mode = float(words.split()[0])
    assert mode == pytest.approx(pole, abs=0.005)
    assert "log its loop with the set point as the input" in refused.sentence

    of_the_loop = feedback.judge_feedback(case(set_point, log[:, 1]))
    assert "cannot judge" not in [finding.level for finding in of_the_loop]


LOW_PASSED = scipy.signal.lfilter([0.1], [1, -0.9], WHITE)


@pytest.mark.parametrize("u", [WHITE, LEVELS, np.sign(LEVELS), LOW_PASSED])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_log_in_open_loop_is_not_taken_for_a_closed_one(u, noise):
    linear = answered(u, noise=noise).data
    saturated = case(u, answer(np.tanh(3 * u), noise=noise)).data
    assert feedback.feedback_share(linear, 0) < feedback.EARLIER
    assert feedback.feedback_share(saturated, 1) < feedback.EARLIER / 2


def test_a_model_with_neurons_is_judged():
    """One that has nothing to do with the log: no judgement of the plant."""
    data = answered(LEVELS).data
    other = model()
    validation = Simulation.simulate_records(other, data.validation, 0)
    test = Simulation.simulate_records(other, data.test, 0)
    mismatch = measure_mismatch(other, data.validation)
    judgement = collect_findings(data, other, validation, test, mismatch)

    assert judgement.level == CANNOT_JUDGE


def test_inputs_that_oppose_each_other_have_their_own_response():
    """The response of `x+ = 0.9 x + u_1 - u_2` is that of either input alone: 90 % of the sum of
    `0.9^k` are over after 22 samples."""
    a = np.array([[0.9]])
    c = np.ones((1, 1))
    for gains in ([1.0], [1.0, -1.0]):
        b = np.array([gains])
        d = np.zeros((1, len(gains)))
        linear = StateSpace(a=a, b=b, c=c, d=d)
        assert linear.impulse_response_length() == 23  # the first answers at sample 1


def test_a_short_record_is_said_to_have_the_lags_it_has():
    late = answered(LEVELS)
    record = late.validation.records[0][:60]
    drift = np.linspace(-1, 1, 60)
    drifted = record.y + drift[:, None]
    part = replace(late.validation, records=(record,), simulated=(drifted,))
    (doubt,) = judge_whiteness(replace(late, validation=part))
    assert "of 14 lags" in doubt.sentence


@pytest.mark.parametrize("moved", ["input", "output"])
def test_a_test_record_beyond_the_training_records_is_told_of_the_signal_that_is(moved):
    """Twice the input far away; or the same input, and an output that something else has lifted."""
    u = LEVELS.copy()
    y = answer(LEVELS)
    if moved == "input":
        u[5000:] *= 2.0
    else:
        swing = np.ptp(y[:4000])
        y[5000:] += 3.0 * swing
    (sentence,) = _judge_range(case(u, y))
    assert f"test record's {moved} is beyond the training records" in sentence

    unmoved = answered(LEVELS)
    assert list(_judge_range(unmoved)) == []


@pytest.mark.parametrize("kept", [records.WINDOW, records.WINDOW + 1])
def test_a_test_record_that_is_the_end_of_a_training_record_is_found_to_its_last_sample(kept):
    separate = answered(WHITE)
    assert list(records._judge_repetition(separate)) == []

    record = separate.data.training[0]
    end = replace(record, u=record.u[-kept:], y=record.y[-kept:])
    repeated = replace(separate, data=replace(separate.data, test=(end,)))
    (sentence,) = records._judge_repetition(repeated)
    assert sentence.startswith("100 % of the test record is part of the training records")


def test_a_controller_that_acts_a_sample_late_is_found_by_the_outputs_before():
    """With little noise the present output explains less than the limit, and so do those of two
    samples ago."""
    u, y = in_loop(REFERENCES["steps"], 0.007, 1)
    log = case(u, y)

    present = feedback.feedback_share(log.data, 0)
    before = feedback.feedback_share(log.data, 1)
    two_ago = feedback.feedback_share(log.data, 2)
    (doubt,) = feedback.judge_feedback(log)

    assert two_ago < feedback.EARLIER < before < feedback.PRESENT > present
    assert "as in a closed-loop log" in doubt.sentence
