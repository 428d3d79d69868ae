"""The same bad record in every format a reader takes: one sentence naming file, line or field,
whatever the suffix."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from mcap.writer import Writer
from pyarrow import parquet
from scipy.io import savemat

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet

T = 200
RNG = np.random.default_rng(0)
TIME_S = np.arange(T) * 0.01
INPUT = RNG.standard_normal(T)
OUTPUT = RNG.standard_normal(T)
GOOD = {"t": TIME_S, "u": INPUT, "y": OUTPUT}
EVERY = [".csv", ".mat", ".parquet", ".mcap"]
STATING = [".csv", ".parquet", ".mcap"]  # MAT has no place for a unit


def write_parquet(path: Path, columns: dict[str, np.ndarray], unit: str) -> None:
    """Write the columns as Parquet, the unit of `y` in its field."""
    units = {"y": {"unit": unit}} if unit else {}
    fields = [pa.field(name, pa.float64(), metadata=units.get(name)) for name in columns]
    schema = pa.schema(fields)
    arrays = [pa.array(values) for values in columns.values()]
    table = pa.table(arrays, schema=schema)
    parquet.write_table(table, path)


def write_signals(path: Path, columns: dict[str, np.ndarray], unit: str) -> None:
    """Write the columns as MCAP, the times as log times, the unit of `y` in its channel."""
    names = [name for name in columns if name != "t"]
    units = {"y": unit}
    channels = tuple(Channel(name=name, unit=units.get(name, "")) for name in names)
    signals = [columns[name] for name in names]
    values = np.stack(signals, axis=1)
    topic = {"topic": "/log", "channels": channels}
    signal_group = SignalGroup(time_s=columns["t"], values=values, **topic)
    write_mcap(path, (signal_group,), {})


def written(folder: Path, suffix: str, columns: dict[str, np.ndarray], unit: str = "") -> Path:
    """The columns as a file; `unit` is stated as that of `y`, where and how the format states
    units."""
    path = folder / f"log{suffix}"
    if suffix == ".csv":
        table = pd.DataFrame(columns)
        new_names = {"y": f"y [{unit}]"} if unit else {}
        renamed = table.rename(columns=new_names)
        renamed.to_csv(path, index=False)
    elif suffix == ".parquet":
        write_parquet(path, columns, unit)
    elif suffix == ".mat":
        savemat(path, columns)
    else:
        write_signals(path, columns, unit)
    return path


def write_changed(folder: Path, suffix: str, **changed: np.ndarray) -> Path:
    """The good log with these columns in place of its own."""
    columns = GOOD | changed
    return written(folder, suffix, columns)


def build(path: Path, **changes: object) -> DataSet:
    fields: dict[str, object] = {"path": str(path), "step_s": 0.01}
    fields |= {"input": "u", "output": "y"}
    fields |= changes
    recorded_data = RecordedData(**fields)  # type: ignore[arg-type]
    return recorded_data.build(0)


def refused(path: Path, says: str, **changes: object) -> None:
    with pytest.raises(BadRequest, match=says) as refusal:
        build(path, **changes)
    message = str(refusal.value)
    assert "\n" not in message


@pytest.mark.parametrize("suffix", EVERY)
def test_a_missing_column(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, GOOD)
    build(path)
    words = rf"log\{suffix} \(\w+\) = speed: the (header|file|recording) has .*u.*y"
    refused(path, words, output="speed")


@pytest.mark.parametrize("bad", [np.inf, -np.inf])
@pytest.mark.parametrize("suffix", EVERY)
def test_numbers_that_are_not_finite(tmp_path: Path, suffix: str, bad: float) -> None:
    y = GOOD["y"].copy()
    y[50] = bad
    says = r"column y, line 52 = " if suffix == ".csv" else r"column y, \w+ 50 = "
    path = write_changed(tmp_path, suffix, y=y)
    refused(path, says)


@pytest.mark.parametrize("suffix", EVERY)
def test_a_missing_value_cuts_the_record(tmp_path: Path, suffix: str) -> None:
    """Nothing is invented: the two stretches train apart, and the outcome says so."""
    y = GOOD["y"].copy()
    y[50] = np.nan
    path = write_changed(tmp_path, suffix, y=y)
    built = build(path)
    lengths = [len(record) for record in built.training]
    assert lengths == [50, 69]
    later = built.training[1]
    actual = later.y[:, 0]
    expected = GOOD["y"][51:120]
    np.testing.assert_array_equal(actual, expected)
    first = later.first
    assert first == 51
    assert "cut at 1 row with missing values in 1 place" in built.metadata["reading"]


def test_text_in_a_number_column_of_parquet(tmp_path: Path) -> None:
    table = pd.DataFrame(GOOD)
    words = table.astype({"y": str})
    path = tmp_path / "log.parquet"
    words.to_parquet(path)
    message = r"log.parquet \(column\) = y: holds (large_)?string, not numbers"
    refused(path, message)


@pytest.mark.parametrize("suffix", STATING)
def test_a_declared_unit_that_the_file_contradicts(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, GOOD, unit="rad/s")
    built = build(path, output_unit="rad/s")
    unit = built.outputs[0].unit
    assert unit == "rad/s"
    words = rf"unit of y = rpm: log\{suffix} states rad/s; declare the unit"
    refused(path, words, output_unit="rpm")


@pytest.mark.parametrize("suffix", [".mat", ".parquet", ".csv"])
def test_time_running_backwards(tmp_path: Path, suffix: str) -> None:
    """Log times of MCAP are ordered by the writer; the reader of others checks them too (the next
    test)."""
    t = GOOD["t"].copy()
    t[100] = t[98]
    path = write_changed(tmp_path, suffix, t=t)
    refused(path, "sample 100 is not later", time="t", step_s=None)


OBJECT_SCHEMA = {"encoding": "jsonschema", "data": b'{"type": "object"}'}


def foreign(folder: Path, times_s: np.ndarray, y: list[object]) -> Path:
    """JSON messages as another program may have logged them."""
    path = folder / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(name="log", **OBJECT_SCHEMA)
        encoding = {"message_encoding": "json", "schema_id": schema}
        channel = writer.register_channel(topic="/log", **encoding)
        for time_s, u_k, y_k in zip(times_s, GOOD["u"], y, strict=True):
            at = round(1e9 * time_s)
            times = {"log_time": at, "publish_time": at}
            text = json.dumps({"u": u_k, "y": y_k})
            message = text.encode()
            writer.add_message(channel, data=message, **times)
        writer.finish()
    return path


def test_another_programs_recording(tmp_path: Path) -> None:
    """Good as it is; refused with log times running backwards, and with text in a number field."""
    y = GOOD["y"].tolist()
    t = GOOD["t"].copy()
    path = foreign(tmp_path, t, y)
    build(path)
    with_a_word = [*y[:50], "fast", *y[51:]]
    path = foreign(tmp_path, t, with_a_word)
    refused(path, "y = fast: no number in message 50")
    t[100] = t[98]
    path = foreign(tmp_path, t, y)
    words = r"/log \(time_s\) = .*times must be finite, increasing"
    refused(path, words)


@pytest.mark.parametrize("suffix", EVERY)
def test_times_that_no_clock_has_made_and_the_offer_to_resample(
    tmp_path: Path, suffix: str
) -> None:
    rng = np.random.default_rng(0)
    intervals = rng.exponential(0.01, T)
    t = np.cumsum(intervals)
    u = np.cos(t)
    y = np.sin(t)
    path = write_changed(tmp_path, suffix, t=t, u=u, y=y)
    clock: dict[str, object] = {"step_s": 0.01}
    if suffix != ".mcap":
        clock["time"] = "t"
    refused(path, r"periods are uneven, .*data\.resample=true", **clock)
    build(path, resample=True, **clock)


@pytest.mark.parametrize("suffix", EVERY)
def test_shorter_than_the_start_up_window(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, GOOD)
    words = "no longer than the start-up window of 60"
    refused(path, words, start_up_samples=60)


SHARES = [0.0, 0.1, 0.5, 0.9, 0.99]


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("suffix", [".mat", ".mcap", ".parquet"])
def test_truncated(tmp_path: Path, suffix: str, share: float) -> None:
    path = written(tmp_path, suffix, GOOD)
    content = path.read_bytes()
    size = int(share * len(content))
    path.write_bytes(content[:size])
    refused(path, "log")
