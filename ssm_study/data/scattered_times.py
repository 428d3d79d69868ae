"""Sampling time of a clock whose written times scatter around evenly spaced ones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.data.rounded_times import shortest_decimal_between

ClockTimes = Float[np.ndarray, "T"]

SCATTERS = 0.5  # periods beside an even clock, within which a time belongs to one row alone
WANDERS = 0.3  # correlation of a deviation with the one before, from which on a clock wanders
STANDARD_ERRORS = 3.0  # on both sides of a period


@dataclass(frozen=True, kw_only=True)
class ScatteredClock:
    """Sampling period of a clock whose recorded times scatter around even spacing, and their
    largest deviation in periods."""

    period_s: float
    largest: float


def find_scattered_clock(
    time_s: ClockTimes, stretches: list[tuple[int, int]]
) -> ScatteredClock | None:
    """Find evenly spaced times around which the recorded times of a log scatter without drift; None
    if there are none. None if there is none.

    Lines with one slope `h` are fitted to the times of all stretches. Every time must lie within
    half a period of its line, and a deviation must say nothing about the next one: a clock that
    wanders or jumps is late for many rows on end.
    """
    if not stretches:
        return None
    centred_rows = []
    centred_times = []
    for first, end in stretches:
        count = end - first
        centre = (count - 1) / 2
        centred_rows.append(np.arange(count) - centre)
        stretch = time_s[first:end]
        centred_times.append(stretch - stretch.mean())
    rows = np.concatenate(centred_rows)
    times = np.concatenate(centred_times)
    power = float(rows @ rows)
    period_s = float(rows @ times) / power
    deviations = times - period_s * rows
    scatter_s = float(deviations.std())
    largest = float(np.abs(deviations).max()) / period_s
    if largest >= SCATTERS or scatter_s == 0.0:
        return None
    following = float((deviations[1:] * deviations[:-1]).mean()) / scatter_s**2
    if following > WANDERS:
        return None
    uncertainty_s = STANDARD_ERRORS * scatter_s / np.sqrt(power)
    plain_s = shortest_decimal_between(period_s - uncertainty_s, period_s + uncertainty_s)
    return ScatteredClock(period_s=plain_s, largest=largest)
