"""A good log, written in every format that the readers know."""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import savemat

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.signals import Channel, Trajectory

SAMPLES = 200
STEP_S = 0.01
TIME_S = np.arange(SAMPLES) * STEP_S
RNG = np.random.default_rng(0)
INPUT = RNG.standard_normal(SAMPLES)
OUTPUT = RNG.standard_normal(SAMPLES)
GOOD = {"t": TIME_S, "u": INPUT, "y": OUTPUT}


def source(log: Path, **settings: object) -> RecordedData:
    """The data set of a log with input `u` and output `y`, with these settings."""
    fields: dict[str, object] = {"path": str(log)}
    fields |= {"input": "u", "output": "y"}
    fields |= settings
    return RecordedData(**fields)  # type: ignore[arg-type]


def data(log: Path, **changes: object) -> RecordedData:
    """The data set of a log at the sampling time of the good one, but for these changes."""
    return source(log, **({"step_s": STEP_S} | changes))


def csv(folder: Path, **columns: np.ndarray) -> Path:
    """The good log, with these columns in place of its own."""
    path = folder / "log.csv"
    table = pd.DataFrame(GOOD | columns)
    table.to_csv(path, index=False)
    return path


def lines() -> list[str]:
    """The good log as lines of text."""
    table = pd.DataFrame(GOOD)
    return table.to_csv(index=False).splitlines()


def write_mcap_log(path: Path, **signals: np.ndarray) -> None:
    """A topic with these signals, sampled as the good log is."""
    channels = tuple(Channel(name=name, unit="") for name in signals)
    columns = list(signals.values())
    values = np.stack(columns, axis=1)
    topic = {"topic": "/log", "channels": channels}
    group = SignalGroup(time_s=TIME_S, values=values, **topic)
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
        write_mcap_log(path, u=INPUT, y=OUTPUT)


def assert_equal_signals(ours: Trajectory, theirs: Trajectory) -> None:
    """Two records have the same input and the same output."""
    np.testing.assert_array_equal(ours.u, theirs.u)
    np.testing.assert_array_equal(ours.y, theirs.y)
