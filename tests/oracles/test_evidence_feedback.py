"""Feedback in the records: logs of closed loops are doubted, those of open loops are not."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from test_evidence_false_reasons import SWEEP, motor_position, sentences
from test_evidence_limits import alternate, case_of_one, data_of
from test_evidence_response import LEVELS, WHITE, answer, answered, case

from ssm_study.evidence import feedback

SAMPLES = 6000


def in_loop(reference: np.ndarray, noise: float, delay: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The same lag under `u = r - y + 0.05 sum (r - y)`, the law `delay` samples late."""
    y = 0.0
    whole = 0.0
    rng = np.random.default_rng(7)
    samples = len(reference)
    inputs = np.zeros(samples)
    outputs = np.zeros(samples)
    late = [0.0] * delay
    for k, asked in enumerate(reference):
        measured = y + noise * rng.standard_normal()
        error = asked - measured
        whole += 0.05 * error
        late.append(error + whole)
        u = late.pop(0)
        inputs[k] = u
        outputs[k] = measured
        saturated = np.tanh(1.5 * u)
        y = 0.9 * y + 0.1 * saturated
    return inputs, outputs


SLOW_LEVELS = LEVELS.repeat(5)[:SAMPLES]
SINE = 0.5 * np.sin(0.05 * np.arange(SAMPLES))
REST = np.zeros(SAMPLES)
REFERENCES = {"steps": SLOW_LEVELS, "sine": SINE, "none": REST}


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("reference", REFERENCES)
def test_a_log_made_in_a_closed_loop_is_a_doubt_and_the_same_input_in_open_loop_is_none(
    reference, delay
):
    u, y = in_loop(REFERENCES[reference], 0.03, delay)
    closed_loop = case(u, y)
    (doubt,) = feedback.judge_feedback(closed_loop)
    assert doubt.level == "doubt"
    assert "as in a closed-loop log: name its set point" in doubt.sentence

    open_loop = answered(u, noise=0.03)
    findings = list(feedback.judge_feedback(open_loop))
    assert findings == []


def simulate_held_plant(set_point: np.ndarray, pole: float, noise: float) -> np.ndarray:
    """Input and output of an unstable plant under proportional feedback."""
    rng = np.random.default_rng(1)
    x = 0.0
    log = np.zeros((SAMPLES, 2))
    for k in range(SAMPLES):
        y = x + noise * rng.standard_normal()
        error = set_point[k] - y
        log[k] = error, y
        x = pole * x + 0.3 * error
    return log


@pytest.mark.parametrize("pole", [1.02, 1.05, 1.2])
@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_a_plant_that_a_loop_keeps_from_running_away_is_refused_with_the_reason(pole, noise):
    set_point = LEVELS.repeat(10)[:SAMPLES]
    u, y = simulate_held_plant(set_point, pole, noise).T
    doubted, refused = feedback.judge_feedback(case(u, y))
    assert doubted.level == "doubt"
    assert refused.level == "cannot judge"
    words = refused.sentence.split("a mode at ")[1]
    mode = float(words.split()[0])
    assert mode == pytest.approx(pole, abs=0.005)
    assert "log its loop with the set point as the input" in refused.sentence

    of_the_loop = feedback.judge_feedback(case(set_point, y))
    levels = [finding.level for finding in of_the_loop]
    assert "cannot judge" not in levels


def simulate_levitation(set_point: np.ndarray, pull: float) -> np.ndarray:
    """Input and output of `y'' = 2.4e-3 (pull y + u)` a sample, held by a loop whose gain lets the
    sensor's noise through; without the loop it falls where `pull` is one, and swings where it is
    minus one."""
    rng = np.random.default_rng(1)
    y = 0.0
    speed = 0.0
    log = np.zeros((SAMPLES, 2))
    for k in range(SAMPLES):
        measured = y + 0.03 * rng.standard_normal()
        error = set_point[k] - measured
        braking = 50.0 * speed
        u = 3.0 * error - braking
        log[k] = u, measured
        force = pull * y + u
        speed += 2.4e-3 * force
        y += speed
    return log


@pytest.mark.parametrize(("pull", "is_refused"), [(1.0, True), (-1.0, False)])
def test_noise_that_the_loop_feeds_back_hides_no_plant_that_runs_away(pull, is_refused):
    """Models of up to eight lags show a mode of 1.03 at most, where it is 1.05."""
    set_point = LEVELS.repeat(20)[:SAMPLES]
    u, y = simulate_levitation(set_point, pull).T
    log = case(u, y)
    modes = [feedback.dominant_pole_modulus(log.data, lags) for lags in feedback.LAGS]
    slowest = min(modes)
    assert slowest < 1.01
    findings = list(feedback.judge_feedback(log))
    levels = [finding.level for finding in findings]
    assert levels[0] == "doubt"
    found = "cannot judge" in levels
    assert found is is_refused


LOW_PASSED = scipy.signal.lfilter([0.1], [1, -0.9], WHITE)
TWO_LEVELS = np.sign(LEVELS)


@pytest.mark.parametrize("u", [WHITE, LEVELS, TWO_LEVELS, LOW_PASSED])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_log_in_open_loop_is_not_taken_for_a_closed_one(u, noise):
    linear = answered(u, noise=noise)
    saturated_u = np.tanh(3 * u)
    y = answer(saturated_u, noise=noise)
    saturated = case(u, y)
    of_linear = feedback.feedback_error_reduction(linear.data, 0)
    assert of_linear < feedback.EARLIER
    of_saturated = feedback.feedback_error_reduction(saturated.data, 1)
    assert of_saturated < feedback.EARLIER / 2


def test_a_controller_that_acts_a_sample_late_is_found_by_the_outputs_before():
    """With little noise the present output explains less than the limit, and so do those of two
    samples ago."""
    u, y = in_loop(SLOW_LEVELS, 0.007, 1)
    log = case(u, y)

    present = feedback.feedback_error_reduction(log.data, 0)
    before = feedback.feedback_error_reduction(log.data, 1)
    two_ago = feedback.feedback_error_reduction(log.data, 2)
    (doubt,) = feedback.judge_feedback(log)

    assert two_ago < feedback.EARLIER < before
    assert before < feedback.PRESENT
    assert present < feedback.PRESENT
    assert "as in a closed-loop log" in doubt.sentence


def test_a_loop_shows_above_what_chance_adds():
    few = data_of(alternate(299), alternate(300), alternate(300))
    assert not feedback.shows_closed_loop(few, 1.0, 1.0)
    enough = data_of(alternate(300), alternate(300), alternate(300))
    assert feedback.shows_closed_loop(enough, 0.0, 1.0)
    more = data_of(alternate(400), alternate(300), alternate(300))
    assert feedback.shows_closed_loop(more, 0.1, 0.0)
    assert not feedback.shows_closed_loop(more, 0.099, 0.0)


SET_POINTS = [("0.20", "note"), ("0.19", "doubt")]


@pytest.mark.parametrize(("share", "level"), SET_POINTS)
def test_a_set_point_explains_a_fifth_of_the_input(share, level, monkeypatch):
    monkeypatch.setattr(feedback, "judge_instability", lambda *_, **__: [])
    judged = case_of_one(alternate(300))
    data = replace(judged.data, metadata={"by_set_point": share})
    staged = replace(judged, data=data)
    (finding,) = feedback.judge_feedback(staged)
    assert finding.level == level
    assert f"{share[2:]} % of its power" in finding.sentence


def test_a_model_that_integrates_is_not_advised_to():
    position = motor_position(SWEEP, 60)
    for slow, is_said in ((1.0, False), (0.99, True)):
        log = case(SWEEP, position, slow=slow)
        text = sentences(feedback.judge_feedback(log))
        assert ("use model.integrating_output=true" in text) is is_said


# Over 900 samples by these logarithms, beside 2.03 and -0.5.
WALK = 2.0
GROWTH = 2.1
KEPT = -0.49
LOST = -0.51
INTEGRATES = "integrates its input"
RUNS_AWAY = "runs away by itself"
IN_OPEN_LOOP = [
    (WALK, 0.5, 9.0, ""),
    (WALK, 0.6, 9.0, INTEGRATES),
    (GROWTH, 0.5, 4.0, ""),
    (GROWTH, 0.5, 4.1, RUNS_AWAY),
    (KEPT, 0.6, 0.0, INTEGRATES),
    (LOST, 0.6, 0.0, ""),
]
IN_LOOP = [(900 * np.log(1.01), 0.6, 9.0, ""), (9.9, 0.6, 0.0, RUNS_AWAY)]


def words_on_instability(monkeypatch, growth, by_input, by_itself, in_loop) -> str:
    """Sentences on a mode that grows by this logarithm over all samples."""
    mode = float(np.exp(growth / 900))
    monkeypatch.setattr(feedback, "dominant_pole_modulus", lambda *_: mode)
    monkeypatch.setattr(feedback, "increment_statistics", lambda _: (by_input, by_itself))
    monkeypatch.setattr(feedback, "integrator_share", lambda _: None)
    signal = alternate(300)
    data = data_of(signal, signal, signal)
    return sentences(feedback.judge_instability(data, is_closed_loop=in_loop))


@pytest.mark.parametrize(("growth", "by_input", "by_itself", "words"), IN_OPEN_LOOP)
def test_what_grows_and_what_lasts_in_open_loop(growth, by_input, by_itself, words, monkeypatch):
    text = words_on_instability(monkeypatch, growth, by_input, by_itself, False)
    assert bool(text) == bool(words)
    assert words in text


@pytest.mark.parametrize(("growth", "by_input", "by_itself", "words"), IN_LOOP)
def test_what_grows_in_a_loop(growth, by_input, by_itself, words, monkeypatch):
    text = words_on_instability(monkeypatch, growth, by_input, by_itself, True)
    assert bool(text) == bool(words)
    assert words in text
