"""A clock that starts again, runs backwards, or counts whole numbers without a unit."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from good_log import source

from ssm_study.evidence.metrics import judge_log_reading
from ssm_study.refusal import BadRequest

ROWS = 200
U = np.repeat([0.0, 1.0, -1.0, 0.5], 50)
IMPULSE_RESPONSE = 0.2 * 0.8 ** np.arange(40)
RESPONSE = np.convolve(U, IMPULSE_RESPONSE)
Y = RESPONSE[:ROWS]
TIMES = 0.01 * np.arange(ROWS)


def log(folder: Path, times: np.ndarray, name: str = "time", repeats: int = 1) -> Path:
    """A log with this clock."""
    path = folder / "log.csv"
    u = np.tile(U, repeats)
    y = np.tile(Y, repeats)
    columns = {name: times, "u": u, "y": y}
    table = pd.DataFrame(columns)
    table.to_csv(path, index=False)
    return path


@pytest.mark.parametrize("step_s", [None, 0.01])
def test_a_clock_that_starts_again_makes_two_experiments(
    tmp_path: Path, step_s: float | None
) -> None:
    times = np.tile(TIMES, 2)
    path = log(tmp_path, times, repeats=2)
    recorded_data = source(path, step_s=step_s)
    pieces, remark = recorded_data.read_pieces(path)
    first, second = pieces
    assert len(first) == ROWS
    assert len(second) == ROWS
    assert first.step_s == pytest.approx(0.01)
    assert "the clock starts again: 2 experiments" in remark
    actual = second.y[:, 0]
    np.testing.assert_array_equal(actual, Y)
    assert second.first > len(first)  # no simulation runs on across the cut


def test_experiments_of_different_sampling_times_are_refused(tmp_path: Path) -> None:
    slower = 0.011 * np.arange(ROWS)
    times = np.concatenate([TIMES, slower])
    path = log(tmp_path, times, repeats=2)
    recorded_data = source(path)
    with pytest.raises(BadRequest, match="different sampling times"):
        recorded_data.read_pieces(path)


@pytest.mark.parametrize("step_s", [None, 0.01])
def test_a_log_in_reverse_is_refused(tmp_path: Path, step_s: float | None) -> None:
    """With the step stated it would be fitted backwards in time, and nobody would know."""
    backwards = TIMES[::-1]
    path = log(tmp_path, backwards)
    recorded_data = source(path, step_s=step_s)
    words = "runs backwards at row 1, counted from 0; sort the rows"
    with pytest.raises(BadRequest, match=words):
        recorded_data.read_pieces(path)


def test_a_clock_with_rows_out_of_order_is_refused(tmp_path: Path) -> None:
    times = TIMES.copy()
    later = times[101]
    times[101] = times[100]
    times[100] = later
    path = log(tmp_path, times)
    recorded_data = source(path)
    with pytest.raises(BadRequest, match="runs backwards at row 101"):
        recorded_data.read_pieces(path)


def test_a_temperature_named_t_is_no_clock(tmp_path: Path) -> None:
    """It cools, and the sampling time is stated."""
    temperature = 90.0 * np.exp(-TIMES)
    path = log(tmp_path, temperature, name="T")
    recorded_data = source(path, step_s=0.01)
    pieces, _ = recorded_data.read_pieces(path)
    assert len(pieces) == 1


DOUBTED = ("time", 10, {}, True)
STATED = ("time", 10, {"step_s": 10.0}, False)
OF_KNOWN_UNIT = [
    ("time_ms", 10, {}, False),
    ("time", 1, {}, False),
    ("time", 60, {}, False),
    ("time", 0.5, {}, False),
]
WHOLE_NUMBERS = pytest.mark.parametrize(
    ("name", "factor", "settings", "doubted"), [DOUBTED, STATED, *OF_KNOWN_UNIT]
)


@WHOLE_NUMBERS
def test_whole_numbers_without_a_unit_leave_a_doubt(
    tmp_path: Path, name: str, factor: float, settings: dict[str, object], doubted: bool
) -> None:
    times = factor * np.arange(ROWS)
    path = log(tmp_path, times, name=name)
    recorded_data = source(path, **settings)
    _, remark = recorded_data.read_pieces(path)
    assert ("may count milliseconds" in remark) is doubted
    assert bool(judge_log_reading(remark)) is doubted
