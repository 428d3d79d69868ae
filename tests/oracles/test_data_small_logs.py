"""Logs as people really write them (`../shared/data/logs_small`): each row of its README, from the
settings that a user types to the right step and columns."""

from pathlib import Path

import numpy as np
import pytest

from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

SHARED = Path(__file__).parents[3] / "shared"
FOLDER = SHARED / "data" / "logs_small"
IS_MISSING = not FOLDER.is_dir()
pytestmark = pytest.mark.skipif(IS_MISSING, reason="needs ../shared/data/logs_small")
MINUTE = 60.0


def read(name: str, **settings: object):  # type: ignore[no-untyped-def]
    path = str(FOLDER / name)
    fields: dict[str, object] = {"path": path}
    fields |= {"input": "u", "output": "y"}
    fields |= settings
    recorded_data = RecordedData(**fields)  # type: ignore[arg-type]
    return recorded_data.build(0)


def whole(data, side: str) -> np.ndarray:  # type: ignore[no-untyped-def]
    """One signal over all parts, in the order of the log."""
    records = [*data.training, *data.validation, *data.test]
    records.sort(key=lambda record: record.first)
    signals = [getattr(record, side)[:, 0] for record in records]
    return np.concatenate(signals)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Input and output of the log that most files hold."""
    path = FOLDER / "plain.txt"
    columns = np.loadtxt(path, delimiter=",", skiprows=1)
    return columns[:, 1:]


def assert_signal(data, side: str, expected: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    """The signal of the whole log, but for the digits that a file leaves out."""
    actual = whole(data, side)
    np.testing.assert_allclose(actual, expected, atol=1e-4)


STEP_S = {"step_s": 0.01}
PLAIN_FILES = ["ms.csv", "ms2.csv", "us.csv", "plain.txt"]
UNUSUAL_HEADERS = ["german.csv", "trail.csv", "units_row.csv", "comment.csv"]
DATED_FILES = ["dates_eu.csv", "dates_nosec.csv"]
AS_THEY_ARE = [(name, {}, 0.01) for name in (*PLAIN_FILES, *UNUSUAL_HEADERS)]
AT_EVERY_MINUTE = [(name, {}, MINUTE) for name in DATED_FILES]
NUMBERED = {"input": 0, "output": 1}
FILES_WITHOUT_A_CLOCK = [
    ("tab.txt", NUMBERED | STEP_S, 0.01),
    ("unnamed.csv", STEP_S, 0.01),
    ("dup.csv", STEP_S, 0.01),
]
MATRIX_COLUMNS = {"input": "data:2", "output": "data:3", "time": "data:1"}
MATRIX_NUMBERS = {"input": 1, "output": 2, "time": 0}
FIELDS_OF_LOG = {"input": "log.u", "output": "log.y"}
MAT_FILES = [
    ("matrix.mat", MATRIX_COLUMNS, 0.01),
    ("matrix.mat", MATRIX_NUMBERS, 0.01),
    ("struct.mat", FIELDS_OF_LOG | STEP_S, 0.01),
]
FULL_NAMES = {"input": "Servo 1 (us)", "output": "Speed (RPM)"}
PLAIN_NAMES = {"input": "Servo_1", "output": "speed"}
OF_LATIN_TEXT = {"input": "Drehzahl in 1/min", "output": "Öltemp °C"}
CHOSEN_COLUMNS = [
    ("names.csv", FULL_NAMES, 0.01),
    ("names.csv", {"input": 1, "output": 2}, 0.01),
    ("names.csv", PLAIN_NAMES, 0.01),
    ("latin.csv", OF_LATIN_TEXT, 0.01),
]
ROUNDED_STEP_S = {"step_s": 0.135}
ROUNDED_CLOCKS = [("three_digits.csv", ROUNDED_STEP_S, 0.135), ("three_digits.csv", {}, 0.135)]
TEXT_FILES = [*AS_THEY_ARE, *AT_EVERY_MINUTE, *FILES_WITHOUT_A_CLOCK]
CHOSEN = [*MAT_FILES, *CHOSEN_COLUMNS]
READABLE = [*TEXT_FILES, *CHOSEN, *ROUNDED_CLOCKS]


@pytest.mark.parametrize(("name", "settings", "step_s"), READABLE)
def test_the_right_step_and_columns(
    name: str, settings: dict[str, object], step_s: float, truth: np.ndarray
) -> None:
    data = read(name, **settings)
    assert data.step_s == pytest.approx(step_s, rel=1e-9)
    assert_signal(data, "u", truth[:, 0])
    assert_signal(data, "y", truth[:, 1])
    assert "step" in data.metadata["reading"]


MISSING_VALUES = [("nan.csv", 1), ("na.csv", 1)]


@pytest.mark.parametrize(("name", "rows"), MISSING_VALUES)
def test_missing_values_cut_the_record(name: str, rows: int, truth: np.ndarray) -> None:
    data = read(name)
    assert data.step_s == pytest.approx(0.01)
    recorded = whole(data, "y")
    missing = len(truth) - len(recorded)
    assert missing >= rows
    reading = data.metadata["reading"]
    rows = "row" if missing == 1 else "rows"
    assert f"cut at {missing} {rows} with missing values" in reading
    records = (*data.training, *data.validation, *data.test)
    for record in records:
        end = record.first + len(record)
        actual = record.y[:, 0]
        expected = truth[record.first : end, 1]
        np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_holes_of_the_clock_cut_the_record(truth: np.ndarray) -> None:
    """The step is that between the holes; every recorded row is there and none is invented."""
    data = read("gap.csv")
    assert data.step_s == pytest.approx(0.01, rel=1e-9)
    assert_signal(data, "y", truth[:, 1])
    assert "cut at 2 holes of 2 s in all" in data.metadata["reading"]
    firsts = {record.first for record in data.training}
    assert len(firsts) > 1


def test_a_rest_within_the_start_up_window_is_no_record_of_the_mismatch() -> None:
    """The log ends with a hold of eleven samples, of which a window of twenty leaves none."""
    assert read("plain.txt").mismatch_records != ()
    windowed = read("plain.txt", start_up_samples=20)
    lengths = [len(record) for record in windowed.mismatch_records]
    assert all(length > 21 for length in lengths)


def test_rounded_times_are_called_so() -> None:
    """Times of three digits fit one even clock; a time that stands twice fits several."""
    reading = read("three_digits.csv").metadata["reading"]
    assert "times rounded to 1 s at their coarsest; an even clock of 0.135 s" in reading
    words = r"times were rounded; use data.step_s .*ssm-study look"
    with pytest.raises(BadRequest, match=words):
        read("dup.csv")


def test_a_counter_of_rows_is_no_clock() -> None:
    with pytest.raises(BadRequest, match="the first column counts the rows"):
        read("unnamed.csv")


def test_a_file_whose_first_row_is_numbers_has_no_names(truth: np.ndarray) -> None:
    both = read("zero_one.csv", input=0, output=1, **STEP_S)
    output = whole(both, "y")
    assert output[0] == 1.0
    expected = truth[:, 1]
    np.testing.assert_allclose(output[1:], expected, atol=1e-4)
    output_path = str(FOLDER / "zero_out.csv")
    columns = {"input": 0, "output": 0}
    apart = read("zero_in.csv", output_path=output_path, **columns, **STEP_S)
    input_apart = whole(apart, "u")
    output_apart = whole(apart, "y")
    assert input_apart[0] == 0.0
    assert output_apart[0] == -1.5
    assert len(input_apart) == 1501


REFUSED_COLUMNS = [
    ({"input": "data"}, "is a matrix of 3 columns; name one as data:1 or data:3"),
    ({"input": "data:4"}, "the file has data:1, data:2, data:3"),
]


@pytest.mark.parametrize(("settings", "says"), REFUSED_COLUMNS)
def test_a_matrix_is_named_by_its_columns(settings: dict[str, object], says: str) -> None:
    settings = {"output": "data:3", **STEP_S, **settings}
    with pytest.raises(BadRequest, match=says):
        read("matrix.mat", **settings)


CLOCK = "is the clock"
REFUSED_PAIRS = [
    ({"input": "Time (s)", "output": "Speed (RPM)"}, CLOCK),
    ({"input": 0, "output": 2, **STEP_S}, CLOCK),
    ({"input": "Speed (RPM)", "output": 2}, "holds the numbers of column"),
    ({"input": [1, 1], "output": 2}, "the same column twice"),
]


@pytest.mark.parametrize(("settings", "words"), REFUSED_PAIRS)
def test_the_clock_is_no_signal_and_a_column_no_two(
    settings: dict[str, object], words: str
) -> None:
    with pytest.raises(BadRequest, match=words):
        read("names.csv", **settings)


@pytest.mark.parametrize("step_s", [10.0, 0.0101])
def test_a_sampling_time_that_the_clock_contradicts(step_s: float) -> None:
    words = r"the times of ms.csv show 0.01 s"
    with pytest.raises(BadRequest, match=words):
        read("ms.csv", step_s=step_s)
