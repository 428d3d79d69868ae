"""Dates that a log stores as plain numbers, such as a spreadsheet's day numbers, converted to
seconds.

`20260305100000` is a date, `46086.4167` a day of a spreadsheet, `738586.4167` one of MATLAB,
`1772700000000` milliseconds since 1970. Read as seconds, each of them would be wrong without any
warning.
"""

import numpy as np
import pandas as pd
from jaxtyping import Float

DAY_S = 86400.0
# Digits of a whole number, and the date that they write.
DIGITS = {8: "%Y%m%d", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
MILLISECOND_DIGITS = 17  # %Y%m%d%H%M%S and three digits more
YEARS = (1970, 2100)
# Days from 1970 to 2100 as a spreadsheet counts them, MATLAB, and astronomers.
DAY_COUNTS = ((25569.0, 73051.0), (719529.0, 767011.0), (2440587.0, 2488070.0))
DAY_WORDS = ("date", "datum", "day", "days", "datenum", "datetime", "serial", "julian", "jd", "mjd")
ROUND = 1e-4  # relative distance within which a period is a number of two digits
# Seconds since 1970 in smaller units have so many digits: what a unit is without a name.
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
EPOCH_S = (6.3e8, 4.1e9)  # seconds since 1970, of the years 1990 to 2099
MAYBE_DAYS = "no unit: taken for days, as a spreadsheet counts them, though it may be seconds"

Times = Float[np.ndarray, "T"]


def parse_calendar_numbers(title: str, times: Times) -> tuple[Times, str] | None:
    """Convert dates that a log stores as plain numbers to seconds since the first date, and name
    the number format."""
    finite = times[np.isfinite(times)]
    if len(finite) < 2:
        return None
    seconds = parse_digit_dates(times)
    if seconds is not None:
        return seconds, "digits of a date"
    words = describe_day_numbers(title, finite)
    if words:
        days_since_first = times - finite[0]
        return DAY_S * days_since_first, words
    sizes = np.abs(finite)
    largest = float(sizes.max())
    for digits, unit_s in EPOCHS:
        if largest >= digits and np.ptp(finite) < 0.1 * largest:
            units_since_first = times - finite[0]
            return unit_s * units_since_first, f"units of {unit_s:g} s since 1970"
    return None


def are_unix_times(times: Times) -> bool:
    """Whether increasing numbers are Unix times, counted since 1970 in seconds or a smaller
    unit."""
    finite = times[np.isfinite(times)]
    if len(finite) < 3 or finite.min() <= 0:
        return False
    largest = float(finite.max())
    units_s = [unit_s for digits, unit_s in EPOCHS if largest >= digits]
    unit_s = units_s[0] if units_s else 1.0
    earliest_s, latest_s = EPOCH_S
    smallest = finite.min()
    in_range = earliest_s <= unit_s * smallest and unit_s * largest <= latest_s
    are_recent = in_range and np.ptp(finite) < 0.1 * largest
    return bool(are_recent)


def parse_digit_dates(times: Times) -> Times | None:
    """Convert dates written as whole numbers, such as `20260305100000`, to seconds since the first;
    None for other numbers."""
    finite = times[np.isfinite(times)]
    rounded = np.round(finite)
    is_whole = np.array_equal(finite, rounded)
    smallest = 10 ** (min(DIGITS) - 1)
    if not is_whole or finite.min() < smallest:
        return None
    whole = finite.astype(np.int64)
    count = len(str(whole[0]))
    thousandths = np.zeros(len(whole))
    if count == MILLISECOND_DIGITS:
        thousandths = (whole % 1000) / 1000.0
        whole = whole // 1000
        count -= 3
    if count not in DIGITS:
        return None
    texts = whole.astype(str)
    digits = pd.Series(texts)
    dates = pd.to_datetime(digits, format=DIGITS[count], errors="coerce")
    years = dates.dt.year
    missing_dates = dates.isna()
    if missing_dates.any() or not years.between(*YEARS).all():
        return None
    elapsed = dates - dates.iloc[0]
    since = elapsed / pd.Timedelta(seconds=1)
    seconds = np.full(len(times), np.nan)
    seconds[np.isfinite(times)] = since.to_numpy(dtype=float) + thousandths
    return seconds


def describe_day_numbers(title: str, numbers: Times) -> str:
    """Description of the calendar from which numbers count days, as in a spreadsheet; empty for
    numbers that are no days.

    The title says so, or the time step is a round number of seconds only if the numbers count days.
    """
    low = float(numbers.min())
    high = float(numbers.max())
    calendars = (first <= low and high <= last for first, last in DAY_COUNTS)
    if not any(calendars):
        return ""
    lower_title = title.lower()
    words = lower_title.replace("_", " ").split()
    if any(word in DAY_WORDS for word in words):
        return "days, as a spreadsheet counts them"
    steps = np.diff(numbers)
    rising = steps[steps > 0]
    if not len(rising):
        return ""
    step = float(np.median(rising))
    are_days = has_at_most_two_significant_digits(DAY_S * step)
    return MAYBE_DAYS if are_days and not has_at_most_two_significant_digits(step) else ""


def has_at_most_two_significant_digits(number: float) -> bool:
    """Whether a positive number has at most two significant digits, up to rounding."""
    rounded = float(f"{number:.2g}")
    return abs(rounded - number) <= ROUND * number
