"""Search for the column of a log that is its clock. It is found by its title, its unit and its
place, and its times are converted to seconds."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.calendar_numbers import are_unix_times, parse_calendar_numbers
from ssm_study.data.clock_restarts import find_time_restarts
from ssm_study.data.clock_wraps import unwrap_clock
from ssm_study.data.readers.reader import Table, normalise_title, title_without_unit
from ssm_study.data.rounded_times import estimate_period_s
from ssm_study.refusal import BadRequest, require

ClockTimes = Float[np.ndarray, "T"]

# Seconds in a unit, and what the unit is called.
UNIT_WORDS = {
    1.0: "s sec secs second seconds sek sekunden с сек 秒",
    1e-3: "ms msec millis milliseconds мс 毫秒",
    1e-6: "us usec μs micros microseconds мкс",
    1e-9: "ns nanoseconds",
    60.0: "min mins minutes мин 分",
    3600.0: "h hr hrs hour hours ч 小时",
    86400.0: "d day days",
}
SECONDS = {word: unit_s for unit_s, words in UNIT_WORDS.items() for word in words.split()}
WORDS_TEXT = """
    time t timestamp timestamps times date datetime dateandtime zeit zeitstempel datum clock
    elapsed elapsedtime runtime timesec temps tiempo tempo epoch unixtime utc timeofday
    simtime stamp localtime uptime recordtime logtime ts unix unixtimestamp zeitpunkt
    uhrzeit heure horodatage hora fecha tijd tijdstip czas время дата 时间 時間 時刻 datenum xvalue
"""
WORDS = tuple(WORDS_TEXT.split())
# Of whole numbers without a unit; the evidence then has a doubt.
MAYBE_SMALLER = "no unit: taken for seconds, though whole numbers may count milliseconds"
FEWEST_UNITS = 2.0  # from one row to the next: a clock in seconds often counts one by one
UNREAD = "not read, column"  # of a clock whose cells are neither numbers nor dates
MOSTLY = 0.9  # share of steps in one direction, from which on a column is a clock out of order


def stated_time_unit_s(title: str, stated_unit: str) -> float | None:
    """Length in seconds of the time unit that a column's title or unit states; None if no unit is
    stated.

    `time(ms)`, `time_ms`, `t [ms]`, `time ms`, `millis`, `min`. Raises `BadRequest` for a unit that
    is no unit of time.
    """
    if stated_unit:
        trimmed_unit = stated_unit.strip()
        unit = trimmed_unit.replace("µ", "μ")
        unit_word = unit.lower().rstrip(".")
        seconds = SECONDS.get(unit_word)
        problem = f"states the unit {unit}, which is not a unit of time"
        if seconds is None:
            remedy = "use s, ms, us, ns, min or h, or data.step_s"
            raise BadRequest("data.time", title, problem, remedy)
        return seconds
    plain_title = title.replace("µ", "μ")
    words = title_words(plain_title)
    last = words[-1] if len(words) > 1 else ""
    if last in SECONDS:
        return SECONDS[last]
    return SECONDS.get(plain_title.strip().lower())


def is_time_title(title: str) -> bool:
    """Whether a column title is one that is usual for times, such as `time`, `t`, `Timestamp (ms)`
    or `date`."""
    plain = title_without_unit(title)
    lower = plain.strip().lower()
    normalised = normalise_title(plain)
    if normalised in WORDS or lower in ("millis", "micros", "seconds"):
        return True
    words = title_words(plain)
    if len(words) < 2 or words[-1] not in SECONDS:
        return False
    first_words = words[:-1]
    without_unit = "".join(first_words)
    return normalise_title(without_unit) in WORDS


def is_unit_of_time(title: str) -> bool:
    """Whether a column is titled by a unit of time alone, such as `min` or `ms`; `min` may also be
    a minimum, so that its values must decide."""
    return title.strip().lower().replace("µ", "μ") in SECONDS


def resembles_clock(title: str, unit: str, times: ClockTimes) -> bool:
    """Whether a column has the title or unit of a time, and values that nearly always increase."""
    plain_unit = unit.strip()
    has_unit = plain_unit.lower().rstrip(".") in SECONDS
    if not has_unit and not is_time_title(title):
        return False
    is_known_time = np.isfinite(times)
    steps = np.diff(times[is_known_time])
    return len(steps) > 1 and bool((steps > 0).mean() > MOSTLY)


def has_time_word(title: str) -> bool:
    """Whether a column title begins or ends with a word for time, such as `t_now` and
    `sensor_timestamp`."""
    words = title_words(title_without_unit(title))
    first_word = words[:1]
    last_word = words[-1:]
    ends = (*first_word, *last_word)
    return any(normalise_title(word) in WORDS for word in ends)


def title_words(title: str) -> list[str]:
    """Words of a column title in lower case, split at spaces, underscores, points and dashes."""
    lower_title = title.lower()
    return [word for word in re.split(r"[\s_.\-/]+", lower_title) if word]


def find_clock_column(table: Table, signals: Collection[str]) -> str | None:
    """Find the column of a log that contains the times of its rows; None if no column does. It is
    the column with the title of a clock, else the first one if it has no title.

    Its values must increase (a clock written with few digits may stand still); where a title has a
    clock's word beside others, `t_now`, or is a unit alone, `min`, they must not stand still
    either. The first column of a matrix, `data:1`, has no name either and must run evenly. A column
    without a title that counts rows is no clock, because it does not say how long a row lasts.
    """
    free = [title for title in table.columns if title not in signals]
    named = [title for title in free if is_time_title(title)]
    clocks = [title for title in named if is_clock_column(table, title)]
    strict = [title for title in clocks if is_strictly_increasing_clock(table, title)]
    if clocks:
        clock = (strict or clocks)[0]
        return contradicting_date_column(table, clock, free) or clock
    for title in free:
        if has_time_word(title) and is_strictly_increasing_clock(table, title):
            return title
    for title in free:
        if is_unit_of_time(title) and is_strictly_increasing_clock(table, title):
            return title
    for title in free:
        times = table.columns[title]
        are_unix = are_unix_times(times)
        if are_unix and is_increasing(times, strictly=True):
            return title
    for title in free:
        times = table.columns[title]
        is_first = title.endswith((":1", ".X.Data"))  # the second is that of a recorder's struct
        if is_first and is_evenly_spaced(times) and not are_row_numbers(times):
            return title
    titles = iter(table.columns)
    first = next(titles, None)
    if first is None or first not in free or len(table.columns) < 2:
        return None
    if not has_no_title(table, first):
        return None
    times = table.columns[first]
    if not is_increasing(times) or are_row_numbers(times):
        return None
    finite_times = times[np.isfinite(times)]
    increases = np.diff(finite_times) > 0
    mostly = bool(increases.mean() > 0.5)
    is_clock = mostly or estimate_period_s(finite_times) is not None
    return first if is_clock else None


def contradicting_date_column(table: Table, title: str, free: Sequence[str]) -> str | None:
    """Column of dates that contradicts a time column without unit, because both cover different
    time spans; None if there is no such column."""
    has_unit = stated_time_unit_s(title, table.units.get(title, "")) is not None
    if has_unit or title in table.dated:
        return None
    span_s = np.ptp(unwrap_column_times(table, title))
    for dated in free:
        if dated in table.dated and is_clock_column(table, dated):
            dated_span_s = np.ptp(unwrap_column_times(table, dated))
            if not 0.5 < dated_span_s / span_s < 2.0:
                return dated
    return None


def has_no_title(table: Table, title: str) -> bool:
    """Whether a column has no title of its own in the log file."""
    return title == "" or table.nameless or title.startswith("Unnamed")


def unwrap_column_times(table: Table, title: str) -> ClockTimes:
    """Times in a column, corrected so that they keep increasing where a counter overflows or summer
    time ends."""
    times = table.columns[title]
    is_dated = title in table.dated
    return unwrap_clock(times, is_dated=is_dated)[0]


def is_strictly_increasing_clock(table: Table, title: str) -> bool:
    """Whether the times in a column increase from every row to the next, without equal times."""
    times = unwrap_column_times(table, title)
    return is_increasing(times, strictly=True)


def is_clock_column(table: Table, title: str) -> bool:
    """Whether the numbers in a column are the times of one experiment, or of several one after
    another."""
    times = table.columns[title]
    unwrapped = unwrap_column_times(table, title)
    return is_increasing(unwrapped) or bool(find_time_restarts(times))


def is_increasing(times: ClockTimes, *, strictly: bool = False) -> bool:
    """Whether times never decrease from one to the next, with missing times ignored. Equal times
    count as increasing unless `strictly` is set."""
    finite = times[np.isfinite(times)]
    finite_count = len(finite)
    half = 0.5 * len(times)
    enough = finite_count >= max(3, half)
    if not enough or finite[-1] <= finite[0]:
        return False
    steps = np.diff(finite)
    forwards = steps > 0 if strictly else steps >= 0
    return bool(forwards.all())


def is_evenly_spaced(times: ClockTimes) -> bool:
    """Whether times are evenly spaced up to a thousandth of their spacing."""
    if len(times) < 3 or not np.isfinite(times).all():
        return False
    steps = np.diff(times)
    spread = np.ptp(steps)
    shortest = steps.min()
    return bool(shortest > 0 and spread <= 1e-3 * steps.mean())


def are_row_numbers(times: ClockTimes) -> bool:
    """Whether the values in a column are the row numbers 0, 1, 2, ... or 1, 2, 3, ..."""
    finite = times[np.isfinite(times)]
    is_one = np.diff(finite) == 1.0
    starts_at_one_or_zero = finite[0] in (0.0, 1.0)
    return bool(starts_at_one_or_zero and is_one.all())


def clock_column_seconds(
    title: str, table: Table, *, is_stated: bool = False
) -> tuple[ClockTimes, str]:
    """Convert the times in a log's time column to seconds, and describe the unit that they had.

    Whole numbers without a unit that are several apart may count milliseconds: unless the sampling
    time is stated, they are taken for seconds with a doubt.
    """
    numbers = table.columns[title]
    is_dated = title in table.dated
    times, undone = unwrap_clock(numbers, is_dated=is_dated)
    words = f"clock {title or 'the nameless first column'}"
    after = f", {undone}" if undone else ""
    if title in table.dated:
        return times, f"{words} (dates){after}"
    stated_unit = table.units.get(title, "")
    factor = stated_time_unit_s(title, stated_unit)
    if factor is not None:
        return factor * times, f"{words}{after}"
    read = parse_calendar_numbers(title, times)
    if read is not None:
        return read[0], f"{words} ({read[1]}){after}"
    if not is_stated and has_subsecond_unit(times):
        return times, f"{words} ({MAYBE_SMALLER}){after}"
    return times, f"{words} (no unit: seconds){after}"


def has_subsecond_unit(times: ClockTimes) -> bool:
    """Whether times are whole numbers whose spacing suggests a unit smaller than a second."""
    finite = times[np.isfinite(times)]
    steps = np.diff(finite)
    rounded = np.round(finite)
    is_whole = np.array_equal(finite, rounded)
    if len(steps) < 2 or not is_whole:
        return False
    period = float(np.median(steps))
    return period >= FEWEST_UNITS and period % 60 != 0


def has_row_number_column(contents: Table) -> bool:
    """Whether the first column of a log has no title and contains the row numbers."""
    columns = contents.columns.items()
    title, times = next(iter(columns))
    column_count = len(contents.columns)
    if column_count < 2 or not has_no_title(contents, title):
        return False
    if not np.isfinite(times).all():
        return False
    return len(times) > 2 and are_row_numbers(times)


def refuse_backward_clock(
    contents: Table, signals: list[str], file: Path, *, is_stated: bool
) -> None:
    """Raise `BadRequest` for a log whose times run backwards, at one row or throughout.

    Where the sampling time is stated a column of one letter may be anything (`T`, a temperature).
    """
    rows = {len(contents.columns[title]) for title in signals}
    for title, times in contents.columns.items():
        plain = title_without_unit(title).strip()
        unit = contents.units.get(title, "")
        is_clock = is_time_title(title) or resembles_clock(title, unit, times)
        if title in signals or not is_clock or (is_stated and len(plain) == 1):
            continue
        if len(times) not in rows:
            continue
        is_known_time = np.isfinite(times)
        steps = np.diff(times[is_known_time])
        if len(steps) < 2:
            continue
        is_back = steps < 0
        descends = bool(is_back.mean() > MOSTLY)
        forward_share = (steps > 0).mean()
        ascends = bool(forward_share > MOSTLY)
        out_of_order = bool(is_back.any()) and ascends
        first_backward = np.argmax(is_back)
        row = int(first_backward) + 1
        problem = f"is named like a clock, and runs backwards at row {row}, counted from 0"
        remedy = "sort the rows by time, or put each experiment into a file of its own"
        require(not (descends or out_of_order), f"{file.name} (column)", title, problem, remedy)


def refuse_clock_as_signal(contents: Table, signals: list[str], file: Path) -> None:
    """Raise `BadRequest` if the time column of a log is chosen as an input or output."""
    first = next(iter(contents.columns))
    for title in signals:
        times = contents.columns[title]
        steps = np.diff(times)
        is_forward = (steps > 0).all()
        forwards = bool(is_forward) and len(steps) > 2
        nameless = title == first and (contents.nameless or title == "")
        spread = float(np.ptp(steps))
        even = forwards and spread <= 1e-6 * float(steps.mean())
        is_named_clock = forwards and is_time_title(title)
        is_clock = is_named_clock or (nameless and even)
        problem = "is the clock: it increases from row to row"
        remedy = "name a signal"
        require(not is_clock, f"{file.name} (column)", title, problem, remedy)


def unreadable_clock_remarks(contents: Table) -> list[str]:
    """Remarks on columns that have the title of a time column but contents that are no times."""
    named = [title for title in contents.skipped if is_time_title(title)]
    return [f"{UNREAD} {title}: {contents.skipped[title]}" for title in named]


def unreadable_clock_sentence(remarks: list[str]) -> str:
    """Sentence for an error message on columns with the title of a time column but contents that
    are no times."""
    unread = [remark for remark in remarks if remark.startswith(UNREAD)]
    return f" ({unread[0]})" if unread else ""
