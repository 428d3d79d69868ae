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
GOOD = {"t": TIME_S, "u": RNG.standard_normal(T), "y": RNG.standard_normal(T)}
EVERY = [".csv", ".mat", ".parquet", ".mcap"]
STATING = [".csv", ".parquet", ".mcap"]  # MAT has no place for a unit


def written(folder: Path, suffix: str, columns: dict[str, np.ndarray], unit: str = "") -> Path:
    """The columns as a file; `unit` is stated as that of `y`, where and how the format states
    units."""
    path = folder / f"log{suffix}"
    if suffix == ".csv":
        table = pd.DataFrame(columns)
        new_names = {"y": f"y [{unit}]"} if unit else {}
        table.rename(columns=new_names).to_csv(path, index=False)
    elif suffix == ".parquet":
        fields = [
            pa.field(n, pa.float64(), metadata={"unit": unit} if unit and n == "y" else None)
            for n in columns
        ]
        arrays = [pa.array(v) for v in columns.values()]
        parquet.write_table(pa.table(arrays, schema=pa.schema(fields)), path)
    elif suffix == ".mat":
        savemat(path, columns)
    else:
        signals = {name: values for name, values in columns.items() if name != "t"}
        channels = tuple(Channel(name=name, unit=unit if name == "y" else "") for name in signals)
        signals_in_order = list(signals.values())
        values = np.stack(signals_in_order, axis=1)
        signal_group = SignalGroup(
            topic="/log", time_s=columns["t"], channels=channels, values=values
        )
        groups = (signal_group,)
        write_mcap(path, groups, {})
    return path


def build(path: Path, **changes: object) -> DataSet:
    fields: dict[str, object] = {"path": str(path), "input": "u", "output": "y", "step_s": 0.01}
    recorded_data = RecordedData(**(fields | changes))
    return recorded_data.build(0)  # type: ignore[arg-type]


def refused(path: Path, says: str, **changes: object) -> None:
    with pytest.raises(BadRequest, match=says) as refusal:
        build(path, **changes)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("suffix", EVERY)
def test_a_missing_column(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, GOOD)
    build(path)
    refused(
        path,
        rf"log\{suffix} \(\w+\) = speed: the (header|file|recording) has .*u.*y",
        output="speed",
    )


@pytest.mark.parametrize("bad", [np.inf, -np.inf])
@pytest.mark.parametrize("suffix", EVERY)
def test_numbers_that_are_not_finite(tmp_path: Path, suffix: str, bad: float) -> None:
    y = GOOD["y"].copy()
    y[50] = bad
    says = r"column y, line 52 = " if suffix == ".csv" else r"column y, \w+ 50 = "
    path = written(tmp_path, suffix, GOOD | {"y": y})
    refused(path, says)


@pytest.mark.parametrize("suffix", EVERY)
def test_a_missing_value_cuts_the_record(tmp_path: Path, suffix: str) -> None:
    """Nothing is invented: the two stretches train apart, and the outcome says so."""
    y = GOOD["y"].copy()
    y[50] = np.nan
    path = written(tmp_path, suffix, GOOD | {"y": y})
    built = build(path)
    expected = [50, 69]
    assert [len(record) for record in built.training] == expected
    training_y = built.training[1].y
    actual = training_y[:, 0]
    expected = GOOD["y"][51:120]
    np.testing.assert_array_equal(actual, expected)
    first = built.training[1].first
    assert first == 51
    assert "cut at 1 row with missing values in 1 place" in built.metadata["reading"]


def test_text_in_a_number_column_of_parquet(tmp_path: Path) -> None:
    table = pd.DataFrame(GOOD)
    words = table.astype({"y": str})
    words.to_parquet(tmp_path / "log.parquet")
    refused(
        tmp_path / "log.parquet", r"log.parquet \(column\) = y: holds (large_)?string, not numbers"
    )


@pytest.mark.parametrize("suffix", STATING)
def test_a_declared_unit_that_the_file_contradicts(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, GOOD, unit="rad/s")
    outputs = build(path, output_unit="rad/s").outputs
    unit = outputs[0].unit
    assert unit == "rad/s"
    refused(
        path, rf"unit of y = rpm: log\{suffix} states rad/s; declare the unit", output_unit="rpm"
    )


@pytest.mark.parametrize("suffix", [".mat", ".parquet", ".csv"])
def test_time_running_backwards(tmp_path: Path, suffix: str) -> None:
    """Log times of MCAP are ordered by the writer; the reader of others checks them too (the next
    test)."""
    t = GOOD["t"].copy()
    t[100] = t[98]
    path = written(tmp_path, suffix, GOOD | {"t": t})
    refused(path, "sample 100 is not later", time="t", step_s=None)


def foreign(folder: Path, times_s: np.ndarray, y: list[object]) -> Path:
    """JSON messages as another program may have logged them."""
    path = folder / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(
            name="log", encoding="jsonschema", data=b'{"type": "object"}'
        )
        channel = writer.register_channel(topic="/log", message_encoding="json", schema_id=schema)
        for time_s, u_k, y_k in zip(times_s, GOOD["u"], y, strict=True):
            at = round(1e9 * time_s)
            text = json.dumps({"u": u_k, "y": y_k})
            message = text.encode()
            writer.add_message(channel, log_time=at, publish_time=at, data=message)
        writer.finish()
    return path


def test_another_programs_recording(tmp_path: Path) -> None:
    """Good as it is; refused with log times running backwards, and with text in a number field."""
    y = [float(v) for v in GOOD["y"]]
    t = GOOD["t"].copy()
    build(foreign(tmp_path, t, [*y]))
    with_a_word = [*y[:50], "fast", *y[51:]]
    refused(foreign(tmp_path, t, with_a_word), "y = fast: no number in message 50")
    t[100] = t[98]
    refused(foreign(tmp_path, t, [*y]), r"/log \(time_s\) = .*times must be finite, increasing")


@pytest.mark.parametrize("suffix", EVERY)
def test_times_that_no_clock_has_made_and_the_offer_to_resample(
    tmp_path: Path, suffix: str
) -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.exponential(0.01, T))
    u = np.cos(t)
    y = np.sin(t)
    path = written(tmp_path, suffix, {"t": t, "u": u, "y": y})
    clock: dict[str, object] = (
        {"step_s": 0.01} if suffix == ".mcap" else {"step_s": 0.01, "time": "t"}
    )
    refused(path, r"no clock; .*data\.resample=true", **clock)
    build(path, resample=True, **clock)


@pytest.mark.parametrize("suffix", EVERY)
def test_shorter_than_the_start_up_window(tmp_path: Path, suffix: str) -> None:
    refused(
        written(tmp_path, suffix, GOOD),
        "no longer than the start-up window of 60",
        start_up_samples=60,
    )


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("suffix", [".mat", ".mcap", ".parquet"])
def test_truncated(tmp_path: Path, suffix: str, share: float) -> None:
    path = written(tmp_path, suffix, GOOD)
    size = int(share * path.stat().st_size)
    path.write_bytes(path.read_bytes()[:size])
    refused(path, "log")
