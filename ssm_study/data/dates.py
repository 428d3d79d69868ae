"""Conversion of dates and times in common forms to seconds since the first date."""

import re

import numpy as np
import pandas as pd
from jaxtyping import Float
from pandas.tseries.api import guess_datetime_format

DateSeconds = Float[np.ndarray, "T"]

DATE = (
    r"(?P<a>\d{1,4})[-/.](?P<b>\d{1,2})[-/.](?P<c>\d{1,4})"
    r"(?:[T ]+(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<second>\d\d(?:[.,]\d+)?))?)?"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|[-+]\d\d(?::?\d\d)?)?"
)
TIME_OF_DAY = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d(?:[.,]\d+|:\d{3})?)"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?"
)
MINUTES = r"(?P<minute>\d{1,4}):(?P<second>\d\d[.,]\d+)"  # of a stop watch: `03:12.5`
LONGEST = 40  # letters of a date with the name of a month
DAY_S = 86400.0
ORDERS = {"year first": "abc", "day first": "cba", "month first": "cab"}


class AmbiguousDatesError(ValueError):
    """Error for dates that can be read in two ways, because day and month could be exchanged."""


def is_date(cell: str) -> bool:
    """Whether a text is a date (with or without a time) or a time of day."""
    forms = (DATE, TIME_OF_DAY, MINUTES)
    matches = (re.fullmatch(form, cell) for form in forms)
    if any(matches):
        return True
    return guess_date_format(cell) is not None


def guess_date_format(cell: str) -> str | None:
    """Guess the date format of a text with a named month or with digits around a letter T; None for
    any other text."""
    letters = (letter.isalpha() for letter in cell)
    has_letter = any(letters)
    digits = (letter.isdigit() for letter in cell)
    has_digit = any(digits)
    if not (has_letter and has_digit) or len(cell) > LONGEST:
        return None
    form = guess_datetime_format(cell)
    if form is None:
        return None
    parts = ("%Y", "%d", "%H")
    if not all(part in form for part in parts):
        return None
    is_clear = "%b" in form or "%B" in form or form.startswith("%Y")
    return form if is_clear else None


def dates_to_seconds(cells: list[str]) -> DateSeconds:
    """Convert a column of dates to seconds since the first date; cells without a date become NaN. A
    cell without a date becomes NaN.

    `03/04/2026` may be March or April: the order under which the times increase is taken. Raises
    `AmbiguousDatesError` if they increase under both and the results differ.
    """
    series = pd.Series(cells, dtype=str)
    of_day = series.str.extract(f"^{TIME_OF_DAY}$")
    of_watch = series.str.extract(f"^{MINUTES}$")
    dates = (cell for cell in cells if is_date(cell))
    first = next(dates, "")
    form = None if re.fullmatch(DATE, first) else guess_date_format(first)
    most = len(cells) / 2
    has_hour = of_day["hour"].notna()
    if has_hour.sum() > most:
        seconds = unwrap_times_of_day(seconds_since_midnight(of_day))
    elif of_watch["minute"].notna().sum() > most:
        seconds = seconds_since_midnight(of_watch)
    elif form is not None:
        seconds = parse_named_month_dates(series, form)
    else:
        is_dotted = series.str.match(r"\d{1,2}\.\d{1,2}\.")
        dotted = bool(is_dotted.any())  # the day always stands first
        parts = series.str.extract(f"^{DATE}$")
        seconds = numeric_dates_to_seconds(parts, dotted)
    finite = seconds[np.isfinite(seconds)]
    finite_count = len(finite)
    return seconds - finite[0] if finite_count else seconds


def parse_named_month_dates(series: pd.Series, form: str) -> DateSeconds:
    """Convert dates that name the month to seconds since 1970."""
    dates = pd.to_datetime(series, format=form, errors="coerce", utc=True)
    begin = pd.Timestamp(0, tz="UTC")
    one_second = pd.Timedelta(seconds=1)
    since = (dates - begin) / one_second
    return since.to_numpy(dtype=float)


def seconds_since_midnight(parts: pd.DataFrame) -> DateSeconds:
    """Convert times of day to seconds since midnight."""
    hours = pd.Series(0.0, parts.index)
    if "hour" in parts:
        hour_texts = parts["hour"].fillna("0")
        hours = hour_texts.astype(float)
    minute_texts = parts["minute"].fillna("0")
    minutes = minute_texts.astype(float)
    filled = parts["second"].fillna("0")
    with_point = filled.str.replace(r"[,:]", ".", regex=True)
    seconds = with_point.astype(float)
    if "half" in parts:
        lower = parts["half"].str.lower()
        half = lower.str.replace(r"[.\s]", "", regex=True)
        has_no_half = half.isna()
        in_half = hours.where(has_no_half, hours % 12)
        hours = in_half + 12.0 * (half == "pm")
    total = 3600.0 * hours + 60.0 * minutes + seconds
    parts_in_order = (name for name in ("a", "hour", "minute") if name in parts)
    decisive = next(parts_in_order)
    missing = parts[decisive].isna()
    valid_total = total.where(~missing)
    return valid_total.to_numpy(dtype=np.float64)


def unwrap_times_of_day(seconds: DateSeconds) -> DateSeconds:
    """Correct times of day that continue past midnight, so that they never jump back by a day."""
    numbers = np.nan_to_num(seconds, nan=0.0)
    first_time = seconds[:1]
    steps = np.diff(numbers, prepend=first_time)
    back_by_half_a_day = -DAY_S / 2
    days = np.cumsum(steps < back_by_half_a_day)
    return seconds + DAY_S * days


def numeric_dates_to_seconds(parts: pd.DataFrame, has_dots: bool) -> DateSeconds:
    """Convert dates given as three numbers to seconds since 1970, in the order of day, month and
    year that suits all dates."""
    time_of_day_s = seconds_since_midnight(parts)
    zones = parts["zone"].map(time_zone_offset_s, na_action="ignore")
    filled_zones = zones.fillna(0.0)
    shift = filled_zones.to_numpy(dtype=float)
    readings = []
    for order in ORDERS.values():
        if has_dots and order == "cab":
            continue
        days = days_since_1970(parts, order)
        if days is not None:
            readings.append(DAY_S * days + time_of_day_s - shift)
    return choose_increasing_times(readings, len(parts))


def days_since_1970(parts: pd.DataFrame, order: str) -> DateSeconds | None:
    """Days since 1970 of dates whose numbers are read in a given order of day, month and year; None
    for impossible dates."""
    year, month, day = (pd.to_numeric(parts[letter]) for letter in order)
    year = year.where(year > 99, year + 2000)
    year_range = (year, 1900, 2200)
    month_range = (month, 1, 12)
    day_range = (day, 1, 31)
    ranges = (year_range, month_range, day_range)
    for number, low, high in ranges:
        present = number.dropna()
        is_within = present.between(low, high)
        if not is_within.all():
            return None
    columns = {"year": year, "month": month, "day": day}
    table = pd.DataFrame(columns)
    dates = pd.to_datetime(table, errors="coerce")
    is_no_date = dates.isna()
    has_number = parts["a"].notna()
    is_unread = is_no_date & has_number
    if is_unread.any():
        return None
    since_1970 = dates - pd.Timestamp(0)
    one_day = pd.Timedelta(days=1)
    days = since_1970 / one_day
    return days.to_numpy(dtype=float)


def time_zone_offset_s(zone: str) -> float:
    """Offset from UTC in seconds of a time zone that is written as `+02:00`, `Z` or `UTC`."""
    if zone in ("Z", "UTC", "GMT"):
        return 0.0
    without_sign = zone[1:]
    digits = without_sign.replace(":", "").ljust(4, "0")
    hours = int(digits[:2])
    minutes = int(digits[2:])
    offset = 3600.0 * hours + 60.0 * minutes
    return -offset if zone[0] == "-" else offset


def choose_increasing_times(interpretations: list[np.ndarray], samples: int) -> DateSeconds:
    """Choose, among several interpretations of the same dates, the one whose times increase
    evenly."""
    if not interpretations:
        return np.full(samples, np.nan)
    forwards = [one for one in interpretations if (date_differences_s(one) >= 0).all()]
    chosen = forwards or interpretations
    if len(chosen) > 1 and any(has_no_long_step(one) for one in chosen):
        chosen = [one for one in chosen if has_no_long_step(one)]
    first, *others = map(date_differences_s, chosen)
    if any(not np.allclose(first, other) for other in others):
        raise AmbiguousDatesError
    return chosen[0]


def date_differences_s(seconds: DateSeconds) -> Float[np.ndarray, "T2"]:
    """Differences in seconds between successive dates, with missing dates left out."""
    is_known_time = np.isfinite(seconds)
    return np.diff(seconds[is_known_time])


def has_no_long_step(seconds: DateSeconds) -> bool:
    """Whether no time difference is longer than 1.5 times the median difference."""
    steps = date_differences_s(seconds)
    step_count = len(steps)
    longest = 1.5 * np.median(steps) if step_count else 0.0
    return bool(len(steps)) and bool(steps.max() <= longest)
