"""How a log is cut: in time, named intervals, folds, or blocks where its end is unlike its
beginning."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.data.recorded import RecordedData
from ssm_study.data.splits import (
    cut_out_fold,
    is_test_output_different,
    periodic_segments,
    split_at_intervals,
    split_by_fold,
    split_by_time,
    split_into_blocks,
)
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory


def record(samples: int) -> Trajectory:
    ramp = np.arange(samples, dtype=float)[:, None]
    return Trajectory(u=ramp, y=ramp + 0.5, step_s=0.1)


@given(st.integers(40, 400), st.floats(0.1, 0.4), st.floats(0.1, 0.4))
def test_every_sample_stands_in_exactly_one_part(samples, validation, test):
    log = record(samples)
    by_time = split_by_time(log, validation, test)
    by_fold = [split_by_fold(log, fold, 5) for fold in range(5)]
    for parts in (by_time, split_into_blocks(log), *by_fold):
        pieces = [piece for part in parts for piece in part]
        numbers = [piece.u[:, 0] for piece in pieces]
        actual = np.sort(np.concatenate(numbers))
        expected = log.u[:, 0]
        np.testing.assert_array_equal(actual, expected)
        firsts = [piece.first for piece in pieces]
        expected = [piece.u[0, 0] for piece in pieces]
        assert firsts == expected


def test_named_intervals_are_cut_out_and_the_rest_trains():
    named = {"validation": [[2.0, 3.0]], "test": [[0.0, 1.0], [9.0, 10.0]]}
    training, validation, test = split_at_intervals(record(100), named)
    expected = [(10, 19), (30, 89)]
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in training] == expected
    expected = [(20, 29)]
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in validation] == expected
    expected = [(0, 9), (90, 99)]
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in test] == expected


@given(st.integers(40, 400), st.integers(2, 8))
def test_every_sample_is_tested_in_exactly_one_fold(samples, folds):
    log_to_cut = record(samples)
    cuts = [split_by_fold(log_to_cut, fold, folds) for fold in range(folds)]
    tested_pieces = [piece.u[:, 0] for _, _, test in cuts for piece in test]
    tested = np.concatenate(tested_pieces)
    expected = np.arange(samples)
    np.testing.assert_array_equal(tested, expected)
    one_piece_each = [len(test) == len(validation) == 1 for _, validation, test in cuts]
    assert all(one_piece_each)
    deviations = [abs(len(test[0]) - samples / folds) for _, _, test in cuts]
    assert max(deviations) < 1


@given(st.integers(40, 400), st.integers(2, 8))
def test_what_a_fold_leaves_and_holds_out_is_the_record(samples, folds):
    for fold in range(folds):
        kept, out = cut_out_fold(record(samples), fold, folds)
        signals = [piece.u[:, 0] for piece in (*kept, out)]
        pieces = np.sort(np.concatenate(signals))
        expected = np.arange(samples)
        np.testing.assert_array_equal(pieces, expected)
        difference = abs(len(out) - samples / folds)
        assert difference <= 1


def test_stretches_between_rests_count_where_each_repeats_itself():
    rest = np.zeros(40)
    rng = np.random.default_rng(0)
    period = rng.uniform(-1, 1, size=40)
    twice_the_period = 2 * period
    twice = np.concatenate([rest, period, period, rest, twice_the_period, twice_the_period, rest])
    u = twice[:, None]
    y = twice[:, None]
    moved = Trajectory(u=u, y=y, step_s=0.1)
    pieces = periodic_segments(moved, 0)
    expected = [140, 141]
    assert [len(piece) for piece in pieces] == expected  # half a rest, two periods, a rest
    twice_the_period = 2 * period
    once = np.concatenate([rest, period, rest, twice_the_period, twice_the_period, rest])
    u = once[:, None]
    y = once[:, None]
    trajectory = Trajectory(u=u, y=y, step_s=0.1)
    assert not periodic_segments(trajectory, 0)
    assert not periodic_segments(moved[40:], 0)  # begins in motion


def test_the_last_of_five_folds_is_the_cut_in_time():
    pieces = split_by_fold(record(100), 4, 5)
    by_time = split_by_time(record(100), 0.2, 0.2)
    for fold, time in zip(pieces, by_time, strict=True):
        actual = fold[0].u
        expected = time[0].u
        np.testing.assert_array_equal(actual, expected)


WRONG_INTERVALS = [
    [[3.0, 2.0]],
    [[9.0, 10.5]],
    [[0.0, 1.0], [0.5, 2.0]],
    [[3.0]],
    [[0.0, 1.0, 2.0]],
    [[0.0, np.inf]],
    [0.0, 1.0],
    [["a", "b"]],
]


@pytest.mark.parametrize("wrong", WRONG_INTERVALS)
def test_intervals_that_cannot_be_are_refused(wrong):
    validation = [[5.0, 6.0]]
    named = {"validation": validation, "test": wrong}
    with pytest.raises(BadRequest, match=r"data\.test"):
        split_at_intervals(record(100), named)


def log(path, y: np.ndarray) -> RecordedData:
    sine = np.sin(np.arange(len(y)))
    columns = np.column_stack([sine, y])
    np.savetxt(path, columns, delimiter=",", header="u,y", comments="")
    return RecordedData(path=str(path), input="u", output="y", step_s=0.1, start_up_samples=10)


def test_the_default_says_which_it_took(tmp_path):
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(1000)
    alike = log(tmp_path / "alike.csv", white_noise).build(0)
    assert alike.metadata["split"] == "in the order of time"
    assert len(alike.training) == 1
    white_noise = rng.standard_normal(1000)
    step = 4 * (np.arange(1000) > 800)
    moved = log(tmp_path / "moved.csv", white_noise + step).build(0)
    assert "interleaved blocks, because its end" in moved.metadata["split"]
    assert len(moved.training) == 6
    assert len(moved.validation) == 2
    assert len(moved.test) == 2
    (tmp_path / "folds").mkdir()
    log_path = tmp_path / "folds" / "log.csv"
    white_noise = rng.standard_normal(1000)
    default = log(log_path, white_noise)
    held_out = replace(default, fold=2).build(0)
    split = held_out.metadata["split"]
    assert split.startswith("into 5 folds, of which number 2 tests")
    assert len(held_out.training) == 2
    assert len(held_out.validation[0]) == 200
    assert len(held_out.test[0]) == 200


def test_an_end_unlike_the_beginning_is_seen_in_validation_and_test():
    rng = np.random.default_rng(0)
    parts = split_by_time(record(500), 0.2, 0.2)
    assert is_test_output_different(parts)
    noise = rng.standard_normal((200, 1))
    first = Trajectory(u=noise, y=noise, step_s=0.1)
    constant = np.full((200, 1), 9.0)
    odd = Trajectory(u=constant, y=constant, step_s=0.1)
    parts = ([first], [odd], [first])
    assert not is_test_output_different(parts)
    parts = ([odd], [first], [first])
    assert is_test_output_different(parts)


def test_a_split_that_leaves_nothing_is_refused(tmp_path):
    white_noise = np.random.default_rng(0).standard_normal(1000)
    log(tmp_path / "alike.csv", white_noise)
    validation = [[0.0, 50.0]]
    test = [[50.0, 100.0]]
    nothing = {"validation": validation, "test": test}
    path = str(tmp_path / "alike.csv")
    recorded_data = RecordedData(path=path, input="u", output="y", step_s=0.1, **nothing)
    with pytest.raises(BadRequest, match="no record is left to train on"):
        recorded_data.build(0)
    with pytest.raises(BadRequest, match="split"):
        RecordedData(path="a", input="u", output="y", split="random")
    test = [[0.0, 1.0]]
    with pytest.raises(BadRequest, match="validation"):
        RecordedData(path="a", input="u", output="y", test=test)


def test_the_rest_is_the_mean_of_the_training_records_alone(tmp_path):
    ramp = np.arange(1000.0)
    made = log(tmp_path / "log.csv", ramp).build(0)
    ramp_log = log(tmp_path / "log.csv", np.arange(1000.0))
    trained = replace(ramp_log, split="time").build(0)
    for data in (made, trained):
        shown = np.concatenate([one.y for one in data.training])
        actual = data.scale.output_equilibrium
        expected = shown.mean(axis=0)
        np.testing.assert_allclose(actual, expected, rtol=1e-12)
