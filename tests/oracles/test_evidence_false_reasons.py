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
from ssm_study.evidence.finding import Case
from ssm_study.models.metrics import Simulation
from ssm_study.signals import Channel, DataSet, Trajectory

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import kind_named

SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SHARED = SHARED_DATA / "logs_small"
RNG = np.random.default_rng(7)


def sentences(findings) -> str:
    return " ".join(finding.sentence for finding in findings)


def blocks(u: np.ndarray, y: np.ndarray, cuts: list[int]) -> DataSet:
    """One log cut into pieces: training, then one for validation, then one for test, and again."""
    log = Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)
    edges = [0, *cuts, len(u)]
    pieces = [replace(log[first:end], log=1, first=first) for first, end in pairwise(edges)]
    rest = np.zeros(1)
    channel = Channel(name="a", unit="")
    parts = (pieces[0::3], pieces[1::3], pieces[2::3])
    changed_channel = replace(channel, name="b")
    channels = ((channel,), (changed_channel,))
    return assemble_dataset(parts, (rest, rest), channels, 0)


def with_runs(data: DataSet, model, error: float) -> Case:
    """Free runs that miss every record by white noise of this size."""
    parts = {}
    for name in ("validation", "test"):
        part = getattr(data, name)
        runs = tuple(one.y + error * RNG.standard_normal(one.y.shape) for one in part)
        parts[name] = Simulation(records=part, simulated=runs, start_up_samples=0)
    return Case(data=data, model=model, **parts)


def test_blocks_that_stand_still_are_judged_by_the_fit_that_the_outcome_prints():
    """Five levels, each block within one: about its own mean every block is fitted by -900 %."""
    y = np.repeat([0.0, 1.0, -1.0, 0.5, -0.5, 0.2, 0.9, -0.7, 0.3], 100)
    white_noise = RNG.standard_normal(900)
    y = y + 0.002 * white_noise
    data = blocks(y, y, list(range(100, 900, 100)))
    model = case(LEVELS, answer(LEVELS)).model
    judged = with_runs(data, model, 0.02)
    headline = judged.test.fit_percent
    assert headline > 90
    fit_percent = judged.validation.fit_percent
    smallest = min(headline, fit_percent)
    assert (
        smallest <= fit.pooled_fit_percent(judged) <= max(headline, judged.validation.fit_percent)
    )
    assert fit.judge_poor_fit(judged) == []
    assert fit.unmodelled_input_share(judged) < fit.OWED


def test_a_small_error_on_records_that_hardly_move_is_a_doubt_with_both_numbers():
    moving = scipy.signal.lfilter([0.1], [1, -0.9], LEVELS[:900])
    white_noise = RNG.standard_normal(600)
    moving[300:] = 0.5 + 0.001 * white_noise
    moved_little = blocks(LEVELS[:900], moving, [300, 600])
    model = case(WHITE, WHITE).model
    judged = with_runs(moved_little, model, 0.005)
    (found,) = fit.judge_poor_fit(judged)
    assert found.level == "doubt"
    assert "of the output's range" in found.sentence
    assert f"the test record by {judged.test.fit_percent:.1f} %" in found.sentence
    same_records = blocks(LEVELS[:900], moving, [300, 600])
    hopeless = with_runs(same_records, judged.model, 1.0)
    findings = fit.judge_poor_fit(hopeless)
    levels = [finding.level for finding in findings]
    assert levels == ["cannot judge"]


def test_a_poor_fit_blames_the_model_where_a_filter_does_better_and_the_log_where_none_does():
    inverted = case(LEVELS, -answer(LEVELS))
    (finding,) = fit.judge_poor_fit(inverted)
    assert finding.level == "cannot judge"
    assert f"a linear filter of 40 taps by {fit.fir_fit_percent(inverted):.1f} %" in (
        finding.sentence
    )
    assert "record more" not in finding.sentence
    unrelated = case(LEVELS, RNG.standard_normal(len(LEVELS)))
    (finding,) = fit.judge_poor_fit(unrelated)
    assert "record more of what moves the output" in finding.sentence


def test_a_coarse_sensor_repeats_itself_by_chance_and_a_copied_record_does_not():
    noisy = answer(LEVELS, noise=0.1)
    coarse = np.round(noisy / 0.25) * 0.25
    data = case(LEVELS, coarse).data
    assert records.repeated_test_share(data) < records.PART
    repeated_input = np.tile(LEVELS[:1000], 6)
    repeated_output = np.tile(coarse[:1000], 6)
    copied = case(repeated_input, repeated_output).data
    assert records.repeated_test_share(copied) > 0.9


def test_a_coarse_sensor_behind_an_input_that_stands_still_repeats_itself_by_chance():
    u = np.repeat([0.0, 0.5, -0.4, 0.8, 0.1, -0.6], 1000)
    measured = answer(u, noise=0.02)
    coarse = np.round(measured / 0.1) * 0.1
    data = case(u, coarse).data
    assert records.repeated_test_share(data) < records.PART


def rectified(u: np.ndarray) -> np.ndarray:
    """Speed of a machine that turns one way and stands still half of the time."""
    beyond_the_threshold = np.maximum(u - 0.2, 0)
    filtered_signal = scipy.signal.lfilter([0.1], [1, -0.9], beyond_the_threshold)
    return filtered_signal.round(3)


def test_a_machine_at_rest_does_not_saturate_and_a_clipped_output_does():
    slow = LEVELS[:600].repeat(10)
    at_rest = case(slow, rectified(slow))
    assert not list(records._judge_saturation(at_rest))
    clipped = np.clip(answer(LEVELS), -0.3, 0.3)
    findings = list(records._judge_saturation(case(LEVELS, clipped)))
    assert sentences(findings).count("it saturates") == 2
    levels = {finding.level for finding in findings}
    assert levels == {"doubt"}


def test_a_machine_that_stops_at_once_stands_at_zero_and_a_sensor_that_ends_elsewhere_saturates():
    """Below its dead zone the machine stops within a sample, while the input goes on moving."""
    stopping = np.maximum(answer(LEVELS), 0.0)
    (finding,) = records._judge_saturation(case(LEVELS, stopping))
    assert finding.level == "note"
    assert "stands at 0 in" in finding.sentence
    moved_up = case(LEVELS, stopping + 3.0)
    (shifted,) = records._judge_saturation(moved_up)
    assert shifted.level == "doubt"
    assert "it saturates" in shifted.sentence


def test_a_position_at_its_farthest_does_not_saturate():
    angles = 2 * np.pi * np.arange(6000) / 800
    sine = np.sin(angles)
    u = 255 * sine
    position = motor_position(u, 60)
    assert not list(records._judge_saturation(case(u, position)))


def test_changes_count_across_the_cuts_of_a_log():
    """Steps every 100 samples, cut at the steps: each piece alone holds its input still."""
    levels = RNG.uniform(-1, 1, 36)
    u = np.repeat(levels, 100)
    cuts = list(range(100, 3600, 100))
    data = blocks(u, u, cuts)
    assert records.count_input_changes(data) == 11
    heights = [0.0, 1.0, 0.0]
    once = np.repeat(heights, [50, 100, 3450])  # up where it trains, down where it validates
    cuts_of_the_log = list(range(100, 3600, 100))
    input_changes = records.count_input_changes(blocks(once, once + u, cuts_of_the_log))
    assert input_changes == 1


def motor_position(u: np.ndarray, dead: float) -> np.ndarray:
    """A motor's lag behind a dead zone, integrated and rounded as an encoder does."""
    difference = np.abs(u) - dead
    drive = np.sign(u) * np.maximum(difference, 0)
    uneven = np.where(drive < 0, 0.7 * drive, drive)
    speed = scipy.signal.lfilter([0, 0.2], [1, -0.8], uneven)
    running_sum = np.cumsum(speed)
    return np.round(0.05 * running_sum)


PERIODS = np.arange(6000) / 100
SWEEP = 255 * scipy.signal.sawtooth(PERIODS, 0.5)


@pytest.mark.parametrize("dead", [0, 60])
@pytest.mark.parametrize("u", [SWEEP, 255 * LEVELS], ids=["sweep", "levels"])
def test_a_motor_position_integrates_and_does_not_run_away(u, dead):
    log = case(u, motor_position(u, dead))
    findings = feedback.judge_feedback(log)
    told = sentences(findings)
    assert "runs away" not in told


def test_where_a_mode_seems_to_grow_the_integrator_is_recommended():
    log = case(SWEEP, motor_position(SWEEP, 60))
    smallest = min(feedback.dominant_mode_modulus(log.data, lags) for lags in feedback.LAGS)
    assert smallest > 1
    assert feedback.growth_statistics(log.data)[1] < feedback.GROWS


@pytest.mark.parametrize("pole", [1.002, 1.004, 1.01])
def test_what_runs_away_still_grows_with_itself(pole):
    u = LEVELS[:1000]
    y = scipy.signal.lfilter([0, 0.1], [1, -pole], u)
    log = Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)
    log = log
    data = blocks(log.u[:, 0], log.y[:, 0], [600, 800])
    assert feedback.growth_statistics(data)[1] > feedback.GROWS


@pytest.mark.parametrize("u", [WHITE, LEVELS], ids=["white", "levels"])
def test_an_answer_within_the_sample_is_feedthrough_and_no_closed_loop(u):
    filtered_signal = scipy.signal.lfilter([0.3], [1, -0.7], u)
    white_noise = RNG.standard_normal(len(u))
    y = filtered_signal + 0.02 * white_noise
    log = case(u, y)
    assert feedback.feedback_share(log.data, 0) > feedback.PRESENT
    (found,) = feedback.judge_feedback(log)
    assert "use model.feedthrough=true" in found.sentence
    assert "closed-loop" not in found.sentence


SAMPLED_LOGS = sorted(SHARED.glob("*_sample_*.csv"))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
@pytest.mark.parametrize("path", SAMPLED_LOGS, ids=lambda path: path.stem)
def test_small_logs_that_answer_within_the_sample(path):
    table = pd.read_csv(path)
    u = table["u"].to_numpy()
    y = table["y"].to_numpy()
    data = blocks(u, y, [2000, 2500])
    model = case(WHITE, WHITE).model
    findings = feedback.judge_feedback(with_runs(data, model, 0.1))
    told = sentences(findings)
    assert "closed-loop" not in told
    expected = "same_sample" in path.name
    assert ("model.feedthrough=true" in told) == expected


POSITION_LOGS = sorted(SHARED.glob("pos_*.csv"))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
@pytest.mark.parametrize("path", POSITION_LOGS, ids=lambda path: path.stem)
def test_small_logs_of_a_position_do_not_run_away(path):
    table = pd.read_csv(path)
    u, y = (table[name].to_numpy(float) for name in "uy")
    length = len(u)
    difference = y - y[0]
    cuts = [length * 6 // 10, length * 8 // 10]
    data = blocks(u, difference, cuts)
    findings = feedback.judge_instability(data, is_closed_loop=False, has_integrating_model=False)
    told = sentences(findings)
    assert "runs away" not in told
    if "sweep" in path.name:
        assert "use model.integrating_output=true" in told


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder of small logs is not there")
def test_a_slow_sweep_of_a_static_characteristic_has_no_false_reason():
    """A speed that is either 51 or 0, read by whole numbers, under an input that climbs and falls:
    it neither saturates nor runs away, is in no loop and integrates nothing."""
    path = SHARED / "static.csv"
    recorded_data = RecordedData(path=str(path), input="us", output="rpm", step_s=1.0)
    read = recorded_data.build(0)
    parts = (read.training, read.validation, read.test)
    assert sum(len(part[0]) for part in parts) == 1440
    table = pd.read_csv(path)
    u = table["us"].to_numpy() - 1250.0
    speed = table["rpm"].to_numpy(float)
    data = blocks(u, speed - 35.0, [864, 1152])
    model = case(WHITE, WHITE).model
    log = with_runs(data, model, 0.1)
    assert not list(feedback.judge_feedback(log))
    searches = (records._judge_range, records._judge_levels, records._judge_repetition)
    assert not [sentence for search in searches for sentence in search(log)]
    assert not list(records._judge_saturation(log))
    log_look = look(path, step_s=1.0)
    seen = str(log_look)
    assert "its level explains 91% of the output" in seen
    assert "closed loop" not in seen
    assert "integrator" not in seen


def short_log(pole: float) -> Case:
    """A short log of a lag, or of a sum, with a model that integrates."""
    rng = np.random.default_rng(1)
    levels = rng.uniform(-1, 1, 60)
    u = np.repeat(levels, 10)
    noise = 0.001 * rng.standard_normal(600)
    y = scipy.signal.lfilter([0, 0.1], [1, -pole], u) + noise
    model = case(WHITE, WHITE, slow=1.0).model
    data = blocks(u, y, [360, 480])
    return with_runs(data, model, 0.01)


def test_an_integrating_model_speaks_for_the_output_only_where_the_log_does():
    """A yaw rate returns slowly; the model that was chosen holds it for ever."""
    (returns,) = records._judge_length(short_log(0.95))
    assert "The chosen model integrates its input, and the log does not show" in returns
    (sums,) = records._judge_length(short_log(1.0))
    assert "The output integrates its input" in sums


def test_an_integrator_is_not_blamed_for_a_position_it_has_not_been_at():
    drifting = short_log(1.0)
    beyond = replace(
        drifting, data=replace(drifting.data, test=tuple(
            replace(one, y=one.y + 100.0) for one in drifting.data.test))
    )  # fmt: skip
    assert not [sentence for sentence in records._judge_range(beyond) if "output" in sentence]
    lagging_model = case(WHITE, WHITE, slow=0.9).model
    lag = replace(beyond, model=lagging_model)
    assert [sentence for sentence in records._judge_range(lag) if "output is beyond" in sentence]


def test_an_output_that_follows_its_input_is_not_told_to_integrate():
    levels = RNG.uniform(-1, 1, 30)
    u = np.repeat(levels, 40)
    noise = 0.01 * RNG.standard_normal(1200)
    level = blocks(u, u + noise, [720, 960])
    assert records.follows_input_level(level)
    assert not records.follows_input_level(short_log(1.0).data)


@pytest.mark.parametrize("seed", range(6))
def test_a_position_behind_a_dead_zone_integrates_whatever_the_seed(tmp_path: Path, seed: int):
    """An operator turns the motor round at its ends, so that a mode alone does not show the sum."""
    data_set = kind_of_log(tmp_path, "position_dead_zone", seed)
    sums = list(feedback.judge_instability(data_set, is_closed_loop=False))
    levels = [finding.level for finding in sums]
    assert levels == ["doubt"]
    assert "integrates its input" in sums[0].sentence
    assert "model.integrating_output=true" in sums[0].sentence


@pytest.mark.parametrize("name", ["slow_coarse", "bilinear", "dead_time", "saturating", "drifting"])
def test_what_settles_does_not_integrate(tmp_path: Path, name: str):
    data_set = kind_of_log(tmp_path, name, 0)
    assert not list(feedback.judge_instability(data_set, is_closed_loop=False))


def kind_of_log(folder: Path, name: str, seed: int) -> DataSet:
    """A log of `benchmarks/log_kinds.py`, read as a run reads it."""
    path = folder / "log.csv"
    kind_named(name).log(seed).to_csv(path, index=False)
    recorded_data = RecordedData(path=str(path), input="u", output="y", start_up_samples=20)
    return recorded_data.build(0)
