"""Logs as people really write them (`../shared/data/logs_small`): each row of its README, from the
settings that a user types to the right step and columns."""

from pathlib import Path

import numpy as np
import pytest

from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "logs_small"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/data/logs_small")
MINUTE = 60.0


def read(name: str, **settings: object):  # type: ignore[no-untyped-def]
    path = str(FOLDER / name)
    fields: dict[str, object] = {"path": path, "input": "u", "output": "y"}
    recorded_data = RecordedData(**(fields | settings))
    return recorded_data.build(0)  # type: ignore[arg-type]


def whole(data, side: str) -> np.ndarray:  # type: ignore[no-untyped-def]
    """One signal over all parts, in the order of the log."""
    records = [*data.training, *data.validation, *data.test]
    ordered = sorted(records, key=lambda record: record.first)
    signals = [getattr(record, side)[:, 0] for record in ordered]
    return np.concatenate(signals)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Input and output of the log that most files hold."""
    columns = np.loadtxt(FOLDER / "plain.txt", delimiter=",", skiprows=1)
    return columns[:, 1:]


READABLE = [
    ("ms.csv", {}, 0.01),
    ("ms2.csv", {}, 0.01),
    ("us.csv", {}, 0.01),
    ("plain.txt", {}, 0.01),
    ("tab.txt", {"input": 0, "output": 1, "step_s": 0.01}, 0.01),
    ("german.csv", {}, 0.01),
    ("matrix.mat", {"input": "data:2", "output": "data:3", "time": "data:1"}, 0.01),
    ("matrix.mat", {"input": 1, "output": 2, "time": 0}, 0.01),
    ("struct.mat", {"input": "log.u", "output": "log.y", "step_s": 0.01}, 0.01),
    ("names.csv", {"input": "Servo 1 (us)", "output": "Speed (RPM)"}, 0.01),
    ("names.csv", {"input": 1, "output": 2}, 0.01),
    ("names.csv", {"input": "Servo_1", "output": "speed"}, 0.01),
    ("trail.csv", {}, 0.01),
    ("units_row.csv", {}, 0.01),
    ("comment.csv", {}, 0.01),
    ("unnamed.csv", {"step_s": 0.01}, 0.01),
    ("dates_eu.csv", {}, MINUTE),
    ("dates_nosec.csv", {}, MINUTE),
    ("latin.csv", {"input": "Drehzahl in 1/min", "output": "Öltemp °C"}, 0.01),
    ("three_digits.csv", {"step_s": 0.135}, 0.135),
    ("three_digits.csv", {}, 0.135),
    ("dup.csv", {"step_s": 0.01}, 0.01),
]


@pytest.mark.parametrize(("name", "settings", "step_s"), READABLE)
def test_the_right_step_and_columns(
    name: str, settings: dict[str, object], step_s: float, truth: np.ndarray
) -> None:
    data = read(name, **settings)
    assert data.step_s == pytest.approx(step_s, rel=1e-9)
    actual = whole(data, "u")
    expected = truth[:, 0]
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    actual = whole(data, "y")
    expected = truth[:, 1]
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    assert "step" in data.metadata["reading"]


@pytest.mark.parametrize(("name", "rows"), [("nan.csv", 1), ("na.csv", 1)])
def test_missing_values_cut_the_record(name: str, rows: int, truth: np.ndarray) -> None:
    data = read(name)
    assert data.step_s == pytest.approx(0.01)
    missing = len(truth) - len(whole(data, "y"))
    assert missing >= rows
    said = data.metadata["reading"]
    rows = "row" if missing == 1 else "rows"
    assert f"cut at {missing} {rows} with missing values" in said
    for record in (*data.training, *data.validation, *data.test):
        rows_there = slice(record.first, record.first + len(record))
        actual = record.y[:, 0]
        expected = truth[rows_there, 1]
        np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_holes_of_the_clock_cut_the_record(truth: np.ndarray) -> None:
    """The step is that between the holes; every recorded row is there and none is invented."""
    data = read("gap.csv")
    assert data.step_s == pytest.approx(0.01, rel=1e-9)
    actual = whole(data, "y")
    expected = truth[:, 1]
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    assert "cut at 2 holes of 2 s in all" in data.metadata["reading"]
    firsts = {record.first for record in data.training}
    assert len(firsts) > 1


def test_a_rest_within_the_start_up_window_is_no_record_of_the_mismatch() -> None:
    """The log ends with a hold of eleven samples, of which a window of twenty leaves none."""
    assert read("plain.txt").mismatch_records != ()
    windowed = read("plain.txt", start_up_samples=20).mismatch_records
    assert all(len(record) > 21 for record in windowed)


def test_rounded_times_are_called_so() -> None:
    """Times of three digits fit one even clock; a time that stands twice fits several."""
    reading = read("three_digits.csv").metadata["reading"]
    assert "times rounded to 1 s at their coarsest; an even clock of 0.135 s" in reading
    with pytest.raises(BadRequest, match=r"times were rounded; use data.step_s .*ssm-study look"):
        read("dup.csv")


def test_a_counter_of_rows_is_no_clock() -> None:
    with pytest.raises(BadRequest, match="the first column counts the rows"):
        read("unnamed.csv")


def test_a_file_whose_first_row_is_numbers_has_no_names(truth: np.ndarray) -> None:
    both = {"step_s": 0.01, "input": 0, "output": 1}
    one = read("zero_one.csv", **both)
    assert whole(one, "y")[0] == 1.0
    actual = whole(one, "y")[1:]
    expected = truth[:, 1]
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    output_path = str(FOLDER / "zero_out.csv")
    apart = {"output_path": output_path, "input": 0, "output": 0}
    two = read("zero_in.csv", step_s=0.01, **apart)
    assert whole(two, "u")[0] == 0.0
    assert whole(two, "y")[0] == -1.5
    assert len(whole(two, "u")) == 1501


REFUSED_COLUMNS = [
    ({"input": "data"}, "is a matrix of 3 columns; name one as data:1 or data:3"),
    ({"input": "data:4"}, "the file has data:1, data:2, data:3"),
]


@pytest.mark.parametrize(("settings", "says"), REFUSED_COLUMNS)
def test_a_matrix_is_named_by_its_columns(settings: dict[str, object], says: str) -> None:
    settings_of_data = {"output": "data:3", "step_s": 0.01}
    with pytest.raises(BadRequest, match=says):
        read("matrix.mat", **(settings_of_data | settings))


def test_the_clock_is_no_signal_and_a_column_no_two() -> None:
    with pytest.raises(BadRequest, match="is the clock"):
        read("names.csv", input="Time (s)", output="Speed (RPM)")
    with pytest.raises(BadRequest, match="is the clock"):
        read("names.csv", input=0, output=2, step_s=0.01)
    with pytest.raises(BadRequest, match="holds the numbers of column"):
        read("names.csv", input="Speed (RPM)", output=2)
    with pytest.raises(BadRequest, match="the same column twice"):
        read("names.csv", input=[1, 1], output=2)


@pytest.mark.parametrize("step_s", [10.0, 0.0101])
def test_a_sampling_time_that_the_clock_contradicts(step_s: float) -> None:
    with pytest.raises(BadRequest, match=r"the times of ms.csv show 0.01 s"):
        read("ms.csv", step_s=step_s)
