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
    counts = np.arange(samples, dtype=float)
    ramp = counts[:, None]
    return Trajectory(u=ramp, y=ramp + 0.5, step_s=0.1)


LENGTHS = st.integers(40, 400)
SHARES = st.floats(0.1, 0.4)
FOLDS = st.integers(2, 8)


def sorted_samples(pieces: list[Trajectory]) -> np.ndarray:
    """The samples of all pieces, in ascending order."""
    numbers = [piece.u[:, 0] for piece in pieces]
    joined = np.concatenate(numbers)
    return np.sort(joined)


@given(LENGTHS, SHARES, SHARES)
def test_every_sample_stands_in_exactly_one_part(samples, validation, test):
    log = record(samples)
    by_time = split_by_time(log, validation, test)
    by_fold = [split_by_fold(log, fold, 5) for fold in range(5)]
    in_blocks = split_into_blocks(log)
    for training, validated, tested in (by_time, in_blocks, *by_fold):
        pieces = [*training, *validated, *tested]
        actual = sorted_samples(pieces)
        expected = log.u[:, 0]
        np.testing.assert_array_equal(actual, expected)
        firsts = [piece.first for piece in pieces]
        expected = [piece.u[0, 0] for piece in pieces]
        assert firsts == expected


def first_and_last(pieces: list[Trajectory]) -> list[tuple[int, int]]:
    """The numbers of the first and the last sample of each piece."""
    ends = []
    for piece in pieces:
        numbers = piece.u[:, 0]
        first = int(numbers[0])
        last = int(numbers[-1])
        ends.append((first, last))
    return ends


def test_named_intervals_are_cut_out_and_the_rest_trains():
    validation_s = [[2.0, 3.0]]
    test_s = [[0.0, 1.0], [9.0, 10.0]]
    named = {"validation": validation_s, "test": test_s}
    log = record(100)
    training, validation, test = split_at_intervals(log, named)
    assert first_and_last(training) == [(10, 19), (30, 89)]
    assert first_and_last(validation) == [(20, 29)]
    assert first_and_last(test) == [(0, 9), (90, 99)]


@given(LENGTHS, FOLDS)
def test_every_sample_is_tested_in_exactly_one_fold(samples, folds):
    log_to_cut = record(samples)
    size = samples / folds
    tested_pieces = []
    for fold in range(folds):
        _, validation, test = split_by_fold(log_to_cut, fold, folds)
        assert len(validation) == 1
        (tested_piece,) = test
        assert abs(len(tested_piece) - size) < 1
        tested_pieces.append(tested_piece)
    signals = [piece.u[:, 0] for piece in tested_pieces]
    tested = np.concatenate(signals)
    expected = np.arange(samples)
    np.testing.assert_array_equal(tested, expected)


@given(LENGTHS, FOLDS)
def test_what_a_fold_leaves_and_holds_out_is_the_record(samples, folds):
    log = record(samples)
    for fold in range(folds):
        remaining, held_out = cut_out_fold(log, fold, folds)
        actual = sorted_samples([*remaining, held_out])
        expected = np.arange(samples)
        np.testing.assert_array_equal(actual, expected)
        difference = abs(len(held_out) - samples / folds)
        assert difference <= 1


def join_record(*stretches: np.ndarray) -> Trajectory:
    """A record of these stretches, its output equal to its input."""
    signal = np.concatenate(stretches)[:, None]
    return Trajectory(u=signal, y=signal, step_s=0.1)


def test_stretches_between_rests_count_where_each_repeats_itself():
    rest = np.zeros(40)
    rng = np.random.default_rng(0)
    period = rng.uniform(-1, 1, size=40)
    double = 2 * period
    moved = join_record(rest, period, period, rest, double, double, rest)
    pieces = periodic_segments(moved, 0)
    lengths = [len(piece) for piece in pieces]
    assert lengths == [140, 141]  # half a rest, two periods, a rest
    moved_once = join_record(rest, period, rest, double, double, rest)
    assert not periodic_segments(moved_once, 0)
    in_motion = moved[40:]
    assert not periodic_segments(in_motion, 0)


def test_the_last_of_five_folds_is_the_cut_in_time():
    log = record(100)
    pieces = split_by_fold(log, 4, 5)
    by_time = split_by_time(log, 0.2, 0.2)
    for fold, time in zip(pieces, by_time, strict=True):
        actual = fold[0].u
        expected = time[0].u
        np.testing.assert_array_equal(actual, expected)


IMPOSSIBLE_TIMES = [[[3.0, 2.0]], [[9.0, 10.5]], [[0.0, np.inf]]]
OVERLAPPING = [[0.0, 1.0], [0.5, 2.0]]
WRONG_SHAPES = [[[3.0]], [[0.0, 1.0, 2.0]], [0.0, 1.0], [["a", "b"]]]
WRONG_INTERVALS = [*IMPOSSIBLE_TIMES, OVERLAPPING, *WRONG_SHAPES]


@pytest.mark.parametrize("wrong", WRONG_INTERVALS)
def test_intervals_that_cannot_be_are_refused(wrong):
    validation = [[5.0, 6.0]]
    named = {"validation": validation, "test": wrong}
    log = record(100)
    with pytest.raises(BadRequest, match=r"data\.test"):
        split_at_intervals(log, named)


def log(path, y: np.ndarray) -> RecordedData:
    times = np.arange(len(y))
    sine = np.sin(times)
    columns = np.column_stack([sine, y])
    layout = {"delimiter": ",", "header": "u,y", "comments": ""}
    np.savetxt(path, columns, **layout)
    signals = {"path": str(path), "input": "u", "output": "y"}
    return RecordedData(**signals, step_s=0.1, start_up_samples=10)


def test_the_default_says_which_it_took(tmp_path):
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(1000)
    white_log = log(tmp_path / "alike.csv", white_noise)
    alike = white_log.build(0)
    assert alike.metadata["split"] == "in the order of time"
    assert len(alike.training) == 1
    white_noise = rng.standard_normal(1000)
    is_late = np.arange(1000) > 800
    stepped = white_noise + 4 * is_late
    stepped_log = log(tmp_path / "moved.csv", stepped)
    moved = stepped_log.build(0)
    assert "interleaved blocks, because its end" in moved.metadata["split"]
    assert len(moved.training) == 6
    assert len(moved.validation) == 2
    assert len(moved.test) == 2
    (tmp_path / "folds").mkdir()
    log_path = tmp_path / "folds" / "log.csv"
    white_noise = rng.standard_normal(1000)
    default = log(log_path, white_noise)
    spec = replace(default, fold=2)
    held_out = spec.build(0)
    split = held_out.metadata["split"]
    assert split.startswith("into 5 folds, of which number 2 tests")
    assert len(held_out.training) == 2
    validation = held_out.validation[0]
    test = held_out.test[0]
    assert len(validation) == 200
    assert len(test) == 200


def test_an_end_unlike_the_beginning_is_seen_in_validation_and_test():
    rng = np.random.default_rng(0)
    ramp = record(500)
    parts = split_by_time(ramp, 0.2, 0.2)
    assert is_test_output_different(parts)
    noise = rng.standard_normal((200, 1))
    first = Trajectory(u=noise, y=noise, step_s=0.1)
    constant = np.full((200, 1), 9.0)
    odd = Trajectory(u=constant, y=constant, step_s=0.1)
    validation_differs = ([first], [odd], [first])
    assert not is_test_output_different(validation_differs)
    training_differs = ([odd], [first], [first])
    assert is_test_output_different(training_differs)


def test_a_split_that_leaves_nothing_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(1000)
    path = tmp_path / "alike.csv"
    log(path, white_noise)
    validation = [[0.0, 50.0]]
    test = [[50.0, 100.0]]
    nothing = {"validation": validation, "test": test}
    columns = {"input": "u", "output": "y"}
    recorded_data = RecordedData(path=str(path), step_s=0.1, **columns, **nothing)
    with pytest.raises(BadRequest, match="no record is left to train on"):
        recorded_data.build(0)
    with pytest.raises(BadRequest, match="split"):
        RecordedData(path="a", split="random", **columns)
    test = [[0.0, 1.0]]
    with pytest.raises(BadRequest, match="validation"):
        RecordedData(path="a", test=test, **columns)


def test_the_rest_is_the_mean_of_the_training_records_alone(tmp_path):
    ramp = np.arange(1000.0)
    by_default = log(tmp_path / "log.csv", ramp)
    in_time = replace(by_default, split="time")
    for spec in (by_default, in_time):
        data = spec.build(0)
        outputs = [record.y for record in data.training]
        trained = np.concatenate(outputs)
        actual = data.scale.output_equilibrium
        expected = trained.mean(axis=0)
        np.testing.assert_allclose(actual, expected, rtol=1e-12)


REST_LENGTHS = [11, 12, 21]


def test_a_rest_counts_from_two_samples_beyond_the_start_up_window_on(tmp_path):
    rests = [np.zeros(length - 1) for length in REST_LENGTHS]
    moved = np.sin(np.arange(1, 400))
    u = np.concatenate([moved, rests[0], [1.0], rests[1], [1.0], rests[2]])
    path = tmp_path / "log.csv"
    table = np.column_stack([u, 2 * u])
    np.savetxt(path, table, delimiter=",", header="u,y", comments="")
    recorded = RecordedData(path=str(path), input="u", output="y", step_s=0.1)
    for start_up_samples, expected in ((9, [11, 12, 21]), (10, [12, 21]), (11, [21])):
        data = replace(recorded, start_up_samples=start_up_samples).build(0)
        lengths = [len(rest) for rest in data.mismatch_records]
        assert lengths == expected
