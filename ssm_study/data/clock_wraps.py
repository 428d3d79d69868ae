"""Correction of clocks that step back because a counter overflows or summer time ends.

A counter of 16 or 32 bits begins again at zero; local time repeats an hour in autumn. Both are
corrected only if the clock then continues at its own period; no other backward step is.
"""

import numpy as np
from jaxtyping import Float

COUNTERS = (2**8, 2**15, 2**16, 2**24, 2**31, 2**32)
HOUR_S = 3600.0
NEAR = 0.5  # of the period: how far a step may be off where a clock is continued
FEWEST = 10  # times, of which a period is the median

Times = Float[np.ndarray, "T"]
Steps = Float[np.ndarray, "_"]


def unwrap_clock(times: Times, *, is_dated: bool) -> tuple[Times, str]:
    """Correct times that jump back because a counter overflowed or summer time ended, and describe
    the correction."""
    if len(times) < FEWEST or not np.isfinite(times).all():
        return times, ""
    steps = np.diff(times)
    rising = steps[steps > 0]
    falls_or_rests = (steps <= 0).any()
    if not falls_or_rests or not len(rising):
        return times, ""
    period = float(np.median(rising))
    if is_dated:
        return _undo_summer_time(times, steps, period)
    is_back = steps < 0
    for size in COUNTERS:
        lowest = times.min()
        fits = lowest >= 0 and times.max() < size
        wrapped = steps[is_back] + size
        if fits and is_back.any() and _one_period_mask(wrapped, period).all():
            turn_counts = np.cumsum(is_back)
            turns = np.concatenate([[0], turn_counts])
            bits = int(size).bit_length() - 1
            return times + size * turns, f"a counter of {bits} bits began again"
    return times, ""


def _undo_summer_time(times: Times, steps: Steps, period: float) -> tuple[Times, str]:
    """Add an hour to all times after each backward jump that the end of summer time explains."""
    is_back = (steps <= 0) & (period <= HOUR_S)
    later = steps[is_back] + HOUR_S
    goes_back = is_back.any()
    if not goes_back or not _one_period_mask(later, period).all():
        return times, ""
    hour_counts = np.cumsum(is_back)
    hours = np.concatenate([[0], hour_counts])
    first_back = np.argmax(is_back)
    row = int(first_back) + 1
    return times + HOUR_S * hours, f"an hour stands twice at row {row}: end of summer time"


def _one_period_mask(steps: Steps, period: float) -> np.ndarray:
    """For each time difference, whether it is as long as one sampling period."""
    deviation = np.abs(steps - period)
    return deviation <= NEAR * period
