"""Conversion of dates and times in common forms to seconds since the first."""

import re

import numpy as np
import pandas as pd
from jaxtyping import Float
from pandas.tseries.api import guess_datetime_format

DATE = (
    r"(?P<a>\d{1,4})[-/.](?P<b>\d{1,2})[-/.](?P<c>\d{1,4})"
    r"(?:[T ]+(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<second>\d\d(?:[.,]\d+)?))?)?"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|[-+]\d\d(?::?\d\d)?)?"
)
TIME_OF_DAY = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d(?:[.,]\d+)?)"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?"
)
MINUTES = r"(?P<minute>\d{1,4}):(?P<second>\d\d[.,]\d+)"  # of a stop watch: `03:12.5`
LONGEST = 40  # letters of a date with the name of a month
DAY_S = 86400.0
ORDERS = {"year first": "abc", "day first": "cba", "month first": "cab"}


class AmbiguousDates(ValueError):
    """Raised when dates can be read in two ways, because day and month can be exchanged."""


def is_date(cell: str) -> bool:
    """Whether a cell of a table is a date (with or without a time) or a time of day."""
    if any(re.fullmatch(form, cell) for form in (DATE, TIME_OF_DAY, MINUTES)):
        return True
    return guess_date_format(cell) is not None


def guess_date_format(cell: str) -> str | None:
    """Format of a date that names its month, or that has digits around a letter T; None for any
    other text."""
    has_letter = any(letter.isalpha() for letter in cell)
    if not has_letter or not any(letter.isdigit() for letter in cell) or len(cell) > LONGEST:
        return None
    form = guess_datetime_format(cell)
    if form is None or not all(part in form for part in ("%Y", "%d", "%H")):
        return None
    is_clear = "%b" in form or "%B" in form or form.startswith("%Y")
    return form if is_clear else None


def seconds_since_first(cells: list[str]) -> Float[np.ndarray, "T"]:
    """Convert the dates in a column's cells to seconds since the first date. A cell without a date
    becomes NaN.

    `03/04/2026` may be March or April: the order under which the times increase is taken. Raises
    `AmbiguousDates` where both do and differ.
    """
    series = pd.Series(cells, dtype=str)
    of_day = series.str.extract(f"^{TIME_OF_DAY}$")
    of_watch = series.str.extract(f"^{MINUTES}$")
    first = next((cell for cell in cells if is_date(cell)), "")
    form = None if re.fullmatch(DATE, first) else guess_date_format(first)
    if of_day["hour"].notna().sum() > len(cells) / 2:
        seconds = unwrap_midnight(seconds_since_midnight(of_day))
    elif of_watch["minute"].notna().sum() > len(cells) / 2:
        seconds = seconds_since_midnight(of_watch)
    elif form is not None:
        seconds = parse_named_month_dates(series, form)
    else:
        dotted = bool(series.str.match(r"\d{1,2}\.\d{1,2}\.").any())  # the day always stands first
        seconds = date_seconds(series.str.extract(f"^{DATE}$"), dotted)
    finite = seconds[np.isfinite(seconds)]
    return seconds - finite[0] if len(finite) else seconds


def parse_named_month_dates(series: pd.Series, form: str) -> Float[np.ndarray, "T"]:
    """Convert dates that name the month to seconds since 1970."""
    dates = pd.to_datetime(series, format=form, errors="coerce", utc=True)
    since = (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
    return since.to_numpy(dtype=float)


def seconds_since_midnight(parts: pd.DataFrame) -> Float[np.ndarray, "T"]:
    """Convert times of day to seconds since midnight."""
    has_hours = "hour" in parts
    hours = parts["hour"].fillna("0").astype(float) if has_hours else pd.Series(0.0, parts.index)
    minutes = parts["minute"].fillna("0").astype(float)
    seconds = parts["second"].fillna("0").str.replace(",", ".").astype(float)
    if "half" in parts:
        half = parts["half"].str.lower().str.replace(r"[.\s]", "", regex=True)
        hours = hours.where(half.isna(), hours % 12) + 12.0 * (half == "pm")
    total = 3600.0 * hours + 60.0 * minutes + seconds
    decisive = next(name for name in ("a", "hour", "minute") if name in parts)
    missing = parts[decisive].isna()
    return total.where(~missing).to_numpy(dtype=np.float64)


def unwrap_midnight(seconds: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Make times of day increase past midnight, so that they never jump back by a day."""
    steps = np.diff(np.nan_to_num(seconds, nan=0.0), prepend=seconds[:1])
    days = np.cumsum(steps < -DAY_S / 2)
    return seconds + DAY_S * days


def date_seconds(parts: pd.DataFrame, dotted: bool) -> Float[np.ndarray, "T"]:
    """Convert dates to seconds since 1970, in the order of day, month and year that fits all of
    them."""
    within = seconds_since_midnight(parts)
    shift = parts["zone"].map(zone_seconds, na_action="ignore").fillna(0.0).to_numpy(dtype=float)
    readings = []
    for order in ORDERS.values():
        if dotted and order == "cab":
            continue
        year, month, day = (pd.to_numeric(parts[letter]) for letter in order)
        year = year.where(year > 99, year + 2000)
        fits = year.dropna().between(1900, 2200).all() and month.dropna().between(1, 12).all()
        if not (fits and day.dropna().between(1, 31).all()):
            continue
        dates = pd.to_datetime(
            pd.DataFrame({"year": year, "month": month, "day": day}), errors="coerce"
        )
        if (dates.isna() & parts["a"].notna()).any():
            continue
        days = (dates - pd.Timestamp(0)) / pd.Timedelta(days=1)
        readings.append(DAY_S * days.to_numpy(dtype=float) + within - shift)
    return choose_increasing_reading(readings, len(parts))


def zone_seconds(zone: str) -> float:
    """Offset from UTC, in seconds, of a time zone written as `+02:00`, `Z` or `UTC`."""
    if zone in ("Z", "UTC", "GMT"):
        return 0.0
    digits = zone[1:].replace(":", "").ljust(4, "0")
    offset = 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:])
    return -offset if zone[0] == "-" else offset


def choose_increasing_reading(readings: list[np.ndarray], samples: int) -> Float[np.ndarray, "T"]:
    """Choose, among several interpretations of the same dates, the one in which time increases
    evenly."""
    if not readings:
        return np.full(samples, np.nan)
    forwards = [one for one in readings if (steps_between_dates(one) >= 0).all()]
    chosen = forwards or readings
    if len(chosen) > 1 and any(has_even_steps(one) for one in chosen):
        chosen = [one for one in chosen if has_even_steps(one)]
    first = steps_between_dates(chosen[0])
    if any(not np.allclose(first, steps_between_dates(other)) for other in chosen[1:]):
        raise AmbiguousDates
    return chosen[0]


def steps_between_dates(seconds: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T2"]:
    """Time differences between successive dates, with missing dates left out."""
    return np.diff(seconds[np.isfinite(seconds)])


def has_even_steps(seconds: Float[np.ndarray, "T"]) -> bool:
    """Whether no time step is longer than 1.5 times the median step."""
    steps = steps_between_dates(seconds)
    return bool(len(steps)) and bool(steps.max() <= 1.5 * np.median(steps))
