"""Reasons that were false, each with its smallest case, beside the case in which it is true."""

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.signal
from test_evidence_response import LEVELS, WHITE, answer, case

from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence import feedback, fit, records
from ssm_study.evidence.finding import EvidenceCase
from ssm_study.models.metrics import Simulation
from ssm_study.signals import Channel, DataSet, Trajectory

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SHARED = SHARED_DATA / "logs_small"
RNG = np.random.default_rng(7)


def sentences(findings) -> str:
    return " ".join(finding.sentence for finding in findings)


def blocks(u: np.ndarray, y: np.ndarray, cuts: list[int]) -> DataSet:
    """One log cut into pieces: training, then one for validation, then one for test, and again."""
    inputs = u[:, None]
    outputs = y[:, None]
    log = Trajectory(u=inputs, y=outputs, step_s=0.1)
    edges = [0, *cuts, len(u)]
    pieces = [replace(log[first:end], log=1, first=first) for first, end in pairwise(edges)]
    rest = np.zeros(1)
    channel = Channel(name="a", unit="")
    training = pieces[0::3]
    validation = pieces[1::3]
    test = pieces[2::3]
    parts = (training, validation, test)
    changed_channel = replace(channel, name="b")
    channels = ((channel,), (changed_channel,))
    equilibrium = (rest, rest)
    return assemble_dataset(parts, equilibrium, channels, 0)


def with_runs(data: DataSet, model, error: float) -> EvidenceCase:
    """Free runs that miss every record by white noise of this size."""
    parts = {}
    for name in ("validation", "test"):
        part = getattr(data, name)
        runs = []
        for record in part:
            white_noise = RNG.standard_normal(record.y.shape)
            runs.append(record.y + error * white_noise)
        parts[name] = Simulation(records=part, simulated=runs, start_up_samples=0)
    return EvidenceCase(data=data, model=model, **parts)


def test_blocks_that_stand_still_are_judged_by_the_fit_that_the_outcome_prints():
    """Five levels, each block within one: about its own mean every block is fitted by -900 %."""
    y = np.repeat([0.0, 1.0, -1.0, 0.5, -0.5, 0.2, 0.9, -0.7, 0.3], 100)
    white_noise = RNG.standard_normal(900)
    y = y + 0.002 * white_noise
    data = blocks(y, y, list(range(100, 900, 100)))
    lagging_case = case(LEVELS, answer(LEVELS))
    model = lagging_case.model
    judged = with_runs(data, model, 0.02)
    headline = judged.test.fit_percent
    assert headline > 90
    fit_percent = judged.validation.fit_percent
    smallest = min(headline, fit_percent)
    largest = max(headline, fit_percent)
    assert smallest <= fit.pooled_fit_percent(judged) <= largest
    assert fit.judge_poor_fit(judged) == []
    unmodelled = fit.unmodelled_output_share(judged)
    assert unmodelled < fit.OWED


def test_a_small_error_on_records_that_hardly_move_is_a_doubt_with_both_numbers():
    denominator = [1, -0.9]
    excitation = LEVELS[:900]
    moving = scipy.signal.lfilter([0.1], denominator, excitation)
    white_noise = RNG.standard_normal(600)
    moving[300:] = 0.5 + 0.001 * white_noise
    cuts = [300, 600]
    moved_little = blocks(excitation, moving, cuts)
    model = case(WHITE, WHITE).model
    judged = with_runs(moved_little, model, 0.005)
    (doubt,) = fit.judge_poor_fit(judged)
    assert doubt.level == "doubt"
    assert "of the output's range" in doubt.sentence
    assert f"the test record by {judged.test.fit_percent:.1f} %" in doubt.sentence
    same_records = blocks(excitation, moving, cuts)
    hopeless = with_runs(same_records, judged.model, 1.0)
    assert [finding.level for finding in fit.judge_poor_fit(hopeless)] == ["cannot judge"]


def test_a_poor_fit_blames_the_model_where_a_filter_does_better_and_the_log_where_none_does():
    opposite_answer = -answer(LEVELS)
    inverted = case(LEVELS, opposite_answer)
    (finding,) = fit.judge_poor_fit(inverted)
    assert finding.level == "cannot judge"
    assert f"a linear filter of 40 taps by {fit.fir_fit_percent(inverted):.1f} %" in (
        finding.sentence
    )
    assert "record more" not in finding.sentence
    noise_alone = RNG.standard_normal(len(LEVELS))
    unrelated = case(LEVELS, noise_alone)
    (finding,) = fit.judge_poor_fit(unrelated)
    assert "record more of what moves the output" in finding.sentence


def test_a_coarse_sensor_repeats_itself_by_chance_and_a_copied_record_does_not():
    noisy = answer(LEVELS, noise=0.1)
    coarse = np.round(noisy / 0.25) * 0.25
    data = case(LEVELS, coarse).data
    share_of_repetitions = records.repeated_test_share(data)
    assert share_of_repetitions < records.PART
    first_inputs = LEVELS[:1000]
    repeated_input = np.tile(first_inputs, 6)
    first_outputs = coarse[:1000]
    repeated_output = np.tile(first_outputs, 6)
    copied = case(repeated_input, repeated_output).data
    assert records.repeated_test_share(copied) > 0.9


def test_a_coarse_sensor_behind_an_input_that_stands_still_repeats_itself_by_chance():
    u = np.repeat([0.0, 0.5, -0.4, 0.8, 0.1, -0.6], 1000)
    measured = answer(u, noise=0.02)
    coarse = np.round(measured / 0.1) * 0.1
    data = case(u, coarse).data
    share_of_repetitions = records.repeated_test_share(data)
    assert share_of_repetitions < records.PART


def rectified(u: np.ndarray) -> np.ndarray:
    """Speed of a machine that turns one way and stands still half of the time."""
    beyond_the_threshold = np.maximum(u - 0.2, 0)
    denominator = [1, -0.9]
    filtered_signal = scipy.signal.lfilter([0.1], denominator, beyond_the_threshold)
    return filtered_signal.round(3)


def test_a_machine_at_rest_does_not_saturate_and_a_clipped_output_does():
    slow = LEVELS[:600].repeat(10)
    at_rest = case(slow, rectified(slow))
    doubts = records._saturation_findings(at_rest)
    assert not list(doubts)
    clipped = np.clip(answer(LEVELS), -0.3, 0.3)
    clipped_case = case(LEVELS, clipped)
    findings = list(records._saturation_findings(clipped_case))
    count = sentences(findings).count("it saturates")
    assert count == 2
    assert {finding.level for finding in findings} == {"doubt"}


def test_a_machine_that_stops_at_once_stands_at_zero_and_a_sensor_that_ends_elsewhere_saturates():
    """Below its dead zone the machine stops within a sample, while the input goes on moving."""
    stopping = np.maximum(answer(LEVELS), 0.0)
    stopping_case = case(LEVELS, stopping)
    (finding,) = records._saturation_findings(stopping_case)
    assert finding.level == "note"
    assert "stands at 0 in" in finding.sentence
    moved_up = case(LEVELS, stopping + 3.0)
    (shifted,) = records._saturation_findings(moved_up)
    assert shifted.level == "doubt"
    assert "it saturates" in shifted.sentence


def test_a_position_at_its_farthest_does_not_saturate():
    whole_turns = 2 * np.pi
    angles = whole_turns * np.arange(6000) / 800
    sine = np.sin(angles)
    u = 255 * sine
    position = motor_position(u, 60)
    moving_case = case(u, position)
    doubts = records._saturation_findings(moving_case)
    assert not list(doubts)


def test_changes_count_across_the_cuts_of_a_log():
    """Steps every 100 samples, cut at the steps: each piece alone holds its input still."""
    u = np.repeat(RNG.uniform(-1, 1, 36), 100)
    data = blocks(u, u, list(range(100, 3600, 100)))
    assert records.count_input_changes(data) == 11
    heights = [0.0, 1.0, 0.0]
    once = np.repeat(heights, [50, 100, 3450])  # up where it trains, down where it validates
    cuts_of_the_log = list(range(100, 3600, 100))
    climbing = blocks(once, once + u, cuts_of_the_log)
    input_changes = records.count_input_changes(climbing)
    assert input_changes == 1


def motor_position(u: np.ndarray, dead: float) -> np.ndarray:
    """A motor's lag behind a dead zone, integrated and rounded as an encoder does."""
    difference = np.abs(u) - dead
    drive = np.sign(u) * np.maximum(difference, 0)
    uneven = np.where(drive < 0, 0.7 * drive, drive)
    numerator = [0, 0.2]
    denominator = [1, -0.8]
    speed = scipy.signal.lfilter(numerator, denominator, uneven)
    running_sum = np.cumsum(speed)
    return np.round(0.05 * running_sum)


PERIODS = np.arange(6000) / 100
SWEEP = 255 * scipy.signal.sawtooth(PERIODS, 0.5)


INPUTS = [SWEEP, 255 * LEVELS]


@pytest.mark.parametrize("dead", [0, 60])
@pytest.mark.parametrize("u", INPUTS, ids=["sweep", "levels"])
def test_a_motor_position_integrates_and_does_not_run_away(u, dead):
    position = motor_position(u, dead)
    log = case(u, position)
    words = sentences(feedback.judge_feedback(log))
    assert "runs away" not in words


def test_where_a_mode_seems_to_grow_the_integrator_is_recommended():
    position = motor_position(SWEEP, 60)
    log = case(SWEEP, position)
    smallest = min(feedback.dominant_pole_modulus(log.data, lags) for lags in feedback.LAGS)
    assert smallest > 1
    growth = feedback.increment_statistics(log.data)
    assert growth[1] < feedback.GROWS


@pytest.mark.parametrize("pole", [1.002, 1.004, 1.01])
def test_what_runs_away_still_grows_with_itself(pole):
    u = LEVELS[:1000]
    numerator = [0, 0.1]
    denominator = [1, -pole]
    y = scipy.signal.lfilter(numerator, denominator, u)
    inputs = u[:, None]
    outputs = y[:, None]
    log = Trajectory(u=inputs, y=outputs, step_s=0.1)
    logged_inputs = log.u[:, 0]
    logged_outputs = log.y[:, 0]
    data = blocks(logged_inputs, logged_outputs, [600, 800])
    growth = feedback.increment_statistics(data)
    assert growth[1] > feedback.GROWS


@pytest.mark.parametrize("u", [WHITE, LEVELS], ids=["white", "levels"])
def test_an_answer_within_the_sample_is_feedthrough_and_no_closed_loop(u):
    filtered_signal = scipy.signal.lfilter([0.3], [1, -0.7], u)
    white_noise = RNG.standard_normal(len(u))
    y = filtered_signal + 0.02 * white_noise
    log = case(u, y)
    assert feedback.feedback_error_reduction(log.data, 0) > feedback.PRESENT
    (finding,) = feedback.judge_feedback(log)
    assert "use model.feedthrough=true" in finding.sentence
    assert "closed-loop" not in finding.sentence


SAMPLED_LOGS = sorted(SHARED.glob("*_sample_*.csv"))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
@pytest.mark.parametrize("path", SAMPLED_LOGS, ids=lambda path: path.stem)
def test_small_logs_that_answer_within_the_sample(path):
    table = pd.read_csv(path)
    u = table["u"].to_numpy()
    y = table["y"].to_numpy()
    data = blocks(u, y, [2000, 2500])
    model = case(WHITE, WHITE).model
    noisy_case = with_runs(data, model, 0.1)
    words = sentences(feedback.judge_feedback(noisy_case))
    assert "closed-loop" not in words
    expected = "same_sample" in path.name
    assert ("model.feedthrough=true" in words) == expected


POSITION_LOGS = sorted(SHARED.glob("pos_*.csv"))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
@pytest.mark.parametrize("path", POSITION_LOGS, ids=lambda path: path.stem)
def test_small_logs_of_a_position_do_not_run_away(path):
    table = pd.read_csv(path)
    u, y = (table[name].to_numpy(float) for name in "uy")
    length = len(u)
    difference = y - y[0]
    data = blocks(u, difference, [length * 6 // 10, length * 8 // 10])
    words = sentences(
        feedback.judge_instability(data, is_closed_loop=False, has_integrating_model=False)
    )
    assert "runs away" not in words
    if "sweep" in path.name:
        assert "use model.integrating_output=true" in words


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
def test_a_slow_sweep_of_a_static_characteristic_has_no_false_reason():
    """A speed that is either 51 or 0, read by whole numbers, under an input that climbs and falls:
    it neither saturates nor runs away, is in no loop and integrates nothing."""
    path = SHARED / "static.csv"
    recorded_data = RecordedData(path=str(path), input="us", output="rpm", step_s=1.0)
    read = recorded_data.build(0)
    parts = (read.training, read.validation, read.test)
    length = sum(len(part[0]) for part in parts)
    assert length == 1440
    table = pd.read_csv(path)
    u = table["us"].to_numpy() - 1250.0
    speed = table["rpm"].to_numpy(float)
    data = blocks(u, speed - 35.0, [864, 1152])
    model = case(WHITE, WHITE).model
    log = with_runs(data, model, 0.1)
    assert not list(feedback.judge_feedback(log))
    searches = (
        records._range_sentences,
        records._input_level_sentences,
        records._repetition_sentences,
    )
    assert not [sentence for search in searches for sentence in search(log)]
    assert not list(records._saturation_findings(log))
    log_look = look(path, step_s=1.0)
    overview = str(log_look)
    assert "its level explains 91% of the output" in overview
    assert "closed loop" not in overview
    assert "integrator" not in overview


def short_log(pole: float) -> EvidenceCase:
    """A short log of a lag, or of a sum, with a model that integrates."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 60), 10)
    noise = 0.001 * rng.standard_normal(600)
    numerator = [0, 0.1]
    denominator = [1, -pole]
    clean_answer = scipy.signal.lfilter(numerator, denominator, u)
    y = clean_answer + noise
    model = case(WHITE, WHITE, slow=1.0).model
    data = blocks(u, y, [360, 480])
    return with_runs(data, model, 0.01)


def test_an_integrating_model_speaks_for_the_output_only_where_the_log_does():
    """A yaw rate returns slowly; the model that was chosen holds it for ever."""
    (returns,) = records._length_sentences(short_log(0.95))
    assert "The chosen model integrates its input, and the log does not show" in returns
    (sums,) = records._length_sentences(short_log(1.0))
    assert "The output integrates its input" in sums


def test_an_integrator_is_not_blamed_for_a_position_it_has_not_been_at():
    drifting = short_log(1.0)
    changed_records = [replace(record, y=record.y + 100.0) for record in drifting.data.test]
    changed_data = replace(drifting.data, test=tuple(changed_records))
    beyond = replace(drifting, data=changed_data)
    about_the_output = [
        sentence for sentence in records._range_sentences(beyond) if "output" in sentence
    ]
    assert not about_the_output
    lagging_model = case(WHITE, WHITE, slow=0.9).model
    lag = replace(beyond, model=lagging_model)
    doubts = records._range_sentences(lag)
    assert [sentence for sentence in doubts if "output is beyond" in sentence]


def test_an_output_that_follows_its_input_is_not_told_to_integrate():
    u = np.repeat(RNG.uniform(-1, 1, 30), 40)
    noise = 0.01 * RNG.standard_normal(1200)
    level = blocks(u, u + noise, [720, 960])
    assert records.output_follows_input_level(level)
    assert not records.output_follows_input_level(short_log(1.0).data)
