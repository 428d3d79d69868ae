"""Conversion of arrays, series and data frames to log files."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.data.clock import AGREEMENT, HOLE
from ssm_study.data.clock_column import is_clock_name
from ssm_study.data.plain_names import plain_name
from ssm_study.refusal import NO_NUMBERS, BadRequest, require

SignalTable = Float[np.ndarray, "T c"]

ARRAYS = "logs"  # folder of the files that arrays become
INTERPOLATE_OR_CUT = "interpolate it, or give the stretches around it as a list of experiments"
# From so many on, a table that is wider than long lies on its side.
FEWEST_SAMPLES = 20
LATEST = 0.5  # periods by which a time of an index may be off an even clock


@dataclass(frozen=True)
class LoggedArrays:
    """Log files written from arrays, and the names of their columns."""

    paths: list[str]
    inputs: list[str]
    outputs: list[str]
    disturbances: list[str]


def write_log_files(
    u: Any, y: Any, folder: Path, step_s: float | None = None, disturbance: Any = None
) -> LoggedArrays:
    """Write the arrays of experiments to log files. Each becomes `logs/<digest>.parquet`, so that
    equal numbers give the same run."""
    is_list = isinstance(u, list | tuple) and len(u) > 0
    several = is_list and np.ndim(u[0]) > 0
    signals = {"u": u, "y": y}
    if disturbance is not None:
        signals["disturbance"] = disturbance
    experiments = signals
    if not several:
        experiments = {name: [values] for name, values in signals.items()}
    counts = tuple(map(len, experiments.values()))
    remedy = "give one y for each u"
    names = ", ".join(signals)
    problem = "not as many experiments"
    require(len(set(counts)) == 1, names, counts, problem, remedy)
    (folder / ARRAYS).mkdir(parents=True, exist_ok=True)
    paths = []
    for parts in zip(*experiments.values(), strict=True):
        own = dict(zip(experiments, parts, strict=True))
        columns, table = combine_signal_columns(own, step_s)
        titles = repr(list(table)).encode()
        content = titles + table.to_numpy().tobytes()
        digest = hashlib.sha256(content).hexdigest()
        path = folder / ARRAYS / f"{digest[:16]}.parquet"
        table.to_parquet(path)
        paths.append(str(path))
    disturbances = columns.get("disturbance", [])
    return LoggedArrays(paths, columns["u"], columns["y"], disturbances)


def combine_signal_columns(
    signals: dict[str, Any], step_s: float | None
) -> tuple[dict[str, list[str]], Any]:
    """Combine the columns of all signals of one experiment into one table."""
    first, *others = signals.values()
    for other in others:
        check_time_index(first, other, step_s)
    columns = {}
    values = []
    for name, given in signals.items():
        columns[name], numbers_of_signal = signal_columns(given, name)
        values.append(numbers_of_signal)
    names = ", ".join(signals)
    lengths = tuple(map(len, values))
    remedy = "cut both to the same samples"
    require(len(set(lengths)) == 1, names, lengths, "differ in length", remedy)
    titles = [title for own in columns.values() for title in own]
    problem = "two signals have one name"
    is_unique = len(set(titles)) == len(titles)
    require(is_unique, names, titles, problem, "rename the columns")
    refuse_clocks_and_copies(titles, np.hstack(values))
    return columns, pd.DataFrame(np.hstack(values), columns=titles)


def refuse_clocks_and_copies(titles: Sequence[str], values: SignalTable) -> None:
    """Refuse a column that is a clock, and one that repeats the numbers of another."""
    pairs = zip(titles, values.T, strict=True)
    for k, (title, column) in enumerate(pairs):
        increases = bool((np.diff(column) > 0).all())
        is_clock = is_clock_name(title) and increases
        problem = "is the clock: it increases from row to row"
        remedy = "name a signal"
        require(not is_clock, "u, y (column)", title, problem, remedy)
        for j in range(k):
            is_equal = np.array_equal(column, values[:, j])
            is_copy = np.ptp(column) > 0 and is_equal
            problem = f"holds the numbers of {titles[j]}"
            remedy = "give another signal"
            require(not is_copy, "u, y (column)", title, problem, remedy)


def signal_columns(
    values: Any, name: str, channels: int | None = None, columns: Sequence[str] | None = None
) -> tuple[list[str], SignalTable]:
    """Convert one signal, given as an array, series or frame, to numbers and channel names. Columns
    of a frame are taken in the order of `columns`.

    Raises `BadRequest` for what is no table of finite real numbers, lies on its side, or has other
    channels.
    """
    if isinstance(values, pd.DataFrame) and columns is not None:
        values = select_columns(values, name, columns)
    table = as_real_matrix(values, name)
    problem = f"needs one column per channel: {channels}"
    remedy = "give the channels that the model was fitted to"
    fits = channels in (None, table.shape[1])
    require(fits, name, table.shape, problem, remedy)
    refuse_nonfinite(table, values, name)
    if isinstance(values, pd.Series) and values.name is not None:
        return [str(values.name)], table
    if isinstance(values, pd.DataFrame):
        return list(map(str, values)), table
    count = table.shape[1]
    return [name] if count == 1 else [f"{name}_{j + 1}" for j in range(count)], table


def disturbance_values(
    values: Any, names: Sequence[str], samples: int | None = None
) -> Float[np.ndarray, "T k"] | None:
    """Convert measured disturbances to an array with one column for each; None if there are none.

    Raises `BadRequest` where the model has no path for them, and for another number of samples.
    """
    if values is None:
        return None
    problem = "the model was fitted without measured disturbances"
    remedy = "give them to st.fit"
    require(len(names) > 0, "disturbance", "given", problem, remedy)
    table = signal_columns(values, "disturbance", len(names), names)[1]
    problem = f"the input has {samples} samples"
    fits = samples in (None, len(table))
    remedy = "cut both to the same samples"
    require(fits, "disturbance", len(table), problem, remedy)
    return table


def select_columns(frame: pd.DataFrame, name: str, columns: Sequence[str]) -> pd.DataFrame:
    """Select the columns of a data frame in the order of the model's channels.

    A frame whose columns have no names of their own (0, 1, ...) is taken by place.
    """
    own = [plain_name(str(title)) for title in frame]
    nameless = list(frame) == list(range(len(own)))
    if nameless or len(own) != len(columns):
        return frame
    named = sorted(own) == sorted(columns)
    problem = f"the model's channels are {', '.join(columns)}"
    remedy = "rename them, or give an array"
    require(named, f"{name} (columns)", ", ".join(own), problem, remedy)
    places = [own.index(title) for title in columns]
    return frame.iloc[:, places]


def as_real_matrix(values: Any, name: str) -> SignalTable:
    """Convert values to a two-dimensional array of real numbers. Raises `BadRequest` for complex
    numbers, dates, masked samples and arrays with more columns than rows."""
    remedy = "give an array (T, channels)"
    mask = np.ma.getmaskarray(values) if np.ma.isMaskedArray(values) else np.zeros(1, dtype=bool)
    masked = bool(mask.any())
    first = int(np.argwhere(mask)[0][0]) if masked else 0
    require(not masked, f"{name}[{first}]", "masked", "no number", INTERPOLATE_OR_CUT)
    try:
        raw = np.asarray(values)
    except NO_NUMBERS as error:
        raise BadRequest(name, type(values).__name__, "not a table of numbers", remedy) from error
    problem = "are complex; a signal is real"
    require(raw.dtype.kind != "c", name, "numbers", problem, "give the real part")
    is_time = raw.dtype.kind in "mM"
    require(not is_time, name, str(raw.dtype), "holds times, not a signal", "name another column")
    try:
        table = np.asarray(raw, dtype=np.float64)
    except NO_NUMBERS as error:
        raise BadRequest(name, type(values).__name__, "not a table of numbers", remedy) from error
    is_table = table.ndim in (1, 2) and table.size > 0
    require(is_table, name, f"shape {table.shape}", "not a signal", remedy)
    table = table.reshape(len(table), -1)
    channels = table.shape[1]
    on_its_side = channels > len(table) and channels >= FEWEST_SAMPLES
    problem = "has more channels than samples"
    require(not on_its_side, name, table.shape, problem, f"transpose it: {name}.T")
    return table


def refuse_nonfinite(table: SignalTable, values: Any, name: str) -> None:
    """Raise `BadRequest` for an array with a number that is not finite, and name its place, as in
    `y[1999] is NaN`."""
    bad = np.argwhere(~np.isfinite(table))
    if not len(bad):
        return
    row, column = (int(k) for k in bad[0])
    is_vector = np.ndim(values) == 1
    where = f"{name}[{row}]" if is_vector else f"{name}[{row}, {column}]"
    word = "NaN" if np.isnan(table[row, column]) else "infinite"
    count = f"{where} is {word}, and {len(bad) - 1} more" if len(bad) > 1 else f"{where} is {word}"
    raise BadRequest(where, word, count, INTERPOLATE_OR_CUT)


def check_time_index(u: Any, y: Any, step_s: float | None) -> None:
    """Raise `BadRequest` unless the time indexes of series or frames are evenly spaced and agree
    with each other and with the sampling time."""
    sides = (("u", u), ("y", y))
    tables = pd.Series | pd.DataFrame
    indexed = [(name, side.index) for name, side in sides if isinstance(side, tables)]
    lengths = {len(index) for _, index in indexed}
    if len(indexed) == 2 and len(lengths) == 1:
        (_, first), (_, second) = indexed
        problem = "their indexes differ: the samples are not of the same times"
        same = first.equals(second)
        remedy = "align them: y.reindex(u.index)"
        require(same, "u, y (index)", second[0], problem, remedy)
    for name, index in indexed[:1]:
        times_s = index_times_s(index)
        if times_s is None:
            continue
        refuse_uneven_index(times_s, name)
        span_s = float(times_s[-1] - times_s[0])
        period_s = span_s / (len(times_s) - 1)
        agrees = step_s is None or abs(step_s - period_s) <= AGREEMENT * period_s
        problem = f"the index of {name} shows {period_s:.6g} s"
        remedy = "correct one of them"
        require(agrees, "step_s", step_s, problem, remedy)


def index_period_s(signals: Any) -> float | None:
    """Sampling time from the time index of a series or frame; None for arrays and for an index
    without times."""
    first = signals[0] if isinstance(signals, list | tuple) and len(signals) else signals
    if not isinstance(first, pd.Series | pd.DataFrame):
        return None
    times_s = index_times_s(first.index)
    if times_s is None:
        return None
    refuse_uneven_index(times_s, "u")
    period_s = float(times_s[-1] - times_s[0]) / (len(times_s) - 1)
    return float(f"{period_s:.9g}")


def refuse_uneven_index(times_s: Float[np.ndarray, "T"], name: str) -> None:
    """Raise `BadRequest` for a time index that runs backwards, has a gap, or is not evenly
    spaced."""
    steps = np.diff(times_s)
    median_s = float(np.median(steps))
    where = f"{name} (index)"
    backwards = np.flatnonzero(steps <= 0)
    row = int(backwards[0]) + 1 if len(backwards) else 0
    problem = "is not later than the row before"
    require(not len(backwards), where, f"row {row}", problem, f"sort it: {name}.sort_index()")
    holes = np.flatnonzero(steps > HOLE * median_s)
    row = int(holes[0]) if len(holes) else 0
    problem = f"the times have a hole behind it, of {steps[row]:.4g} s among {median_s:.4g} s"
    require(not len(holes), where, f"row {row}", problem, INTERPOLATE_OR_CUT)
    even_s = np.linspace(times_s[0], times_s[-1], len(times_s))
    late = np.abs(times_s - even_s) / median_s
    row = int(late.argmax())
    problem = f"is {late[row]:.2g} periods off an even clock"
    remedy = f"resample it: {name}.resample(...).interpolate()"
    require(late[row] <= LATEST, where, f"row {row}", problem, remedy)


def index_times_s(index: Any) -> Float[np.ndarray, "T"] | None:
    """Convert the index of a series or frame to times in seconds; None for an index of row numbers
    or names."""
    if len(index) < 3:
        return None
    if isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
        is_dated = isinstance(index, pd.DatetimeIndex)
        if isinstance(index, pd.DatetimeIndex) and index.tz is not None:
            index = index.tz_convert(None)
        kind = "datetime64[ns]" if is_dated else "timedelta64[ns]"
        nanoseconds = index.to_numpy().astype(kind).astype(np.int64)
        since = nanoseconds - nanoseconds[0]
        return np.asarray(1e-9 * since, dtype=np.float64)
    if index.dtype.kind != "f":
        return None
    times_s = index.to_numpy().astype(np.float64)
    is_known = bool(np.isfinite(times_s).all())
    increases = np.diff(times_s) > 0
    forwards = is_known and bool(increases.all())
    return times_s if forwards else None
