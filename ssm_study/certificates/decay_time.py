"""Times as texts: the time constant of a contraction rate, in which distances between trajectories
fall to 37 %, and durations from microseconds to days, never in powers of ten."""

import math


def decay_time_text(rate: float, step_s: float | None = None) -> str:
    """Text on the time in which distances fall to 37 % at a contraction rate, rounded up, in
    seconds or in samples.

    Distances are multiplied by at most `sqrt(1 - rate)` each sample, so by `1/e` in `-2 / log(1 -
    rate)` samples. Empty for a rate that is not between zero and one.

    >>> decay_time_text(0.188, 0.01)
    'to 37 % in 0.097 s'
    >>> decay_time_text(0.0004)
    'to 37 % in 5000 samples'
    """
    if not 0 < rate < 1:
        return ""
    samples = -2 / math.log1p(-rate)
    value = samples if step_s is None else samples * step_s
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    rounded_up = math.ceil(value / step - 1e-9) * step
    text = f"{rounded_up:.2g}" if rounded_up < 100 else f"{rounded_up:.0f}"
    return f"to 37 % in {text} {'samples' if step_s is None else 's'}"


def plain_digits(seconds: float) -> str:
    """Three digits of a time in seconds, or all digits before the point.

    >>> plain_digits(0.00314159), plain_digits(66150.0)
    ('0.00314', '66150')
    """
    return f"{seconds:.0f}" if seconds >= 1000 else f"{seconds:.3g}"


def duration_text(seconds: float | None) -> str:
    """Text on a duration, to the millisecond where that is three digits or nearly; a dash for none.

    >>> duration_text(0.0731), duration_text(2.32), duration_text(66150.0), duration_text(5e-5)
    ('0.073 s', '2.320 s', '66150 s', '50 µs')
    """
    if seconds is None:
        return "–"
    if 0 < seconds < 1e-3:
        return f"{1e6 * seconds:.3g} µs"
    to_milliseconds = seconds == 0 or 0.01 <= seconds < 100
    return f"{seconds:.3f} s" if to_milliseconds else f"{plain_digits(seconds)} s"
