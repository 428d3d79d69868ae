"""Estimation of the sampling time of a clock whose times were rounded to few digits.

A time `t_k` that was rounded to a multiple of `q_k` lies within `q_k / 2` of the instant it stands
for, one that was cut off within `q_k`. An even clock `t_0 + k h` explains the column where it keeps
to all of these intervals, so the smallest and the largest possible `h` are two linear programs in
`(t_0, h)`.
"""

from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

ClockTimes = Float[np.ndarray, "T"]

# Relative half width of the possible periods up to which the period is taken as known.
SURE_PERIOD = 1e-3
ROUNDED = 0.6  # of the last digit: half of it, and a second rounding
CUT_OFF = 1.0  # of the last digit
FEWEST_REPEATS = 3  # of a time: one that stands twice may be a row that was written twice
DIGITS = 12  # of a written time; the rest is arithmetic


def estimate_period_s(time_s: ClockTimes) -> tuple[float, float] | None:
    """Estimate the sampling period from times that were rounded to few digits, and the relative
    uncertainty of the estimate.

    The period is the shortest decimal number among the possible ones. None where no even clock
    explains the times, or clocks of clearly different periods do.
    """
    repeats = int((np.diff(time_s) == 0).sum())
    if 0 < repeats < FEWEST_REPEATS:
        return None
    for share in (ROUNDED, CUT_OFF):
        possible_s = period_bounds_s(time_s, share * resolution_of_times(time_s))
        if possible_s is not None and possible_s[0] > 0.0:
            uncertainty = 0.5 * (possible_s[1] - possible_s[0]) / possible_s[0]
            return (
                (shortest_decimal_between(*possible_s), uncertainty)
                if uncertainty <= SURE_PERIOD
                else None
            )
    return None


def period_bounds_s(time_s: ClockTimes, tolerance_s: ClockTimes) -> tuple[float, float] | None:
    """Smallest and largest sampling period of an even clock that stays within a tolerance of all
    recorded times; None if there is none."""
    rows = len(time_s) - 1
    span_s = float(time_s[-1] - time_s[0])
    scaled = (time_s - time_s[0]) / span_s
    errors = tolerance_s / span_s
    progress = np.arange(rows + 1) / rows
    clock = np.stack([np.ones(rows + 1), progress], axis=1)
    bounds = np.concatenate([errors + scaled, errors - scaled])
    limits_s = []
    for sign in (1.0, -1.0):
        solution: Any = scipy.optimize.linprog(
            [0.0, sign], A_ub=np.vstack([clock, -clock]), b_ub=bounds, bounds=(None, None)
        )
        if not solution.success:
            return None
        limits_s.append(float(solution.x[1]) * span_s / rows)
    return min(limits_s), max(limits_s)


def resolution_of_times(time_s: ClockTimes) -> ClockTimes:
    """Resolution of recorded times: the place value of the last digit of each time as written.

    A time of less than 1e-12 of the largest is arithmetic, and counts as zero.
    """
    smallest_s = 10.0**-DIGITS * np.abs(time_s).max()
    time_s = np.where(np.abs(time_s) < smallest_s, 0.0, time_s)
    written = [f"{time:.{DIGITS}g}" for time in time_s]
    decimals = max(decimal_places(text) for text in written)
    digits = max(significant_digits(text) for text in written)
    sizes = np.maximum(np.abs(time_s), 10.0**-decimals)
    magnitude = np.floor(np.log10(sizes))
    return np.maximum(10.0**-decimals, 10.0 ** (magnitude - digits + 1))


def decimal_places(number: str) -> int:
    """Number of digits behind the decimal point of a number given as text."""
    mantissa, _, exponent = number.partition("e")
    behind = len(mantissa.partition(".")[2])
    return max(behind - int(exponent or 0), 0)


def significant_digits(number: str) -> int:
    """Number of significant digits of a number given as text."""
    mantissa = number.partition("e")[0]
    return len(mantissa.replace(".", "").lstrip("-0").rstrip("0"))


def shortest_decimal_between(low: float, high: float) -> float:
    """Number in an interval that can be written with the fewest digits."""
    middle = 0.5 * (low + high)
    for digits in range(1, DIGITS + 1):
        number = float(f"{middle:.{digits}g}")
        if low <= number <= high:
            return number
    return middle
