"""The clock of a log: which column it is, its unit, and the rows on an even clock.

A clock that is even to within a jitter gives the mean period. One with holes gives the period
between them, and the log is cut there: nothing is invented. One that wanders is interpolated onto
its median period, inputs that hold levels held; how much was interpolated is stated.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from ssm_study.data.readers.reader import Table, folded, title_without_unit
from ssm_study.refusal import BadRequest, at_least, require

# Relative difference allowed between the claimed sampling time and the one that the times show.
AGREEMENT = 1e-3
HOLE = 1.5  # periods from one row to the next from which on a row is missing
WANDERS = 0.5  # spread of the periods, of the median, beyond which rows are no samples of a clock
HELD = 0.5  # share of samples at which a held input does not change
SECONDS = {
    "s": 1.0,
    "sec": 1.0,
    "secs": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "sek": 1.0,
    "sekunden": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "millis": 1e-3,
    "milliseconds": 1e-3,
    "us": 1e-6,
    "usec": 1e-6,
    "μs": 1e-6,
    "micros": 1e-6,
    "microseconds": 1e-6,
    "ns": 1e-9,
    "nanoseconds": 1e-9,
    "min": 60.0,
    "mins": 60.0,
    "minutes": 60.0,
    "h": 3600.0,
    "hr": 3600.0,
    "hrs": 3600.0,
    "hour": 3600.0,
    "hours": 3600.0,
    "d": 86400.0,
    "day": 86400.0,
    "days": 86400.0,
}
WORDS = ("time", "t", "timestamp", "timestamps", "times", "date", "datetime", "dateandtime", "zeit",
         "zeitstempel", "datum", "clock", "elapsed", "elapsedtime", "runtime", "timesec", "temps",
         "tiempo", "tempo", "epoch", "unixtime", "utc", "timeofday", "simtime",
         "stamp", "localtime", "uptime", "recordtime", "logtime")  # fmt: skip
# Seconds since 1970 in smaller units have so many digits: what a unit is without a name.
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


@dataclass(frozen=True, kw_only=True)
class EvenRows:
    """Rows on an even clock: stretches of values, where each starts in samples, and the period.

    `remarks` state holes, missing values and interpolation, in words.
    """

    values: list[Float[np.ndarray, "_ c"]]
    starts: list[int]
    step_s: float
    remarks: list[str]


def clock_unit(title: str, stated: str) -> float | None:
    """Seconds of one unit of a clock, as its name or its column states; None without a unit.

    `time(ms)`, `time_ms`, `t [ms]`, `time ms`, `millis`. Raises `BadRequest` for a unit that is
    none of time.
    """
    if stated:
        unit = stated.strip().replace("µ", "μ")
        seconds = SECONDS.get(unit.lower().rstrip("."))
        problem = f"states the unit {unit}, which is none of time"
        if seconds is None:
            remedy = "use s, ms, us, ns, min or h, or data.step_s"
            raise BadRequest("data.time", title, problem, remedy)
        return seconds
    words = re.split(r"[\s_.\-/]+", title.replace("µ", "μ").strip().lower())
    known = [SECONDS[word] for word in words[-1:] if word in SECONDS and len(words) > 1]
    whole = title.strip().lower()
    long_words = ("millis", "micros", "seconds", "milliseconds", "microseconds", "minutes", "hours")
    return known[0] if known else SECONDS[whole] if whole in long_words else None


def is_clock_name(title: str) -> bool:
    """Whether a title is that of a clock: `time`, `t`, `Timestamp (ms)`, `time_s`, `date`, ..."""
    plain = title_without_unit(title)
    if folded(plain) in WORDS or plain.strip().lower() in ("millis", "micros", "seconds"):
        return True
    words = [word for word in re.split(r"[\s_.\-/]+", plain.lower()) if word]
    return len(words) > 1 and folded("".join(words[:-1])) in WORDS and words[-1] in SECONDS


def find_clock(table: Table, signals: Collection[str]) -> str | None:
    """The column that is the clock: named like one, or without a name and first; else None.

    Its values must increase (a clock written with few digits may stand still). A nameless column
    that counts rows is none: nobody knows how long a row lasts.
    """
    free = [title for title in table.columns if title not in signals]
    for title in free:
        if is_clock_name(title) and runs_forwards(table.columns[title]):
            return title
    first = next(iter(table.columns), None)
    nameless = first is not None and (first == "" or table.nameless or first.startswith("Unnamed"))
    if not nameless or first not in free or len(table.columns) < 2:
        return None
    times = table.columns[first]
    strictly = runs_forwards(times) and bool((np.diff(times[np.isfinite(times)]) > 0).mean() > 0.5)
    return first if strictly and not counts_rows(times) else None


def runs_forwards(times: Float[np.ndarray, "T"]) -> bool:
    """Whether the times never run backwards, and mostly known."""
    known = times[np.isfinite(times)]
    enough = len(known) >= max(3, 0.5 * len(times))
    return bool(enough and (np.diff(known) >= 0).all() and known[-1] > known[0])


def counts_rows(times: Float[np.ndarray, "T"]) -> bool:
    """Whether the column is 0, 1, 2, ... or 1, 2, 3, ..."""
    known = times[np.isfinite(times)]
    return bool(known[0] in (0.0, 1.0) and (np.diff(known) == 1.0).all())


def clock_seconds(title: str, table: Table) -> tuple[Float[np.ndarray, "T"], str]:
    """The times of a column in seconds, and in words what unit was read."""
    times = table.columns[title]
    name = title or "the nameless first column"
    if title in table.dated:
        return times, f"clock {name} (dates)"
    factor = clock_unit(title, table.units.get(title, ""))
    if factor is not None:
        return factor * times, f"clock {name}"
    known = np.abs(times[np.isfinite(times)])
    largest = float(known.max(initial=0.0))
    for digits, seconds in EPOCHS:
        if largest >= digits and np.ptp(known) < 0.1 * largest:
            return seconds * (times - times[0]), f"clock {name} (units of {seconds:g} s since 1970)"
    return times, f"clock {name} (no unit: seconds)"


def mean_period_s(time_s: Float[np.ndarray, "T"], tolerance: float, where: str) -> float:
    """Mean period of times that increase and lie within `tolerance` periods of an even clock;
    refuses others."""
    at_least(2, f"{where} (time)", len(time_s), "use a longer record")
    refuse_backwards(time_s, where)
    mean_s, late = lateness(time_s)
    worst = int(np.argmax(late))
    problem = (
        f"sample {worst} is {late[worst]:.2g} periods off a uniform clock, "
        f"and {tolerance:g} is tolerated"
    )
    remedy = (
        "set data.resample=true to interpolate onto a uniform clock, or raise data.jitter_tolerance"
    )
    require(late[worst] <= tolerance, f"{where} (time)", time_s[worst], problem, remedy)
    return mean_s


def lateness(time_s: Float[np.ndarray, "T"]) -> tuple[float, Float[np.ndarray, "T"]]:
    """The mean period, and by how many of it each sample is off."""
    mean_s = float((time_s[-1] - time_s[0]) / (len(time_s) - 1))
    even = time_s[0] + mean_s * np.arange(len(time_s))
    return mean_s, np.abs(time_s - even) / mean_s


def refuse_backwards(time_s: Float[np.ndarray, "T"], where: str) -> None:
    """Refuse times that run backwards, and times that were rounded so far that they repeat."""
    steps = np.diff(time_s)
    if (steps < 0).any():
        k = int(np.argmax(steps < 0)) + 1
        problem = f"sample {k} is not later than the one before"
        raise BadRequest(f"{where} (time)", time_s[k], problem, "sort the record")
    if (steps == 0).any():
        k = int(np.argmax(steps == 0)) + 1
        first_s = typical_period_s(time_s)
        problem = f"sample {k} has the time of the one before: the times were rounded"
        remedy = f"use data.step_s (the first rows show about {first_s:.4g} s)"
        raise BadRequest(f"{where} (time)", time_s[k], problem, remedy)


def typical_period_s(time_s: Float[np.ndarray, "T"]) -> float:
    """Median of the first hundred periods that are positive."""
    steps = np.diff(time_s)
    return float(np.median(steps[steps > 0][:100]))


def on_even_clock(
    time_s: Float[np.ndarray, "T"],
    values: Float[np.ndarray, "T c"],
    inputs: int,
    where: str,
    *,
    step_s: float | None,
    tolerance: float,
    resample: bool,
) -> EvenRows:
    """The rows on an even clock, cut at holes and at missing values.

    `step_s`, where it is given, must agree with the times within 0.1 %. The first `inputs` columns
    are inputs. Raises `BadRequest` for times that run backwards, repeat, or are no samples of a
    clock, and for a log of which nothing is left.
    """
    known = np.isfinite(time_s)
    time_s = time_s[known]
    values = values[known]
    at_least(3, f"{where} (samples with a time)", len(time_s), "use a longer record")
    if step_s is not None and (np.diff(time_s) == 0).any():
        return rounded_clock(time_s, values, step_s, where)
    refuse_backwards(time_s, where)
    mean_s, late = lateness(time_s)
    if late.max() <= tolerance and not resample:
        require_agreement(step_s, mean_s, where)
        period_s = mean_s if step_s is None else step_s
        return without_missing(EvenRows(values=[values], starts=[0], step_s=period_s, remarks=[]))
    return cut_at_holes(time_s, values, inputs, where, step_s, tolerance, resample)


def rounded_clock(
    time_s: Float[np.ndarray, "T"], values: Float[np.ndarray, "T c"], step_s: float, where: str
) -> EvenRows:
    """Rows with times that were rounded, on the sampling time that is given; refuses another one
    than the first rows show."""
    refuse_backwards(time_s[np.append(True, np.diff(time_s) != 0)], where)
    span_s = float(time_s[-1] - time_s[0])
    coarsest_s = float(np.diff(time_s).max())
    expected_s = step_s * (len(time_s) - 1)
    agrees = abs(span_s - expected_s) <= AGREEMENT * span_s + 2.0 * coarsest_s
    problem = f"the times of {where}, which were rounded, show {span_s / (len(time_s) - 1):.4g} s"
    require(agrees, "data.step_s", step_s, problem, "correct one of them (units?)")
    remark = f"times rounded to {coarsest_s:.3g} s at their end, data.step_s taken"
    return without_missing(EvenRows(values=[values], starts=[0], step_s=step_s, remarks=[remark]))


def require_agreement(step_s: float | None, period_s: float, where: str) -> None:
    """Refuse a sampling time that the times contradict."""
    agrees = step_s is None or abs(step_s - period_s) <= AGREEMENT * period_s
    remedy = "correct one of them (units?), or leave step_s null"
    problem = f"the times of {where} show {period_s:.6g} s"
    require(agrees, "data.step_s", step_s, problem, remedy)


def cut_at_holes(
    time_s: Float[np.ndarray, "T"],
    values: Float[np.ndarray, "T c"],
    inputs: int,
    where: str,
    step_s: float | None,
    tolerance: float,
    resample: bool,
) -> EvenRows:
    """Stretches between the holes of a clock; interpolated where the clock wanders."""
    steps = np.diff(time_s)
    median_s = float(np.median(steps))
    holes = np.flatnonzero(steps > HOLE * median_s)
    bounds = [0, *(holes + 1).tolist(), len(time_s)]
    stretches = [(a, b) for a, b in pairwise(bounds) if b - a > 2]
    remarks = hole_remarks(steps, holes, median_s)
    if (
        stretches
        and not resample
        and all(lateness(time_s[a:b])[1].max() <= tolerance for a, b in stretches)
    ):
        elapsed_s = sum(time_s[b - 1] - time_s[a] for a, b in stretches)
        period_s = float(elapsed_s / sum(b - a - 1 for a, b in stretches))
        require_agreement(step_s, period_s, where)
        period_s = period_s if step_s is None else step_s
        starts = [round((time_s[a] - time_s[0]) / period_s) for a, _ in stretches]
        cut = [values[a:b] for a, b in stretches]
        return without_missing(
            EvenRows(values=cut, starts=starts, step_s=period_s, remarks=remarks)
        )
    require(stretches, f"{where} (time)", "holes", "no stretch without a hole is left", "log on")
    refuse_wandering(steps, median_s, where, resample)
    if not resample:
        require_agreement(step_s, median_s, where)
    period_s = median_s if step_s is None else step_s
    return interpolated(time_s, values, inputs, stretches, period_s, remarks)


def hole_remarks(
    steps: Float[np.ndarray, "T"], holes: Int[np.ndarray, "H"], period_s: float
) -> list[str]:
    """How many holes there are, and how long, in words."""
    if not len(holes):
        return []
    missing_s = float(steps[holes].sum()) - len(holes) * period_s
    word = "hole" if len(holes) == 1 else "holes"
    return [f"cut at {len(holes)} {word} of {missing_s:.3g} s in all"]


def refuse_wandering(
    steps: Float[np.ndarray, "T"], median_s: float, where: str, resample: bool
) -> None:
    """Refuse rows that no clock has made, unless resampling is requested."""
    low, high = np.percentile(steps, [5, 95])
    spread = float(high - low) / median_s
    problem = f"the periods differ by {spread:.0%} of their median, {median_s:.4g} s: no clock"
    remedy = (
        "log at even times; or set data.resample=true to interpolate onto a uniform clock, "
        "data.step_s if the median is not its period"
    )
    require(resample or spread <= WANDERS, f"{where} (time)", median_s, problem, remedy)


def interpolated(
    time_s: Float[np.ndarray, "T"],
    values: Float[np.ndarray, "T c"],
    inputs: int,
    stretches: list[tuple[int, int]],
    period_s: float,
    remarks: list[str],
) -> EvenRows:
    """Stretches on a clock of that period: outputs on lines between rows, held inputs held."""
    cut: list[np.ndarray] = []
    starts: list[int] = []
    between = samples = 0
    for a, b in stretches:
        times = time_s[a:b]
        # Half a rounding error more than the last period: a whole number gives all its samples.
        count = int((times[-1] - times[0]) / period_s + 1e-9) + 1
        clock = times[0] + period_s * np.arange(count)
        columns = [
            held_or_linear(clock, times, column, j < inputs)
            for j, column in enumerate(values[a:b].T)
        ]
        nearest = np.abs(clock - times[nearest_row(clock, times)])
        between += int((nearest > 1e-3 * period_s).sum())
        samples += count
        cut.append(np.stack(columns, axis=1))
        starts.append(round((times[0] - time_s[0]) / period_s))
    remark = f"uneven clock: {between / samples:.0%} of the samples interpolated"
    return without_missing(
        EvenRows(values=cut, starts=starts, step_s=period_s, remarks=[*remarks, remark])
    )


def nearest_row(
    clock: Float[np.ndarray, "K"], times: Float[np.ndarray, "T"]
) -> Int[np.ndarray, "K"]:
    """Index of the recorded time that is nearest to each instant of the clock."""
    after = np.clip(np.searchsorted(times, clock), 1, len(times) - 1)
    return np.where(clock - times[after - 1] < times[after] - clock, after - 1, after)


def held_or_linear(
    clock: Float[np.ndarray, "K"],
    times: Float[np.ndarray, "T"],
    column: Float[np.ndarray, "T"],
    is_input: bool,
) -> Float[np.ndarray, "K"]:
    """A column at other times: an input that holds levels is held, anything else is on lines."""
    if is_input and (np.diff(column) == 0).mean() > HELD:
        last = np.searchsorted(times, clock * (1 + 1e-12) + 1e-12, side="right") - 1
        return column[np.clip(last, 0, len(column) - 1)]
    return np.interp(clock, times, column)


def without_missing(pieces: EvenRows) -> EvenRows:
    """The pieces cut where a value is missing; stretches of one or two rows are left out."""
    cut: list[np.ndarray] = []
    starts: list[int] = []
    missing = gaps = 0
    for values, start in zip(pieces.values, pieces.starts, strict=True):
        whole = np.isfinite(values).all(axis=1)
        edges = np.flatnonzero(np.diff(whole.astype(int), prepend=0, append=0))
        stretches = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        inner = stretches[-1][1] - stretches[0][0] if stretches else 0
        missing += inner - sum(b - a for a, b in stretches)
        gaps += max(len(stretches) - 1, 0)
        for a, b in stretches:
            if b - a > 2 or len(stretches) == 1:
                cut.append(values[a:b])
                starts.append(start + a)
    remarks = list(pieces.remarks)
    if missing:
        remarks.append(f"cut at {missing} rows with missing values in {gaps} places")
    return EvenRows(values=cut, starts=starts, step_s=pieces.step_s, remarks=remarks)
