"""Files the readers must refuse, each in one sentence that names file, line or field; and their
good twins."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, Trajectory

SAMPLES = 200
TIME_S = np.arange(SAMPLES) * 0.01
RNG = np.random.default_rng(0)
GOOD = {"t": TIME_S, "u": RNG.standard_normal(SAMPLES), "y": RNG.standard_normal(SAMPLES)}


def data(log: Path, **changes: object) -> RecordedData:
    fields: dict[str, object] = {"path": str(log), "input": "u", "output": "y", "step_s": 0.01}
    return RecordedData(**(fields | changes))  # type: ignore[arg-type]


def csv(folder: Path, **columns: np.ndarray) -> Path:
    """The good log, with these columns in place of its own."""
    path = folder / "log.csv"
    table = pd.DataFrame(GOOD | columns)
    table.to_csv(path, index=False)
    return path


def write_mcap_log(path: Path, **signals: np.ndarray) -> None:
    """A topic with these signals, sampled as the good log is."""
    channels = tuple(Channel(name=name, unit="") for name in signals)
    values = np.stack(list(signals.values()), axis=1)
    group = SignalGroup(topic="/log", time_s=TIME_S, channels=channels, values=values)
    write_mcap(path, (group,), {})


def write_good_log(path: Path) -> None:
    """The good log in the format that the name of the file says."""
    table = pd.DataFrame(GOOD)
    if path.suffix == ".csv":
        table.to_csv(path, index=False)
    elif path.suffix == ".parquet":
        table.to_parquet(path)
    elif path.suffix == ".mat":
        savemat(path, GOOD)
    else:
        write_mcap_log(path, u=GOOD["u"], y=GOOD["y"])


def assert_equal_signals(ours: Trajectory, theirs: Trajectory) -> None:
    np.testing.assert_array_equal(ours.u, theirs.u)
    np.testing.assert_array_equal(ours.y, theirs.y)


def lines() -> list[str]:
    table = pd.DataFrame(GOOD)
    return table.to_csv(index=False).splitlines()


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".parquet", ".mcap"])
def test_all_formats_give_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    write_good_log(path)

    built = data(path).build(0)
    records = (*built.training, *built.validation, *built.test)
    y = np.concatenate([record.y[:, 0] for record in records])

    np.testing.assert_array_equal(y, GOOD["y"])
    lengths = [len(record) for record in records]
    assert lengths == [120, 40, 40]
    assert built.step_s == 0.01


MALFORMED = {
    "text": (
        lambda rows: [*rows[:50], rows[50].replace(",", ",x", 1), *rows[51:]],
        r"column u, line 51 = x.*: no number",
    ),
    "no names": (
        lambda rows: rows[1:],
        r"log.csv \(column\) = u: the file without names has 0, 1, 2; count the col",
    ),
    "long row": (
        lambda rows: [*rows[:50], rows[50] + ",1.0", *rows[51:]],
        r"Row #51: Expected 3 columns, got 4",
    ),
    "short row": (
        lambda rows: [*rows[:50], rows[50].rsplit(",", 1)[0], *rows[51:]],
        r"Row #51: Expected 3 columns, got 2",
    ),
    "shifted": (
        lambda rows: [rows[0]] + [row + ",7" for row in rows[1:]],
        r"log.csv = 3 names: the rows have 4 cells",
    ),
    "missing column": (
        lambda rows: ["t,u,speed", *rows[1:]],
        r"log.csv \(column\) = y: the header has t, u, speed",
    ),
    "duplicate": (lambda rows: ["y,u,y", *rows[1:]], r"2 times"),
    "inf": (lambda rows: [*rows[:50], "0.49,1.0,inf", *rows[51:]], r"column y, line 51 = inf"),
    "no rows": (lambda rows: rows[:1], r"data.path = .*log.csv: has no rows of numbers"),
    "empty file": (lambda _: [], r"no header"),
    "nul": (lambda rows: [rows[0], "\0\0", *rows[1:]], r"NUL"),
}


@pytest.mark.parametrize(("edit", "says"), MALFORMED.values(), ids=MALFORMED)
def test_malformed_csv(tmp_path: Path, edit, says: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(edit(lines())))

    with pytest.raises(BadRequest, match=says) as refusal:
        data(path).build(0)

    assert "\n" not in str(refusal.value)


def assert_clock_is_refused(path: Path, rows: list[str], says: str) -> None:
    """A log with these rows, its column of times named."""
    path.write_text("\n".join(rows))
    with pytest.raises(BadRequest, match=says):
        data(path, time="t", step_s=None).build(0)


@pytest.mark.parametrize(
    "form", ["2026-03-29 01:59:59.5", "2026-03-29T01:59:59.5Z", "2026-03-29T01:59:59+02:00"]
)
def test_dates_and_times_are_seconds_since_the_first(tmp_path: Path, form: str) -> None:
    """In text and in Parquet; a date among numbers, or a number among dates, is refused where it
    stands."""
    milliseconds = np.round(GOOD["t"] * 1000)
    times = pd.Timestamp(form) + pd.to_timedelta(milliseconds, unit="ms")
    dated = pd.DataFrame(GOOD | {"t": times})
    parquet = tmp_path / "log.parquet"
    dated.to_parquet(parquet)
    text = tmp_path / "log.csv"
    dates = [time.isoformat() for time in times]
    dated.assign(t=dates).to_csv(text, index=False)

    for path in (text, parquet):
        built = data(path, time="t", step_s=None).build(0)
        assert built.step_s == pytest.approx(0.01, rel=1e-6)
        training_input = built.training[0].u[:, 0]
        np.testing.assert_array_equal(training_input, GOOD["u"][:120])

    rows = text.read_text().splitlines()
    number_in_line_51 = [*rows[:50], "0.5,1.0,1.0", *rows[51:]]
    assert_clock_is_refused(text, number_in_line_51, "line 51 = 0.5: no date and time as")
    word_in_line_2 = [rows[0], "soon,1.0,1.0", *rows[2:]]
    assert_clock_is_refused(text, word_in_line_2, "line 2 = soon: no number")
    numbers = lines()
    date_in_line_51 = [*numbers[:50], f"{form},1.0,1.0", *numbers[51:]]
    assert_clock_is_refused(text, date_in_line_51, r"line 51 = 2026.*: no number")


def test_columns_of_a_file_without_names_go_by_their_numbers(tmp_path: Path) -> None:
    """Columns are numbered by integers, as Hydra gives them. The first line is a row; a bad cell is
    found in the line where it stands."""
    path = csv(tmp_path)
    bare = tmp_path / "bare.csv"
    rows = lines()[1:]
    bare.write_text("\n".join(rows))

    named = data(path, time="t", step_s=None).build(0)
    numbered = data(bare, input=1, output=2, time=0, step_s=None).build(0)
    counted = data(path, input=1, output=2).build(0)

    assert_equal_signals(numbered.training[0], named.training[0])
    assert_equal_signals(numbered.test[0], named.test[0])
    assert_equal_signals(counted.test[0], named.test[0])
    assert numbered.inputs[0].name == "input_1"
    assert numbered.outputs[0].name == "output_2"
    with pytest.raises(
        BadRequest, match=r"bare.csv \(column\) = 3: the file without names has 0, 1, 2"
    ):
        data(bare, input=1, output=3).build(0)


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        ("0.49,slow,1.0", r"column 1, line 50 = slow: no number"),
        ("0.49,1.0,inf", r"column 2, line 50 = inf"),
    ],
)
def test_a_bad_cell_of_a_file_without_names_is_found_in_its_line(
    tmp_path: Path, cells: str, says: str
) -> None:
    bare = tmp_path / "bare.csv"
    rows = lines()[1:]
    rows[49] = cells
    bare.write_text("\n".join(rows))

    with pytest.raises(BadRequest, match=says):
        data(bare, input=1, output=2).build(0)


def test_names_that_count_are_names(tmp_path: Path) -> None:
    """Column names may be numbers, as pandas writes an array."""
    path = tmp_path / "log.csv"
    values = np.stack([GOOD["u"], GOOD["y"]], axis=1)
    pd.DataFrame(values).to_csv(path, index=False)

    built = data(path, input=0, output=1).build(0)

    assert len(built.training[0]) == 120


def timed_values(name: str) -> pd.DataFrame:
    """One signal of the good log in a table of its own."""
    return pd.DataFrame({"t": GOOD["t"], "value": GOOD[name]})


U = timed_values("u")
Y = timed_values("y")


def apart(folder: Path, outputs: pd.DataFrame = Y, **changes: object) -> RecordedData:
    """Input and output of the good log in two files."""
    input_path = folder / "in.csv"
    output_path = folder / "out.csv"
    U.to_csv(input_path, index=False)
    outputs.to_csv(output_path, index=False)
    fields = {"output_path": str(output_path), "input": "value", "output": "value"} | changes
    return data(input_path, **fields)


def test_input_and_output_in_two_files(tmp_path: Path) -> None:
    """Equal names tell the sides apart; every file counts as one that the data set rests on."""
    source = apart(tmp_path, time="t", step_s=None)
    built = source.build(0)
    in_one_file = data(csv(tmp_path), time="t", step_s=None).build(0)

    assert_equal_signals(built.validation[0], in_one_file.validation[0])
    assert built.inputs[0].name == "input_value"
    assert built.outputs[0].name == "output_value"
    names = [path.name for path in source.data_files()]
    assert names == ["in.csv", "out.csv"]


def test_two_files_with_names_of_their_own(tmp_path: Path) -> None:
    """Listed together, the files are one log with the columns of both."""
    paths = apart(tmp_path).data_files()
    files = [str(path) for path in paths]
    Y.rename(columns={"value": "speed"}).to_csv(paths[1], index=False)

    both = data(paths[0], path=files, input="value", output="speed").build(0)
    in_one_file = data(csv(tmp_path), time="t", step_s=None).build(0)

    assert len(both.training) == 1
    assert both.inputs[0].name == "value"
    assert both.outputs[0].name == "speed"
    np.testing.assert_array_equal(both.test[0].y, in_one_file.test[0].y)


def test_a_test_record_in_two_files(tmp_path: Path) -> None:
    source = apart(tmp_path)
    tested = apart(tmp_path, test_path=source.path, test_output_path=source.output_path).build(0)
    test_output = tested.test[0].y[:, 0]
    np.testing.assert_array_equal(test_output, GOOD["y"])


LATE = Y.assign(t=Y.t + 0.2)


@pytest.mark.parametrize(
    ("outputs", "changes", "says"),
    [
        (Y[:-1], {}, r"data.output_path = .*out.csv: has 199 rows, in.csv 200; cut them to the"),
        (LATE, {"time": "t"}, r"its rows are up to 0.2 s away from those of the inputs; log both"),
        (
            Y,
            {"output_path": ["a.csv", "b.csv"]},
            r"data.output_path = \['a.csv', 'b.csv'\]: 2 files of outputs, 1 expected",
        ),
        (
            Y,
            {"test_path": "test.csv"},
            r"data.test_output_path = \[\]: 0 files of outputs, 1 expected",
        ),
        (Y, {"output_path": None}, r"data.output = \['value'\]: is an input too"),
    ],
)
def test_two_files_that_do_not_go_together(
    tmp_path: Path, outputs: pd.DataFrame, changes: dict[str, object], says: str
) -> None:
    with pytest.raises(BadRequest, match=says):
        apart(tmp_path, outputs, **changes).build(0)


def test_two_recordings_have_no_common_clock(tmp_path: Path) -> None:
    inputs = tmp_path / "in.mcap"
    outputs = tmp_path / "out.mcap"
    write_mcap_log(inputs, value=GOOD["u"])
    write_mcap_log(outputs, value=GOOD["y"])

    source = data(inputs, output_path=str(outputs), input="value", output="value")
    with pytest.raises(
        BadRequest,
        match=r"log times count from each recording's own start; put both signals into one",
    ):
        source.build(0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"path": "nowhere.csv"}, r"data.path = nowhere.csv: no such file"),
        ({"path": []}, r"data.path = \[\]: names no file"),
        ({"step_s": 0.0}, r"data.step_s = 0.0: must be positive"),
        ({"step_s": 10.0, "time": "t"}, r"data.step_s = 10.0: the times of log.csv show 0.01 s"),
        ({"output": "u"}, r"is an input too"),
        ({"validation_fraction": 0.6, "test_fraction": 0.6}, r"nothing is left"),
        ({"test_fraction": 0.0}, r"not inside"),
        ({"equilibrium": "median"}, r"use zero or mean"),
        ({"decimate": 0}, r"at least 1"),
        ({"controller": [np.nan, 1.0]}, r"data.controller = \[nan, 1.0\]: is no PI"),
        ({"fold": 5}, r"data.fold = 5: there are 5 folds; count them from 0"),
        ({"folds": 1}, r"data.folds = 1: must be at least 2"),
        (
            {"fold": 0, "split": "blocks"},
            r"data.fold = 0: the parts are named too; leave out data.split",
        ),
        ({"fold": 0, "test_path": "test.csv"}, r"data.fold = 0: the parts are named too"),
    ],
)
def test_wrong_requests(tmp_path: Path, changes: dict[str, object], says: str) -> None:
    with pytest.raises(BadRequest, match=says):
        data(csv(tmp_path), **changes).build(0)


def test_a_clock_that_wanders_is_interpolated_and_says_so(tmp_path: Path) -> None:
    t = GOOD["t"].copy()
    t[100:] += 0.003
    path = csv(tmp_path, t=t, y=np.sin(t), u=np.cos(t))

    for changes in ({"step_s": None}, {"step_s": 0.01, "resample": True}):
        built = data(path, time="t", **changes).build(0)
        records = (*built.training, *built.validation, *built.test)
        y = np.concatenate([record.y[:, 0] for record in records])
        even_time_s = 0.01 * np.arange(len(y))
        np.testing.assert_allclose(y, np.sin(even_time_s), atol=1e-4)
        assert "50% of the samples interpolated" in built.metadata["reading"]


def test_rows_that_no_clock_has_made_are_refused_and_resampling_offered(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.exponential(0.01, SAMPLES))
    path = csv(tmp_path, t=t, y=np.sin(t), u=np.cos(t))

    with pytest.raises(BadRequest, match=r"no clock; .*data\.resample=true.*ssm-study look"):
        data(path, step_s=None).build(0)
    built = data(path, step_s=0.01, resample=True).build(0)
    assert built.step_s == 0.01


@pytest.mark.parametrize("constant", ["u", "y"])
def test_a_constant_channel(tmp_path: Path, constant: str) -> None:
    path = csv(tmp_path, **{constant: np.full(SAMPLES, 2.0)})
    with pytest.raises(BadRequest, match=f"{constant} = 2.0: constant over the training records"):
        data(path).build(0)


def test_mat_of_unequal_lengths(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    savemat(path, GOOD | {"y": GOOD["y"][:-1]})
    with pytest.raises(BadRequest, match="columns differ in length"):
        data(path).build(0)


@pytest.mark.parametrize("value", [np.ones((10, 2)), np.array(["a"]), np.ones(3) + 1j, {"a": 1}])
def test_mat_of_the_wrong_kind(tmp_path: Path, value: object) -> None:
    path = tmp_path / "log.mat"
    savemat(path, GOOD | {"y": value})
    with pytest.raises(BadRequest, match=r"log.mat \(variable\) = y"):
        data(path).build(0)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("log.bin", "contains NUL bytes, so it is no text"),
        ("log.bag", r"files of the kind \.bag are not read; export the topics as MCAP or CSV"),
    ],
)
def test_files_of_other_kinds(tmp_path: Path, name: str, says: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"PK\0\1")
    with pytest.raises(BadRequest, match=says):
        data(path).build(0)
