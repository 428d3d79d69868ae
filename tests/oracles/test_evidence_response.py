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
from ssm_study.evidence.finding import CANNOT_JUDGE, Case
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
LEVELS = np.repeat(RNG.uniform(-1, 1, 1200), RNG.integers(1, 12, 1200))[:6000]


def case(u: np.ndarray, y: np.ndarray, slow: float = 0.9, source: str = "recorded") -> Case:
    """The log of one input and one output with the model `y[k] = slow y[k-1] + 0.1 u[k-1]`."""
    log = Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)
    rest = np.zeros(1)
    channel = Channel(name="a", unit="")
    changed_channel = replace(channel, name="b")
    channels = ((channel,), (changed_channel,))
    metadata = {"source": source}
    data = assemble_dataset(
        ([log[:4000]], [log[4000:5000]], [log[5000:]]), (rest, rest),
        channels, 0, metadata=metadata,
    )  # fmt: skip
    a = np.array([[slow]])
    b = np.array([[0.1]])
    c = np.ones((1, 1))
    d = np.zeros((1, 1))
    lag = StateSpace(a=a, b=b, c=c, d=d)
    model = replace(linear_model(0), linear=lag)
    names = ("validation", "test")
    parts = {name: Simulation.simulate_records(model, getattr(data, name), 0) for name in names}
    return Case(data=data, model=model, **parts)


def answer(u: np.ndarray, late: int = 0, noise: float = 0.01) -> np.ndarray:
    y = scipy.signal.lfilter([0, 0.1], [1, -0.9], np.concatenate([np.zeros(late), u])[: len(u)])
    rng = np.random.default_rng(1)
    white_noise = rng.standard_normal(len(u))
    return y + noise * white_noise


@pytest.mark.parametrize("late", [0, 1, 3, 7, 12])
@pytest.mark.parametrize("u", [WHITE, LEVELS], ids=["white", "levels"])
def test_the_dead_time_is_counted_in_samples(u, late):
    assert dead_time_samples(case(u, answer(u, late))) == late


def test_a_dead_time_beyond_the_order_is_a_doubt_with_its_remedy():
    (found,) = judge_response(case(LEVELS, answer(LEVELS, 5)))
    assert found.level == "doubt"
    assert "answers 5 samples late" in found.sentence
    assert "use model=delayed model.dead_time=5" in found.sentence
    assert judge_response(case(LEVELS, answer(LEVELS, 1))) == []


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
    notes = [found for found in judge_response(case(LEVELS, y, slow)) if "bulk" in found.sentence]
    assert len(notes) == (said is not None)
    assert all(found.level == "note" and said in found.sentence for found in notes)
    assert not [
        found
        for found in judge_response(case(LEVELS, y, slow, "simulated"))
        if "bulk" in found.sentence
    ]


@pytest.mark.parametrize("noise", [3.0, 100.0])
def test_where_noise_hides_the_answer_no_dead_time_is_claimed(noise):
    assert (
        dead_time_samples(case(LEVELS[:1500].repeat(4), answer(LEVELS[:1500].repeat(4), 6, noise)))
        == 0
    )


def test_an_input_too_smooth_to_tell_its_samples_apart_claims_no_dead_time():
    smooth = np.sin(np.arange(6000) / 300)
    assert dead_time_samples(case(smooth, answer(smooth, 5))) == 0


def test_a_record_that_noise_hides_is_a_doubt_and_a_good_one_is_none():
    told = [found.sentence for found in judge_response(case(WHITE, answer(WHITE, noise=1.0)))]
    assert any("of the band up to" in sentence for sentence in told)
    assert judge_response(case(WHITE, answer(WHITE))) == []


def test_the_band_ends_where_the_model_answers_with_a_tenth_of_its_largest_gain():
    """`|0.1 / (exp(j w) - 0.9)|` at steps of pi / 125 from the first on: pieces of 250 samples, of
    0.1 s."""
    angles, gain = scipy.signal.freqz([0.1], [1, -0.9], np.linspace(0, np.pi, 126)[1:])
    largest = np.abs(gain).max()
    lower_limit = 0.1 * largest
    largest = angles[np.abs(gain) >= lower_limit].max()
    ends_hz = largest / (2 * np.pi) / 0.1
    (said,) = (
        found.sentence
        for found in judge_response(case(WHITE, answer(WHITE, noise=3.0)))
        if "band" in found.sentence
    )
    assert f"of the band up to {ends_hz:.3g} Hz that" in said


def test_the_band_is_that_of_the_whole_answer_not_of_each_state_by_itself():
    """`0.1 / (z - 0.9) - 0.1 / (z - 0.5)`: the states cancel with their phases."""
    noisy = case(WHITE, answer(WHITE, noise=3.0))
    a = np.diag([0.9, 0.5])
    b = np.full((2, 1), 0.1)
    c = np.array([[1.0, -1.0]])
    d = np.zeros((1, 1))
    two = StateSpace(a=a, b=b, c=c, d=d)
    changed_noisy = replace(noisy, model=replace(noisy.model, linear=two))
    told = judge_response(changed_noisy)
    angles, gain = scipy.signal.freqz(
        [0, 0, 0.04], np.poly([0.9, 0.5]), np.linspace(0, np.pi, 126)[1:]
    )
    largest = np.abs(gain).max()
    lower_limit = 0.1 * largest
    largest = angles[np.abs(gain) >= lower_limit].max()
    ends_hz = largest / (2 * np.pi) / 0.1
    (said,) = (found.sentence for found in told if "band" in found.sentence)
    assert f"of the band up to {ends_hz:.3g} Hz that" in said


def test_pieces_shorter_than_the_model_s_response_say_nothing():
    """A response longer than a piece counts as noise in it: pieces of 250 samples, a response of
    460."""
    hidden = case(WHITE, answer(WHITE, noise=1.0))
    a = np.array([[0.995]])
    linear = replace(hidden.model.linear, a=a)
    slow = replace(hidden.model, linear=linear)
    changed_hidden = replace(hidden, model=slow)
    assert judge_response(changed_hidden) == []


def test_a_band_that_is_not_excited_is_a_doubt():
    white_noise = RNG.standard_normal(6000)
    slow = scipy.signal.lfilter(*scipy.signal.butter(4, 0.01), white_noise)
    assert any(
        "excite it there" in found.sentence
        for found in judge_response(case(slow, answer(slow, noise=0.02)))
    )


def test_a_test_input_where_training_has_no_power_is_a_doubt():
    """White over the frequencies after training on the lowest; the share is that of the test
    record's power."""
    b, a = scipy.signal.butter(8, 0.25)
    slow = scipy.signal.lfilter(b, a, WHITE)
    for scale in (0.1, 1.0):  # a share knows no unit
        u = scale * np.where(np.arange(6000) < 4500, slow, WHITE)
        made = case(u, answer(u))
        mismatch = measure_mismatch(made.model, made.data.validation)
        told = records.judge_records(made, mismatch)
        (said,) = (
            found.sentence for found in told if "lies where training has none" in found.sentence
        )
        assert 60 < float(said.split(" %")[0]) < 80
    made = case(WHITE, answer(WHITE))
    mismatch = measure_mismatch(made.model, made.data.validation)
    told = records.judge_records(made, mismatch)
    assert not any("lies where training has none" in found.sentence for found in told)


def test_coherence_is_the_share_of_power_that_the_inputs_explain():
    """`y = u_1 + u_2 + n`, all white: two thirds with unit variances, of either output the
    least."""
    u = RNG.standard_normal((100_000, 2))
    n = RNG.standard_normal((100_000, 1))
    y = np.hstack([u.sum(axis=1, keepdims=True) + n, 100 * u[:, :1]])
    parts = [(u, y)]
    actual = multiple_coherence(parts, 64)
    np.testing.assert_allclose(actual, 2 / 3, atol=0.05)


def test_where_the_input_rests_in_one_record_the_others_tell():
    u = RNG.standard_normal((20_000, 1))
    white_noise = RNG.standard_normal((2000, 1))
    resting = (np.zeros((2000, 1)), 1e-3 * white_noise)
    parts = [(u, u), resting]
    actual = multiple_coherence(parts, 64)
    np.testing.assert_allclose(actual, 1, atol=1e-3)
    actual = multiple_coherence([resting], 64)
    np.testing.assert_allclose(actual, 0, atol=1e-9)


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
    scored = [part[500 + LAGS :] for part in (y[4000:5000], y[5000:])]
    power = sum(float((part**2).sum()) for part in scored)
    parts = [part - part.mean() for part in (y[4000:5000], y[5000:])]
    mean = float((np.concatenate(parts) ** 2).mean())
    varied = sum(map(len, scored)) * mean
    owed = unmodelled_input_share(case(WHITE, y, slow=0.3))
    expected = power / 4 / varied
    assert owed == pytest.approx(expected, rel=1e-4)


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
    (found,) = feedback.judge_feedback(case(u, y))
    assert found.level == "doubt"
    assert "as in a closed-loop log: name its set point" in found.sentence
    assert not list(feedback.judge_feedback(case(u, answer(u, noise=0.03))))


@pytest.mark.parametrize("pole", [1.02, 1.05, 1.2])
@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_a_plant_that_a_loop_keeps_from_running_away_is_refused_with_the_reason(pole, noise):
    asked = LEVELS.repeat(10)[:6000]
    rng = np.random.default_rng(1)
    x = 0.0
    log = np.zeros((6000, 2))
    for k in range(6000):
        y = x + noise * rng.standard_normal()
        difference = asked[k] - y
        log[k] = difference, y
        x = pole * x + 0.3 * log[k, 0]
    doubted, refused = feedback.judge_feedback(case(*log.T))
    assert doubted.level == "doubt"
    assert refused.level == "cannot judge"
    assert float(refused.sentence.split("a mode at ")[1].split()[0]) == pytest.approx(
        pole, abs=0.005
    )
    assert "log its loop with the set point as the input" in refused.sentence
    assert not [
        found
        for found in feedback.judge_feedback(case(asked, log[:, 1]))
        if found.level == "cannot judge"
    ]


@pytest.mark.parametrize(
    "u", [WHITE, LEVELS, np.sign(LEVELS), scipy.signal.lfilter([0.1], [1, -0.9], WHITE)]
)
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_log_in_open_loop_is_not_taken_for_a_closed_one(u, noise):
    assert feedback.feedback_share(case(u, answer(u, noise=noise)).data, 0) < feedback.EARLIER
    upper_limit = feedback.EARLIER / 2
    assert (
        feedback.feedback_share(case(u, answer(np.tanh(3 * u), noise=noise)).data, 1) < upper_limit
    )


def test_a_model_with_neurons_is_judged():
    """One that has nothing to do with the log: no judgement of the plant."""
    data = case(LEVELS, answer(LEVELS)).data
    other = model()
    parts = (data.validation, data.test)
    validation, test = (Simulation.simulate_records(other, part, 0) for part in parts)
    mismatch = measure_mismatch(other, data.validation)
    judgement = collect_findings(data, other, validation, test, mismatch)
    level = judgement.level
    assert level == CANNOT_JUDGE


def test_inputs_that_oppose_each_other_have_their_own_response():
    """The response of `x+ = 0.9 x + u_1 - u_2` is that of either input alone: 90 % of the sum of
    `0.9^k` are over after 22 samples."""
    a = np.array([[0.9]])
    c = np.ones((1, 1))
    for b in ([[1.0]], [[1.0, -1.0]]):
        d = np.zeros((1, len(b[0])))
        linear = StateSpace(a=a, b=np.array(b), c=c, d=d)
        assert linear.impulse_response_length() == 23  # the first answers at sample 1


def test_a_short_record_is_said_to_have_the_lags_it_has():
    late = case(LEVELS, answer(LEVELS))
    record = late.validation.records[0][:60]
    drifted = record.y + np.linspace(-1, 1, 60)[:, None]
    part = replace(late.validation, records=(record,), simulated=(drifted,))
    changed_late = replace(late, validation=part)
    (found,) = judge_whiteness(changed_late)
    assert "of 14 lags" in found.sentence


@pytest.mark.parametrize("moved", ["input", "output"])
def test_a_test_record_beyond_the_training_records_is_told_of_the_signal_that_is(moved):
    """Twice the input far away; or the same input, and an output that something else has lifted."""
    u = LEVELS.copy()
    y = answer(LEVELS)
    if moved == "input":
        u[5000:] *= 2.0
    else:
        y[5000:] += 3.0 * np.ptp(y[:4000])
    (told,) = _judge_range(case(u, y))
    assert f"test record's {moved} is beyond the training records" in told
    assert not [*_judge_range(case(LEVELS, answer(LEVELS)))]


@pytest.mark.parametrize("kept", [records.WINDOW, records.WINDOW + 1])
def test_a_test_record_that_is_the_end_of_a_training_record_is_found_to_its_last_sample(kept):
    found = case(WHITE, answer(WHITE))
    end = found.data.training[0]
    assert list(records._judge_repetition(found)) == []
    u = end.u[-kept:]
    y = end.y[-kept:]
    changed_end = replace(end, u=u, y=y)
    test = (changed_end,)
    taken = replace(found, data=replace(found.data, test=test))
    (said,) = records._judge_repetition(taken)
    assert said.startswith("100 % of the test record is part of the training records")


def test_a_controller_that_acts_a_sample_late_is_found_by_the_outputs_before():
    """With little noise the present output explains less than the limit, and so do those of two
    samples ago."""
    u, y = in_loop(REFERENCES["steps"], 0.007, 1)
    firsts = (0, 1, 2)
    present, before, two_ago = (feedback.feedback_share(case(u, y).data, first) for first in firsts)
    assert two_ago < feedback.EARLIER < before < feedback.PRESENT > present
    (found,) = feedback.judge_feedback(case(u, y))
    assert "as in a closed-loop log" in found.sentence
