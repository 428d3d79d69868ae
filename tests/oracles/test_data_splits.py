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
    for parts in (
        split_by_time(log, validation, test),
        split_into_blocks(log),
        *(split_by_fold(log, fold, 5) for fold in range(5)),
    ):
        pieces = [piece for part in parts for piece in part]
        np.testing.assert_array_equal(
            np.sort(np.concatenate([piece.u[:, 0] for piece in pieces])), log.u[:, 0]
        )
        assert [piece.first for piece in pieces] == [piece.u[0, 0] for piece in pieces]


def test_named_intervals_are_cut_out_and_the_rest_trains():
    training, validation, test = split_at_intervals(
        record(100), {"validation": [[2.0, 3.0]], "test": [[0.0, 1.0], [9.0, 10.0]]}
    )
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in training] == [(10, 19), (30, 89)]
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in validation] == [(20, 29)]
    assert [(int(p.u[0, 0]), int(p.u[-1, 0])) for p in test] == [(0, 9), (90, 99)]


@given(st.integers(40, 400), st.integers(2, 8))
def test_every_sample_is_tested_in_exactly_one_fold(samples, folds):
    cuts = [split_by_fold(record(samples), fold, folds) for fold in range(folds)]
    tested = np.concatenate([piece.u[:, 0] for _, _, test in cuts for piece in test])
    np.testing.assert_array_equal(tested, np.arange(samples))
    assert all(len(test) == len(validation) == 1 for _, validation, test in cuts)
    assert all(abs(len(test[0]) - samples / folds) < 1 for _, _, test in cuts)


@given(st.integers(40, 400), st.integers(2, 8))
def test_what_a_fold_leaves_and_holds_out_is_the_record(samples, folds):
    for fold in range(folds):
        kept, out = cut_out_fold(record(samples), fold, folds)
        pieces = np.sort(np.concatenate([piece.u[:, 0] for piece in (*kept, out)]))
        np.testing.assert_array_equal(pieces, np.arange(samples))
        assert abs(len(out) - samples / folds) <= 1


def test_stretches_between_rests_count_where_each_repeats_itself():
    rest = np.zeros(40)
    period = np.random.default_rng(0).uniform(-1, 1, size=40)
    twice = np.concatenate([rest, period, period, rest, 2 * period, 2 * period, rest])
    moved = Trajectory(u=twice[:, None], y=twice[:, None], step_s=0.1)
    assert [len(piece) for piece in periodic_segments(moved, 0)] == [
        140,
        141,
    ]  # half a rest, two periods, a rest
    once = np.concatenate([rest, period, rest, 2 * period, 2 * period, rest])
    assert not periodic_segments(Trajectory(u=once[:, None], y=once[:, None], step_s=0.1), 0)
    assert not periodic_segments(moved[40:], 0)  # begins in motion


def test_the_last_of_five_folds_is_the_cut_in_time():
    for fold, time in zip(
        split_by_fold(record(100), 4, 5), split_by_time(record(100), 0.2, 0.2), strict=True
    ):
        np.testing.assert_array_equal(fold[0].u, time[0].u)


@pytest.mark.parametrize(
    "wrong",
    [
        [[3.0, 2.0]],
        [[9.0, 10.5]],
        [[0.0, 1.0], [0.5, 2.0]],
        [[3.0]],
        [[0.0, 1.0, 2.0]],
        [[0.0, np.inf]],
        [0.0, 1.0],
        [["a", "b"]],
    ],
)
def test_intervals_that_cannot_be_are_refused(wrong):
    with pytest.raises(BadRequest, match=r"data\.test"):
        split_at_intervals(record(100), {"validation": [[5.0, 6.0]], "test": wrong})


def log(path, y: np.ndarray) -> RecordedData:
    np.savetxt(
        path,
        np.column_stack([np.sin(np.arange(len(y))), y]),
        delimiter=",",
        header="u,y",
        comments="",
    )
    return RecordedData(path=str(path), input="u", output="y", step_s=0.1, start_up_samples=10)


def test_the_default_says_which_it_took(tmp_path):
    rng = np.random.default_rng(0)
    alike = log(tmp_path / "alike.csv", rng.standard_normal(1000)).build(0)
    assert alike.metadata["split"] == "in the order of time"
    assert len(alike.training) == 1
    moved = log(
        tmp_path / "moved.csv", rng.standard_normal(1000) + 4 * (np.arange(1000) > 800)
    ).build(0)
    assert "interleaved blocks, because its end" in moved.metadata["split"]
    assert (len(moved.training), len(moved.validation), len(moved.test)) == (6, 2, 2)
    (tmp_path / "folds").mkdir()
    held_out = replace(
        log(tmp_path / "folds" / "log.csv", rng.standard_normal(1000)), fold=2
    ).build(0)
    assert held_out.metadata["split"].startswith("into 5 folds, of which number 2 tests")
    assert (len(held_out.training), len(held_out.validation[0]), len(held_out.test[0])) == (
        2,
        200,
        200,
    )
    assert is_test_output_different(split_by_time(record(500), 0.2, 0.2))
    first, odd = (
        Trajectory(u=y, y=y, step_s=0.1)
        for y in (rng.standard_normal((200, 1)), 9 + np.zeros((200, 1)))
    )
    assert not is_test_output_different(([first], [odd], [first]))
    assert is_test_output_different(([odd], [first], [first]))
    nothing = {"validation": [[0.0, 50.0]], "test": [[50.0, 100.0]]}
    with pytest.raises(BadRequest, match="no record is left to train on"):
        RecordedData(
            path=str(tmp_path / "alike.csv"), input="u", output="y", step_s=0.1, **nothing
        ).build(0)
    with pytest.raises(BadRequest, match="split"):
        RecordedData(path="a", input="u", output="y", split="random")
    with pytest.raises(BadRequest, match="validation"):
        RecordedData(path="a", input="u", output="y", test=[[0.0, 1.0]])


def test_the_rest_is_the_mean_of_the_training_records_alone(tmp_path):
    made = log(tmp_path / "log.csv", np.arange(1000.0)).build(0)
    trained = replace(log(tmp_path / "log.csv", np.arange(1000.0)), split="time").build(0)
    for data in (made, trained):
        shown = np.concatenate([one.y for one in data.training])
        np.testing.assert_allclose(data.scale.output_equilibrium, shown.mean(axis=0), rtol=1e-12)
