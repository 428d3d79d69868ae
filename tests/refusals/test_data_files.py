"""Files the readers must refuse, each in one sentence that names file, line or field; and their
good twins."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from good_log import GOOD, SAMPLES, assert_equal_signals, csv, data, lines, write_good_log
from scipy.io import savemat

from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet


def join_outputs(built: DataSet) -> np.ndarray:
    """The outputs of training, validation and test, end to end."""
    records = (*built.training, *built.validation, *built.test)
    outputs = [record.y[:, 0] for record in records]
    return np.concatenate(outputs)


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".parquet", ".mcap"])
def test_all_formats_give_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    write_good_log(path)

    built = data(path).build(0)
    outputs = join_outputs(built)

    np.testing.assert_array_equal(outputs, GOOD["y"])
    records = (*built.training, *built.validation, *built.test)
    lengths = [len(record) for record in records]
    assert lengths == [120, 40, 40]
    assert built.step_s == 0.01


GOOD_LINE = lines()[50]
LAST_COMMA = GOOD_LINE.rindex(",")
MALFORMED_LINES = {
    "text": (GOOD_LINE.replace(",", ",x", 1), r"column u, line 51 = x.*: no number"),
    "long row": (GOOD_LINE + ",1.0", r"Row #51: Expected 3 columns, got 4"),
    "short row": (GOOD_LINE[:LAST_COMMA], r"Row #51: Expected 3 columns, got 2"),
    "inf": ("0.49,1.0,inf", r"column y, line 51 = inf"),
}
MALFORMED_HEADERS = {
    "missing column": ("t,u,speed", r"log.csv \(column\) = y: the header has t, u, speed"),
    "duplicate": ("y,u,y", r"2 times"),
}


def replace_line_51(rows: list[str], line: str) -> list[str]:
    """The log with another line in the place of its 51st."""
    before = rows[:50]
    after = rows[51:]
    return [*before, line, *after]


def assert_rows_are_refused(path: Path, rows: list[str], words: str) -> None:
    """Reading a log of these rows is refused in one line."""
    text = "\n".join(rows)
    path.write_text(text)

    with pytest.raises(BadRequest, match=words) as refusal:
        data(path).build(0)

    message = str(refusal.value)
    assert "\n" not in message


MALFORMED_LINE_CASES = pytest.mark.parametrize(
    ("line", "words"), MALFORMED_LINES.values(), ids=MALFORMED_LINES
)


@MALFORMED_LINE_CASES
def test_csv_with_a_malformed_line(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "log.csv"
    rows = replace_line_51(lines(), line)
    assert_rows_are_refused(path, rows, words)


MALFORMED_HEADER_CASES = pytest.mark.parametrize(
    ("header", "words"), MALFORMED_HEADERS.values(), ids=MALFORMED_HEADERS
)


@MALFORMED_HEADER_CASES
def test_csv_with_a_malformed_header(tmp_path: Path, header: str, words: str) -> None:
    path = tmp_path / "log.csv"
    rows = lines()
    rows[0] = header
    assert_rows_are_refused(path, rows, words)


def test_csv_without_names(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = lines()[1:]
    words = r"log.csv \(column\) = u: the file without names has 0, 1, 2; count the col"
    assert_rows_are_refused(path, rows, words)


def test_csv_with_longer_rows_than_its_header(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    header, *rows = lines()
    longer = [row + ",7" for row in rows]
    words = r"log.csv = 3 names: the rows have 4 cells"
    assert_rows_are_refused(path, [header, *longer], words)


def test_csv_without_rows(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    header = lines()[0]
    words = r"data.path = .*log.csv: has no rows of numbers"
    assert_rows_are_refused(path, [header], words)


def test_csv_that_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    assert_rows_are_refused(path, [], r"no header")


def test_csv_with_nul_bytes(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    header, *rows = lines()
    assert_rows_are_refused(path, [header, "\0\0", *rows], r"NUL")


def assert_clock_is_refused(path: Path, rows: list[str], words: str) -> None:
    """A log with these rows, its column of times named."""
    text = "\n".join(rows)
    path.write_text(text)
    with pytest.raises(BadRequest, match=words):
        data(path, time="t", step_s=None).build(0)


def make_dated_log(first: str) -> pd.DataFrame:
    """The good log with dates and times that begin at this one."""
    milliseconds = np.round(GOOD["t"] * 1000)
    elapsed = pd.to_timedelta(milliseconds, unit="ms")
    times = pd.Timestamp(first) + elapsed
    return pd.DataFrame(GOOD | {"t": times})


def write_dated_text(dated: pd.DataFrame, path: Path) -> None:
    """Write a dated log as CSV, its times in ISO form."""
    dates = [time.isoformat() for time in dated["t"]]
    table = dated.assign(t=dates)
    table.to_csv(path, index=False)


DATE_FORMS = ["2026-03-29 01:59:59.5", "2026-03-29T01:59:59.5Z", "2026-03-29T01:59:59+02:00"]


@pytest.mark.parametrize("form", DATE_FORMS)
def test_dates_and_times_are_seconds_since_the_first(tmp_path: Path, form: str) -> None:
    """In text and in Parquet; a date among numbers, or a number among dates, is refused where it
    stands."""
    dated = make_dated_log(form)
    parquet = tmp_path / "log.parquet"
    dated.to_parquet(parquet)
    text = tmp_path / "log.csv"
    write_dated_text(dated, text)

    for path in (text, parquet):
        built = data(path, time="t", step_s=None).build(0)
        assert built.step_s == pytest.approx(0.01, rel=1e-6)
        training_input = built.training[0].u[:, 0]
        expected = GOOD["u"][:120]
        np.testing.assert_array_equal(training_input, expected)

    rows = text.read_text().splitlines()
    number_in_line_51 = replace_line_51(rows, "0.5,1.0,1.0")
    assert_clock_is_refused(text, number_in_line_51, "line 51 = 0.5: no date and time as")
    word_in_line_2 = [rows[0], "soon,1.0,1.0", *rows[2:]]
    assert_clock_is_refused(text, word_in_line_2, "line 2 = soon: no number")
    date_in_line_51 = replace_line_51(lines(), f"{form},1.0,1.0")
    assert_clock_is_refused(text, date_in_line_51, r"line 51 = 2026.*: no number")


def test_columns_of_a_file_without_names_go_by_their_numbers(tmp_path: Path) -> None:
    """Columns are numbered by integers, as Hydra gives them. The first line is a row; a bad cell is
    found in the line where it stands."""
    path = csv(tmp_path)
    bare = tmp_path / "bare.csv"
    rows = lines()[1:]
    text = "\n".join(rows)
    bare.write_text(text)

    named = data(path, time="t", step_s=None).build(0)
    numbers = {"input": 1, "output": 2}
    numbered = data(bare, time=0, step_s=None, **numbers).build(0)
    counted = data(path, **numbers).build(0)

    assert_equal_signals(numbered.training[0], named.training[0])
    assert_equal_signals(numbered.test[0], named.test[0])
    assert_equal_signals(counted.test[0], named.test[0])
    assert numbered.inputs[0].name == "input_1"
    assert numbered.outputs[0].name == "output_2"
    words = r"bare.csv \(column\) = 3: the file without names has 0, 1, 2"
    with pytest.raises(BadRequest, match=words):
        data(bare, input=1, output=3).build(0)


BAD_CELLS = [
    ("0.49,slow,1.0", r"column 1, line 50 = slow: no number"),
    ("0.49,1.0,inf", r"column 2, line 50 = inf"),
]


@pytest.mark.parametrize(("cells", "words"), BAD_CELLS)
def test_a_bad_cell_of_a_file_without_names_is_found_in_its_line(
    tmp_path: Path, cells: str, words: str
) -> None:
    bare = tmp_path / "bare.csv"
    rows = lines()[1:]
    rows[49] = cells
    text = "\n".join(rows)
    bare.write_text(text)

    with pytest.raises(BadRequest, match=words):
        data(bare, input=1, output=2).build(0)


def test_names_that_count_are_names(tmp_path: Path) -> None:
    """Column names may be numbers, as pandas writes an array."""
    path = tmp_path / "log.csv"
    signals = [GOOD["u"], GOOD["y"]]
    values = np.stack(signals, axis=1)
    table = pd.DataFrame(values)
    table.to_csv(path, index=False)

    built = data(path, input=0, output=1).build(0)

    assert len(built.training[0]) == 120


NO_FILE = [
    ({"path": "nowhere.csv"}, r"data.path = nowhere.csv: no such file"),
    ({"path": []}, r"data.path = \[\]: names no file"),
]
WRONG_STEP = [
    ({"step_s": 0.0}, r"data.step_s = 0.0: must be positive"),
    ({"step_s": 10.0, "time": "t"}, r"data.step_s = 10.0: the times of log.csv show 0.01 s"),
    ({"decimate": 0}, r"at least 1"),
]
WRONG_PARTS = [
    ({"validation_fraction": 0.6, "test_fraction": 0.6}, r"nothing is left"),
    ({"test_fraction": 0.0}, r"not inside"),
]
WRONG_CHOICE = [
    ({"output": "u"}, r"is an input too"),
    ({"equilibrium": "median"}, r"use zero or mean"),
    ({"controller": [np.nan, 1.0]}, r"data.controller = \[nan, 1.0\]: is no PI"),
]
WRONG_FOLD = [
    ({"fold": 5}, r"data.fold = 5: there are 5 folds; count them from 0"),
    ({"folds": 1}, r"data.folds = 1: must be at least 2"),
]
NAMED_PARTS = r"data.fold = 0: validation and test are stated as well"
FOLD_OF_NAMED_PARTS = [
    ({"fold": 0, "split": "blocks"}, rf"{NAMED_PARTS}; leave out data.split"),
    ({"fold": 0, "test_path": "test.csv"}, NAMED_PARTS),
]
WRONG_FIELDS = [*NO_FILE, *WRONG_STEP, *WRONG_PARTS, *WRONG_CHOICE]
WRONG_FOLDS = [*WRONG_FOLD, *FOLD_OF_NAMED_PARTS]


@pytest.mark.parametrize(("changes", "words"), [*WRONG_FIELDS, *WRONG_FOLDS])
def test_wrong_requests(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    with pytest.raises(BadRequest, match=words):
        data(csv(tmp_path), **changes).build(0)


EVEN_CLOCKS = [{"step_s": None}, {"step_s": 0.01, "resample": True}]


def test_a_clock_that_wanders_is_interpolated_and_says_so(tmp_path: Path) -> None:
    t = GOOD["t"].copy()
    t[100:] += 0.003
    output = np.sin(t)
    path = csv(tmp_path, t=t, y=output, u=np.cos(t))

    for changes in EVEN_CLOCKS:
        built = data(path, time="t", **changes).build(0)
        outputs = join_outputs(built)
        count = len(outputs)
        even_time_s = 0.01 * np.arange(count)
        expected = np.sin(even_time_s)
        np.testing.assert_allclose(outputs, expected, atol=1e-4)
        assert "50% of the samples interpolated" in built.metadata["reading"]


def test_rows_that_no_clock_has_made_are_refused_and_resampling_offered(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    intervals = rng.exponential(0.01, SAMPLES)
    t = np.cumsum(intervals)
    output = np.sin(t)
    path = csv(tmp_path, t=t, y=output, u=np.cos(t))

    words = r"periods are uneven, .*data\.resample=true.*ssm-study look"
    with pytest.raises(BadRequest, match=words):
        data(path, step_s=None).build(0)
    built = data(path, step_s=0.01, resample=True).build(0)
    assert built.step_s == 0.01


@pytest.mark.parametrize("constant", ["u", "y"])
def test_a_constant_channel(tmp_path: Path, constant: str) -> None:
    values = np.full(SAMPLES, 2.0)
    path = csv(tmp_path, **{constant: values})
    words = f"{constant} = 2.0: constant over the training records"
    with pytest.raises(BadRequest, match=words):
        data(path).build(0)


def write_mat_with_output(path: Path, output: object) -> None:
    """The good log as MAT, its output replaced."""
    variables = GOOD | {"y": output}
    savemat(path, variables)


def test_mat_of_unequal_lengths(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    shorter = GOOD["y"][:-1]
    write_mat_with_output(path, shorter)
    with pytest.raises(BadRequest, match="columns differ in length"):
        data(path).build(0)


TWO_COLUMNS = np.ones((10, 2))
TEXT = np.array(["a"])
COMPLEX = np.ones(3) + 1j
STRUCTURE = {"a": 1}


@pytest.mark.parametrize("value", [TWO_COLUMNS, TEXT, COMPLEX, STRUCTURE])
def test_mat_of_the_wrong_kind(tmp_path: Path, value: object) -> None:
    path = tmp_path / "log.mat"
    write_mat_with_output(path, value)
    words = r"log.mat \(variable\) = y"
    with pytest.raises(BadRequest, match=words):
        data(path).build(0)


OTHER_KINDS = [
    ("log.bin", "contains NUL bytes, so it is no text"),
    ("log.bag", r"files of the kind \.bag are not read; export the topics as MCAP or CSV"),
]


@pytest.mark.parametrize(("name", "words"), OTHER_KINDS)
def test_files_of_other_kinds(tmp_path: Path, name: str, words: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"PK\0\1")
    with pytest.raises(BadRequest, match=words):
        data(path).build(0)
