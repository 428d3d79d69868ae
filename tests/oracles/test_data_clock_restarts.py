"""A clock that starts again, runs backwards, or counts whole numbers without a unit."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.metrics import judge_reading
from ssm_study.refusal import BadRequest

ROWS = 200
U = np.repeat([0.0, 1.0, -1.0, 0.5], 50)
IMPULSE_RESPONSE = 0.2 * 0.8 ** np.arange(40)
Y = np.convolve(U, IMPULSE_RESPONSE)[:ROWS]


def log(folder: Path, times: np.ndarray, name: str = "time", repeats: int = 1) -> Path:
    """A log with this clock."""
    path = folder / "log.csv"
    u = np.tile(U, repeats)
    y = np.tile(Y, repeats)
    columns = {name: times, "u": u, "y": y}
    table = pd.DataFrame(columns)
    table.to_csv(path, index=False)
    return path


def source(path: Path, **settings: object) -> RecordedData:
    fields: dict[str, object] = {"path": str(path), "input": "u", "output": "y"}
    return RecordedData(**(fields | settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("step_s", [None, 0.01])
def test_a_clock_that_starts_again_makes_two_experiments(
    tmp_path: Path, step_s: float | None
) -> None:
    times = np.tile(0.01 * np.arange(ROWS), 2)
    path = log(tmp_path, times, repeats=2)
    recorded_data = source(path, step_s=step_s)
    pieces, remark = recorded_data.read_pieces(path)
    expected = [ROWS, ROWS]
    assert [len(piece) for piece in pieces] == expected
    assert pieces[0].step_s == pytest.approx(0.01)
    assert "the clock starts again: 2 experiments" in remark
    pieces_y = pieces[1].y
    actual = pieces_y[:, 0]
    np.testing.assert_array_equal(actual, Y)
    first = pieces[1].first
    assert first > len(pieces[0])  # no simulation runs on across the cut


def test_experiments_of_different_sampling_times_are_refused(tmp_path: Path) -> None:
    slower = 0.011 * np.arange(ROWS)
    times = np.concatenate([0.01 * np.arange(ROWS), slower])
    path = log(tmp_path, times, repeats=2)
    with pytest.raises(BadRequest, match="different sampling times"):
        source(path).read_pieces(path)


@pytest.mark.parametrize("step_s", [None, 0.01])
def test_a_log_in_reverse_is_refused(tmp_path: Path, step_s: float | None) -> None:
    """With the step stated it would be fitted backwards in time, and nobody would know."""
    backwards = 0.01 * np.arange(ROWS)[::-1]
    path = log(tmp_path, backwards)
    recorded_data = source(path, step_s=step_s)
    with pytest.raises(BadRequest, match="runs backwards at row 1, counted from 0; sort the rows"):
        recorded_data.read_pieces(path)


def test_a_clock_with_rows_out_of_order_is_refused(tmp_path: Path) -> None:
    times = 0.01 * np.arange(ROWS)
    times[[100, 101]] = times[[101, 100]]
    path = log(tmp_path, times)
    with pytest.raises(BadRequest, match="runs backwards at row 101"):
        source(path).read_pieces(path)


def test_a_temperature_named_t_is_no_clock(tmp_path: Path) -> None:
    """It cools, and the sampling time is stated."""
    temperature = 90.0 * np.exp(-0.01 * np.arange(ROWS))
    path = log(tmp_path, temperature, name="T")
    recorded_data = source(path, step_s=0.01)
    pieces, _ = recorded_data.read_pieces(path)
    assert len(pieces) == 1


WHOLE_NUMBERS = [
    ("time", 10, {}, True),
    ("time", 10, {"step_s": 10.0}, False),
    ("time_ms", 10, {}, False),
    ("time", 1, {}, False),
    ("time", 60, {}, False),
    ("time", 0.5, {}, False),
]


@pytest.mark.parametrize(("name", "factor", "settings", "doubted"), WHOLE_NUMBERS)
def test_whole_numbers_without_a_unit_leave_a_doubt(
    tmp_path: Path, name: str, factor: float, settings: dict[str, object], doubted: bool
) -> None:
    times = factor * np.arange(ROWS)
    path = log(tmp_path, times, name=name)
    recorded_data = source(path, **settings)
    _, remark = recorded_data.read_pieces(path)
    assert ("may count milliseconds" in remark) is doubted
    assert bool(judge_reading(remark)) is doubted
