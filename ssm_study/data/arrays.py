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
from ssm_study.data.clock_column import is_time_title
from ssm_study.data.plain_names import plain_name
from ssm_study.refusal import NO_NUMBERS, BadRequest, require

SignalTable = Float[np.ndarray, "T c"]

ARRAYS = "logs"  # folder of the files that arrays become
INTERPOLATE_OR_CUT = "interpolate it, or give the stretches around it as a list of experiments"
# From so many on, a table that is wider than long lies on its side.
FEWEST_SAMPLES = 20
LATEST = 0.5  # periods by which a time of an index may be off an even clock


@dataclass(frozen=True)
class WrittenLogs:
    """Paths of the log files to which arrays were written, with the column names of inputs, outputs
    and disturbances."""

    paths: list[str]
    inputs: list[str]
    outputs: list[str]
    disturbances: list[str]


def write_log_files(
    u: Any, y: Any, folder: Path, step_s: float | None = None, disturbance: Any = None
) -> WrittenLogs:
    """Write input and output arrays of one or several experiments to log files, one file per
    experiment. Each becomes `logs/<digest>.parquet`, so that equal numbers give the same run."""
    is_list = isinstance(u, list | tuple) and len(u) > 0
    several = is_list and np.ndim(u[0]) > 0
    signals = {"u": u, "y": y}
    if disturbance is not None:
        signals["disturbance"] = disturbance
    experiments = signals
    if not several:
        experiments = {name: [values] for name, values in signals.items()}
    signal_lists = experiments.values()
    counts = tuple(map(len, signal_lists))
    remedy = "give one y for each u"
    names = ", ".join(signals)
    problem = "are not as many experiments"
    distinct_counts = set(counts)
    require(len(distinct_counts) == 1, names, counts, problem, remedy)
    (folder / ARRAYS).mkdir(parents=True, exist_ok=True)
    paths = []
    for parts in zip(*experiments.values(), strict=True):
        named_parts = zip(experiments, parts, strict=True)
        own = dict(named_parts)
        columns, table = combine_signal_columns(own, step_s)
        column_titles = list(table)
        titles = repr(column_titles).encode()
        numbers = table.to_numpy()
        content = titles + numbers.tobytes()
        digest = hashlib.sha256(content).hexdigest()
        path = folder / ARRAYS / f"{digest[:16]}.parquet"
        table.to_parquet(path)
        paths.append(str(path))
    disturbances = columns.get("disturbance", [])
    return WrittenLogs(paths, columns["u"], columns["y"], disturbances)


def combine_signal_columns(
    signals: dict[str, Any], step_s: float | None
) -> tuple[dict[str, list[str]], Any]:
    """Combine the columns of input, output and disturbance of one experiment into one table."""
    first, *others = signals.values()
    for other in others:
        require_consistent_time_indexes(first, other, step_s)
    columns = {}
    values = []
    for name, given in signals.items():
        columns[name], numbers_of_signal = signal_array_and_names(given, name)
        values.append(numbers_of_signal)
    names = ", ".join(signals)
    lengths = tuple(map(len, values))
    remedy = "cut both to the same samples"
    distinct_lengths = set(lengths)
    require(len(distinct_lengths) == 1, names, lengths, "differ in length", remedy)
    titles = [title for own in columns.values() for title in own]
    problem = "two signals have one name"
    distinct_titles = set(titles)
    is_unique = len(distinct_titles) == len(titles)
    require(is_unique, names, titles, problem, "rename the columns")
    refuse_time_and_duplicate_columns(titles, np.hstack(values))
    joined_values = np.hstack(values)
    return columns, pd.DataFrame(joined_values, columns=titles)


def refuse_time_and_duplicate_columns(titles: Sequence[str], values: SignalTable) -> None:
    """Raise `BadRequest` for a signal column that contains times, or that repeats another column's
    numbers."""
    pairs = zip(titles, values.T, strict=True)
    for k, (title, column) in enumerate(pairs):
        steps = np.diff(column)
        increases = bool((steps > 0).all())
        is_clock = is_time_title(title) and increases
        problem = "is the clock: it increases from row to row"
        remedy = "name a signal"
        require(not is_clock, "u, y (column)", title, problem, remedy)
        for j in range(k):
            other_column = values[:, j]
            is_equal = np.array_equal(column, other_column)
            is_copy = np.ptp(column) > 0 and is_equal
            problem = f"holds the numbers of {titles[j]}"
            remedy = "give another signal"
            require(not is_copy, "u, y (column)", title, problem, remedy)


def signal_array_and_names(
    values: Any, name: str, channels: int | None = None, columns: Sequence[str] | None = None
) -> tuple[list[str], SignalTable]:
    """Convert a signal, given as an array, series or data frame, to a numeric array and the names
    of its channels. Columns of a frame are taken in the order of `columns`.

    Raises `BadRequest` for values that are no table of finite real numbers, for a transposed table,
    and for other channels.
    """
    if isinstance(values, pd.DataFrame) and columns is not None:
        values = select_columns(values, name, columns)
    table = as_real_matrix(values, name)
    problem = f"needs {channels} column{'' if channels == 1 else 's'}, one per channel"
    remedy = "give the channels that the model was fitted to"
    channel_count = table.shape[1]
    fits = channels in (None, channel_count)
    require(fits, name, table.shape, problem, remedy)
    refuse_nonfinite(table, values, name)
    if isinstance(values, pd.Series) and values.name is not None:
        return [str(values.name)], table
    if isinstance(values, pd.DataFrame):
        return list(map(str, values)), table
    count = table.shape[1]
    return [name] if count == 1 else [f"{name}_{j + 1}" for j in range(count)], table


def disturbance_array(
    values: Any, names: Sequence[str], samples: int | None = None
) -> Float[np.ndarray, "T k"] | None:
    """Convert measured disturbances to an array with one column per disturbance; None if no
    disturbance was measured.

    Raises `BadRequest` where the model has no path for them, and for another number of samples.
    """
    if values is None:
        return None
    problem = "the model was fitted without measured disturbances"
    remedy = "give them to st.fit"
    require(len(names) > 0, "disturbance", "given", problem, remedy)
    disturbance_count = len(names)
    table = signal_array_and_names(values, "disturbance", disturbance_count, names)[1]
    problem = f"the input has {samples} samples"
    fits = samples in (None, len(table))
    remedy = "cut both to the same samples"
    row_count = len(table)
    require(fits, "disturbance", row_count, problem, remedy)
    return table


def select_columns(frame: pd.DataFrame, name: str, columns: Sequence[str]) -> pd.DataFrame:
    """Columns of a data frame in the order in which the model has its channels.

    A frame whose columns have no names of their own (0, 1, ...) is taken by place.
    """
    own = [plain_name(str(title)) for title in frame]
    channel_count = len(own)
    nameless = list(frame) == list(range(channel_count))
    if nameless or len(own) != len(columns):
        return frame
    named = sorted(own) == sorted(columns)
    problem = f"the model's channels are {', '.join(columns)}"
    remedy = "rename them, or give an array"
    own_names = ", ".join(own)
    require(named, f"{name} (columns)", own_names, problem, remedy)
    places = [own.index(title) for title in columns]
    return frame.iloc[:, places]


def as_real_matrix(values: Any, name: str) -> SignalTable:
    """Convert values to a two-dimensional array of real numbers, one row per sample. Raises
    `BadRequest` for complex numbers, dates, masked samples and arrays with more columns than
    rows."""
    remedy = "give an array (T, channels)"
    mask = np.ma.getmaskarray(values) if np.ma.isMaskedArray(values) else np.zeros(1, dtype=bool)
    masked = bool(mask.any())
    first = int(np.argwhere(mask)[0][0]) if masked else 0
    require(not masked, f"{name}[{first}]", "masked", "has no value", INTERPOLATE_OR_CUT)
    try:
        raw = np.asarray(values)
    except NO_NUMBERS as error:
        kind = type(values).__name__
        raise BadRequest(name, kind, "not a table of numbers", remedy) from error
    problem = "are complex; a signal is real"
    kind_of_number = raw.dtype.kind
    require(kind_of_number != "c", name, "numbers", problem, "give the real part")
    is_time = raw.dtype.kind in "mM"
    number_type = str(raw.dtype)
    require(not is_time, name, number_type, "holds times, not a signal", "name another column")
    try:
        table = np.asarray(raw, dtype=np.float64)
    except NO_NUMBERS as error:
        kind = type(values).__name__
        raise BadRequest(name, kind, "not a table of numbers", remedy) from error
    dimensions = (1, 2)
    is_table = table.ndim in dimensions and table.size > 0
    require(is_table, name, f"shape {table.shape}", "not a signal", remedy)
    samples = len(table)
    table = table.reshape(samples, -1)
    channels = table.shape[1]
    on_its_side = channels > len(table) and channels >= FEWEST_SAMPLES
    problem = "has more channels than samples"
    require(not on_its_side, name, table.shape, problem, f"transpose it: {name}.T")
    return table


def refuse_nonfinite(table: SignalTable, values: Any, name: str) -> None:
    """Raise `BadRequest` for an array with a number that is not finite, and name its place, as in
    `y[1999] is NaN`."""
    is_finite = np.isfinite(table)
    bad = np.argwhere(~is_finite)
    if not len(bad):
        return
    row, column = (int(k) for k in bad[0])
    is_vector = np.ndim(values) == 1
    where = f"{name}[{row}]" if is_vector else f"{name}[{row}, {column}]"
    bad_value = table[row, column]
    word = "NaN" if np.isnan(bad_value) else "infinite"
    count = f"{where} is {word}, and {len(bad) - 1} more" if len(bad) > 1 else f"{where} is {word}"
    raise BadRequest(where, word, count, INTERPOLATE_OR_CUT)


def require_consistent_time_indexes(u: Any, y: Any, step_s: float | None) -> None:
    """Raise `BadRequest` for time indexes that are uneven, or that contradict each other or the
    sampling period."""
    input_side = ("u", u)
    output_side = ("y", y)
    sides = (input_side, output_side)
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
        last_s = times_s[-1]
        span_s = float(last_s - times_s[0])
        period_s = span_s / (len(times_s) - 1)
        agrees = step_s is None or abs(step_s - period_s) <= AGREEMENT * period_s
        problem = f"the index of {name} shows {period_s:.6g} s"
        remedy = "correct one of them"
        require(agrees, "step_s", step_s, problem, remedy)


def index_period_s(signals: Any) -> float | None:
    """Sampling period, in seconds, from the time index of a series or data frame; None for data
    without time stamps."""
    first = signals[0] if isinstance(signals, list | tuple) and len(signals) else signals
    table_types = pd.Series | pd.DataFrame
    if not isinstance(first, table_types):
        return None
    times_s = index_times_s(first.index)
    if times_s is None:
        return None
    refuse_uneven_index(times_s, "u")
    last_s = times_s[-1]
    samples = len(times_s)
    period_s = float(last_s - times_s[0]) / (samples - 1)
    return float(f"{period_s:.9g}")


def refuse_uneven_index(times_s: Float[np.ndarray, "T"], name: str) -> None:
    """Raise `BadRequest` for a time index of a data frame that runs backwards, has a gap, or is not
    evenly spaced."""
    steps = np.diff(times_s)
    median_s = float(np.median(steps))
    where = f"{name} (index)"
    backwards = np.flatnonzero(steps <= 0)
    row = int(backwards[0]) + 1 if len(backwards) else 0
    problem = "is not later than the row before"
    backward_count = len(backwards)
    require(not backward_count, where, f"row {row}", problem, f"sort it: {name}.sort_index()")
    holes = np.flatnonzero(steps > HOLE * median_s)
    row = int(holes[0]) if len(holes) else 0
    problem = f"the times have a hole behind it, of {steps[row]:.4g} s among {median_s:.4g} s"
    hole_count = len(holes)
    require(not hole_count, where, f"row {row}", problem, INTERPOLATE_OR_CUT)
    samples = len(times_s)
    even_s = np.linspace(times_s[0], times_s[-1], samples)
    late = np.abs(times_s - even_s) / median_s
    row = int(late.argmax())
    problem = f"is {late[row]:.2g} periods off an even clock"
    remedy = f"resample it: {name}.resample(...).interpolate()"
    is_even = late[row] <= LATEST
    require(is_even, where, f"row {row}", problem, remedy)


def index_times_s(index: Any) -> Float[np.ndarray, "T"] | None:
    """Convert the index of a series or data frame to times in seconds; None for an index of row
    numbers or names."""
    if len(index) < 3:
        return None
    time_indexes = pd.DatetimeIndex | pd.TimedeltaIndex
    if isinstance(index, time_indexes):
        is_dated = isinstance(index, pd.DatetimeIndex)
        if isinstance(index, pd.DatetimeIndex) and index.tz is not None:
            index = index.tz_convert(None)
        kind = "datetime64[ns]" if is_dated else "timedelta64[ns]"
        times = index.to_numpy()
        nanoseconds = times.astype(kind).astype(np.int64)
        since = nanoseconds - nanoseconds[0]
        return np.asarray(1e-9 * since, dtype=np.float64)
    if index.dtype.kind != "f":
        return None
    numbers = index.to_numpy()
    times_s = numbers.astype(np.float64)
    finite_times = np.isfinite(times_s)
    is_known = bool(finite_times.all())
    increases = np.diff(times_s) > 0
    forwards = is_known and bool(increases.all())
    return times_s if forwards else None
