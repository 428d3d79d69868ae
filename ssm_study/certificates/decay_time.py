"""Time constant of a contraction rate: the time in which distances between trajectories fall to 37
%."""

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
