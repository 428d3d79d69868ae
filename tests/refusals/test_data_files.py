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
from ssm_study.signals import Channel

T = 200


RNG = np.random.default_rng(0)


GOOD = {"t": np.arange(T) * 0.01, "u": RNG.standard_normal(T), "y": RNG.standard_normal(T)}


def data(log: Path, **changes: object) -> RecordedData:
    fields: dict[str, object] = {"path": str(log), "input": "u", "output": "y", "step_s": 0.01}
    return RecordedData(**(fields | changes))  # type: ignore[arg-type]


def csv(folder: Path, text: str | None = None, **columns: np.ndarray) -> Path:
    path = folder / "log.csv"
    if text is None:
        table = pd.DataFrame(GOOD | columns)
        table.to_csv(path, index=False)
    else:
        path.write_text(text)
    return path


def lines() -> list[str]:
    table = pd.DataFrame(GOOD)
    return table.to_csv(index=False).splitlines()


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".parquet", ".mcap"])
def test_all_formats_give_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    if suffix == ".csv":
        table = pd.DataFrame(GOOD)
        table.to_csv(path, index=False)
    elif suffix == ".parquet":
        table = pd.DataFrame(GOOD)
        table.to_parquet(path)
    elif suffix == ".mat":
        savemat(path, GOOD)
    else:
        channel = Channel(name="u", unit="V")
        channels = (channel, Channel(name="y", unit="rad/s"))
        values = np.stack([GOOD["u"], GOOD["y"]], axis=1)
        signal_group = SignalGroup(topic="/log", time_s=GOOD["t"], channels=channels, values=values)
        groups = (signal_group,)
        write_mcap(path, groups, {})
    built = data(path).build(0)
    training_y = built.training[0].y
    validation_y = built.validation[0].y
    test_y = built.test[0].y
    y = np.concatenate([training_y, validation_y, test_y])
    actual = y[:, 0]
    np.testing.assert_array_equal(actual, GOOD["y"])
    expected = [120, 40, 40]
    assert [len(built.training[0]), len(built.validation[0]), len(built.test[0])] == expected
    assert built.step_s == 0.01


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda rows: [*rows[:50], rows[50].replace(",", ",x", 1), *rows[51:]],
         r"column u, line 51 = x.*: no number"),
        (lambda rows: rows[1:],
         r"log.csv \(column\) = u: the file without names has 0, 1, 2; count the col"),
        (lambda rows: [*rows[:50], rows[50] + ",1.0", *rows[51:]],
         r"Row #51: Expected 3 columns, got 4"),
        (lambda rows: [*rows[:50], rows[50].rsplit(",", 1)[0], *rows[51:]],
         r"Row #51: Expected 3 columns, got 2"),
        (lambda rows: [rows[0]] + [row + ",7" for row in rows[1:]],
         r"log.csv = 3 names: the rows have 4 cells"),
        (lambda rows: ["t,u,speed", *rows[1:]],
         r"log.csv \(column\) = y: the header has t, u, speed"),
        (lambda rows: ["y,u,y", *rows[1:]], r"2 times"),
        (lambda rows: [*rows[:50], "0.49,1.0,inf", *rows[51:]], r"column y, line 51 = inf"),
        (lambda rows: rows[:1], r"data.path = .*log.csv: has no rows of numbers"),
        (lambda _: [], r"no header"),
        (lambda rows: [rows[0], "\0\0", *rows[1:]], r"NUL"),
    ],
    ids=["text", "no names", "long row", "short row", "shifted", "missing column", "duplicate",
         "inf",
          "no rows", "empty file", "nul"],
)  # fmt: skip
def test_malformed_csv(tmp_path: Path, edit, says: str) -> None:  # type: ignore[no-untyped-def]
    text = "\n".join(edit(lines()))
    with pytest.raises(BadRequest, match=says) as refusal:
        data(csv(tmp_path, text)).build(0)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "form", ["2026-03-29 01:59:59.5", "2026-03-29T01:59:59.5Z", "2026-03-29T01:59:59+02:00"]
)
def test_dates_and_times_are_seconds_since_the_first(tmp_path: Path, form: str) -> None:
    """In text and in Parquet; a date among numbers, or a number among dates, is refused where it
    stands."""
    timestamp = pd.Timestamp(form)
    times = timestamp + pd.to_timedelta(np.round(GOOD["t"] * 1000), unit="ms")
    dated = pd.DataFrame(GOOD | {"t": times})
    path = tmp_path / "log.csv"
    t = [one.isoformat() for one in times]
    dated.assign(t=t).to_csv(path, index=False)
    dated.to_parquet(tmp_path / "log.parquet")
    for one in (path, tmp_path / "log.parquet"):
        built = data(one, time="t", step_s=None).build(0)
        assert built.step_s == pytest.approx(0.01, rel=1e-6)
        training_u = built.training[0].u
        actual = training_u[:, 0]
        expected = GOOD["u"][:120]
        np.testing.assert_array_equal(actual, expected)
    rows = path.read_text().splitlines()
    for at, cell, says in (
        (50, "0.5", "line 51 = 0.5: no date and time as"),
        (1, "soon", "line 2 = soon: no number"),
    ):
        text = "\n".join([*rows[:at], f"{cell},1.0,1.0", *rows[at + 1 :]])
        path.write_text(text)
        with pytest.raises(BadRequest, match=says):
            data(path, time="t", step_s=None).build(0)
    text = "\n".join([*lines()[:50], f"{form},1.0,1.0", *lines()[51:]])
    path.write_text(text)
    with pytest.raises(BadRequest, match=r"line 51 = 2026.*: no number"):
        data(path, time="t", step_s=None).build(0)


def test_columns_of_a_file_without_names_go_by_their_numbers(tmp_path: Path) -> None:
    """Columns are numbered by integers, as Hydra gives them. The first line is a row; a bad cell is
    found in the line where it stands."""
    path = csv(tmp_path)
    bare = tmp_path / "bare.csv"
    text = "\n".join(lines()[1:])
    bare.write_text(text)
    numbered = data(bare, input=1, output=2, time=0, step_s=None).build(0)
    named = data(path, time="t", step_s=None).build(0)
    actual = numbered.training[0].u
    expected = named.training[0].u
    np.testing.assert_array_equal(actual, expected)
    actual = numbered.test[0].y
    expected = named.test[0].y
    np.testing.assert_array_equal(actual, expected)
    name = numbered.inputs[0].name
    assert name == "input_1"
    name = numbered.outputs[0].name
    assert name == "output_2"
    text = "\n".join([*lines()[1:50], "0.49,slow,1.0", *lines()[51:]])
    bare.write_text(text)
    with pytest.raises(BadRequest, match=r"column 1, line 50 = slow: no number"):
        data(bare, input=1, output=2).build(0)
    text = "\n".join([*lines()[1:50], "0.49,1.0,inf", *lines()[51:]])
    bare.write_text(text)
    with pytest.raises(BadRequest, match=r"column 2, line 50 = inf"):
        data(bare, input=1, output=2).build(0)
    with pytest.raises(
        BadRequest, match=r"bare.csv \(column\) = 3: the file without names has 0, 1, 2"
    ):
        data(bare, input=1, output=3).build(0)
    counted = data(path, input=1, output=2).build(0)
    actual = counted.test[0].u
    expected = named.test[0].u
    np.testing.assert_array_equal(actual, expected)


def test_names_that_count_are_names(tmp_path: Path) -> None:
    """Column names may be numbers, as pandas writes an array."""
    table = pd.DataFrame(np.stack([GOOD["u"], GOOD["y"]], axis=1))
    table.to_csv(tmp_path / "log.csv", index=False)
    built = data(tmp_path / "log.csv", input=0, output=1).build(0)
    assert len(built.training[0]) == 120


def apart(folder: Path, u: pd.DataFrame, y: pd.DataFrame, **changes: object) -> RecordedData:
    u.to_csv(folder / "in.csv", index=False)
    y.to_csv(folder / "out.csv", index=False)
    output_path = str(folder / "out.csv")
    fields = {"output_path": output_path, "input": "value", "output": "value"} | changes
    return data(folder / "in.csv", **fields)


def test_input_and_output_in_two_files(tmp_path: Path) -> None:
    """Equal names tell the sides apart; every file counts as one that the data set rests on."""
    sides = ("u", "y")
    u, y = (pd.DataFrame({"t": GOOD["t"], "value": GOOD[side]}) for side in sides)
    source = apart(tmp_path, u, y, time="t", step_s=None)
    built = source.build(0)
    one = data(csv(tmp_path), time="t", step_s=None).build(0)
    actual = built.validation[0].u
    expected = one.validation[0].u
    np.testing.assert_array_equal(actual, expected)
    actual = built.validation[0].y
    expected = one.validation[0].y
    np.testing.assert_array_equal(actual, expected)
    name = built.inputs[0].name
    assert name == "input_value"
    name = built.outputs[0].name
    assert name == "output_value"
    paths = source.data_files()
    names = [path.name for path in paths]
    assert names == ["in.csv", "out.csv"]
    paths = source.data_files()
    files = [str(path) for path in paths]
    columns = {"value": "speed"}
    y.rename(columns=columns).to_csv(files[1], index=False)
    both = data(csv(tmp_path), path=files, input="value", output="speed").build(0)
    assert len(both.training) == 1
    name = both.inputs[0].name
    assert name == "value"
    name = both.outputs[0].name
    assert name == "speed"
    actual = both.test[0].y
    expected = one.test[0].y
    np.testing.assert_array_equal(actual, expected)
    tested = apart(
        tmp_path, u, y, test_path=source.path, test_output_path=source.output_path
    ).build(0)
    test_y = tested.test[0].y
    actual = test_y[:, 0]
    np.testing.assert_array_equal(actual, GOOD["y"])


def test_two_files_that_do_not_go_together(tmp_path: Path) -> None:
    sides = ("u", "y")
    u, y = (pd.DataFrame({"t": GOOD["t"], "value": GOOD[side]}) for side in sides)
    with pytest.raises(
        BadRequest,
        match=r"data.output_path = .*out.csv: has 199 rows, in.csv 200; cut them to the same",
    ):
        apart(tmp_path, u, y[:-1]).build(0)
    t = y.t + 0.2
    with pytest.raises(
        BadRequest, match=r"its rows are up to 0.2 s away from those of the inputs; log both on one"
    ):
        apart(tmp_path, u, y.assign(t=t), time="t").build(0)
    output_path = ["a.csv", "b.csv"]
    with pytest.raises(
        BadRequest, match=r"data.output_path = \['a.csv', 'b.csv'\]: 2 files of outputs, 1 expected"
    ):
        apart(tmp_path, u, y, output_path=output_path)
    with pytest.raises(
        BadRequest, match=r"data.test_output_path = \[\]: 0 files of outputs, 1 expected"
    ):
        apart(tmp_path, u, y, test_path="test.csv")
    with pytest.raises(BadRequest, match=r"data.output = \['value'\]: is an input too"):
        apart(tmp_path, u, y, output_path=None)
    recordings = []
    for name, side in (("in", u), ("out", y)):
        channel = Channel(name="value", unit="")
        group = (channel,)
        signal_group_values = side[["value"]].to_numpy()
        group = SignalGroup(
            topic="/log", time_s=GOOD["t"], channels=group, values=signal_group_values
        )
        write_mcap(tmp_path / f"{name}.mcap", (group,), {})
        recordings.append(str(tmp_path / f"{name}.mcap"))
    with pytest.raises(
        BadRequest,
        match=r"log times count from each recording's own start; put both signals into one",
    ):
        data(Path(recordings[0]), output_path=recordings[1], input="value", output="value").build(0)


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
    """Rows that no clock has made are refused, and resampling offered."""
    t = GOOD["t"].copy()
    t[100:] += 0.003
    sine = np.sin(t)
    u = np.cos(t)
    path = csv(tmp_path, t=t, y=sine, u=u)
    for changes in ({"step_s": None}, {"step_s": 0.01, "resample": True}):
        built = data(path, time="t", **changes).build(0)
        assert "50% of the samples interpolated" in built.metadata["reading"]
        y = np.concatenate([r.y for r in (*built.training, *built.validation, *built.test)])[:, 0]
        expected = np.sin(0.01 * np.arange(len(y)))
        np.testing.assert_allclose(y, expected, atol=1e-4)
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.exponential(0.01, T))
    sine = np.sin(t)
    u = np.cos(t)
    path = csv(tmp_path, t=t, y=sine, u=u)
    with pytest.raises(BadRequest, match=r"no clock; .*data\.resample=true.*ssm-study look"):
        data(path, step_s=None).build(0)
    step_s = data(path, step_s=0.01, resample=True).build(0).step_s
    assert step_s == 0.01


@pytest.mark.parametrize("constant", ["u", "y"])
def test_a_constant_channel(tmp_path: Path, constant: str) -> None:
    with pytest.raises(BadRequest, match=f"{constant} = 2.0: constant over the training records"):
        data(csv(tmp_path, **{constant: np.full(T, 2.0)})).build(0)


def test_mat_of_unequal_lengths(tmp_path: Path) -> None:
    y = GOOD["y"][:-1]
    savemat(tmp_path / "log.mat", GOOD | {"y": y})
    with pytest.raises(BadRequest, match="columns differ in length"):
        data(tmp_path / "log.mat").build(0)


@pytest.mark.parametrize("value", [np.ones((10, 2)), np.array(["a"]), np.ones(3) + 1j, {"a": 1}])
def test_mat_of_the_wrong_kind(tmp_path: Path, value: object) -> None:
    savemat(tmp_path / "log.mat", GOOD | {"y": value})
    with pytest.raises(BadRequest, match=r"log.mat \(variable\) = y"):
        data(tmp_path / "log.mat").build(0)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("log.bin", "contains NUL bytes, so it is no text"),
        ("log.bag", r"files of the kind \.bag are not read; export the topics as MCAP or CSV"),
    ],
)
def test_files_of_other_kinds(tmp_path: Path, name: str, says: str) -> None:
    (tmp_path / name).write_bytes(b"PK\0\1")
    with pytest.raises(BadRequest, match=says):
        data(tmp_path / name).build(0)
