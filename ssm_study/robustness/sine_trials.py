"""Single-sine experiments at frequencies where a closed loop is most sensitive to model errors.

A loop that swings does so at one frequency, near a peak of `|T_ue|`, at an amplitude of its own. A
broadband record spreads its power over all lines and jitters a steep static curve, so the gain that
one sine meets there may never show. Source: docs/trust.md, "What is measured for it".
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ssm_study.bounds.frequency import frequency_response
from ssm_study.models.structured import Model
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.margin_by_frequency import margin_curves
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import RecordErrors
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    error_to_input_response,
    largest_singular_values,
    systems_at_constant_slopes,
)
from ssm_study.robustness.single_sines import SineMismatch, add_sine_errors, measure_error_at_sine
from ssm_study.signals import Trajectories
from ssm_study.systems import Gains, JacobianBalls

PEAKS = 2  # frequencies at most
SAME_SINE = 0.1  # relative distance of two frequencies that one sine tests
FEWEST_LINES = 4  # periods of the sine in one period of the record, at least


def peak_frequencies(model: Model, gains: Gains, balls: JacobianBalls) -> list[float]:
    """Frequencies (rad/sample) of the local peaks of the closed loop's gain from an error of the
    output to the input, the largest peak first. The sensitivity is `|T_ue|`."""
    size = np.zeros(len(FINE_ANGLES))
    for end in systems_at_constant_slopes(model.system, gains, balls):
        closed_loop = error_to_input_response(*end)
        response = frequency_response(closed_loop, FINE_ANGLES)
        size = np.maximum(size, largest_singular_values(response))
    padded = np.concatenate([[0.0], size, [0.0]])
    before = padded[:-2]
    after = padded[2:]
    is_peak = (size >= before) & (size > after)
    peaks = np.flatnonzero(is_peak)
    largest_first = peaks[np.argsort(-size[peaks])]
    return [float(angle) for angle in FINE_ANGLES[largest_first]]


def sensitive_spectral_lines(
    model: Model, gains: Gains, balls: JacobianBalls, period: int
) -> list[int]:
    """Spectral lines at which single sines test a closed loop, nearest to the highest peaks of its
    control sensitivity. They are lines of a period, at peaks of `|T_ue|`."""
    lines: list[int] = []
    for angle in peak_frequencies(model, gains, balls):
        line = nearest_spectral_line(angle, period)
        if line not in lines:
            lines.append(line)
    return sorted(lines[:PEAKS])


def line_of_smallest_margin(
    model: Model, pair: Gains, balls: JacobianBalls, mismatch: Mismatch, period: int
) -> int | None:
    """Spectral line nearest to the frequency at which the broadband records give the smallest
    stability margin; None if no margin is known."""
    angle = frequency_of_smallest_margin(model, pair, balls, mismatch)
    if angle is None:
        return None
    return nearest_spectral_line(angle, period)


def frequency_of_smallest_margin(
    model: Model, pair: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> float | None:
    """Frequency (rad/sample) at which the broadband records give the smallest stability margin;
    None if no margin is known. The lowest frequencies, below the first band, are left out: what
    counts there is an offset.

    A loop whose `|T_ue|` is flat may swing far from its peak, where the records show a large model
    error but jitter over a steep curve, so that a single sine meets a larger one.
    """
    gains = np.zeros(len(FINE_ANGLES))
    for curve in margin_curves(model, pair, balls, mismatch):
        if curve.amplitude is not None:
            gains = np.maximum(gains, 1 / curve.margin)
    gains = np.where(ANGLES[1] > FINE_ANGLES, 0.0, gains)
    deciding = int(gains.argmax())
    if gains[deciding] == 0:
        return None
    return float(FINE_ANGLES[deciding])


def frequencies_to_test(
    model: Model, pair: Gains, balls: JacobianBalls, mismatch: Mismatch
) -> tuple[float, ...]:
    """Frequencies (rad/sample) of the single sines that test a design: peaks of the loop's
    sensitivity, and the smallest stability margin. The latter is left out if a peak lies within a
    tenth of it."""
    peaks = peak_frequencies(model, pair, balls)[:PEAKS]
    deciding = frequency_of_smallest_margin(model, pair, balls, mismatch)
    if deciding is None:
        return tuple(peaks)
    for peak in peaks:
        distance = peak / deciding - 1
        if abs(distance) < SAME_SINE:
            return tuple(peaks)
    return (*peaks, deciding)


def nearest_spectral_line(angle: float, period: int) -> int:
    """Spectral line nearest to a frequency in rad/sample, as a number of cycles in the period."""
    line = int(np.rint(angle * period / (2 * np.pi)))
    return min(max(line, FEWEST_LINES), period // 2 - 1)


def measure_errors_at_sines(
    model: Model, records: Trajectories, mismatch: Mismatch, period: int
) -> list[SineMismatch]:
    """Measure the model error in each of several records with a single sine as input, at the
    frequency of the sine."""
    noise = np.array(mismatch.noise)
    sines = []
    for record in records:
        errors = RecordErrors.from_record(model, record, 0)
        start = len(errors.u) - 2 * period
        last_two_periods = replace(errors, start=start, period=period)
        sines.append(measure_error_at_sine(last_two_periods, noise))
    return sines


def add_sines_to_mismatch(mismatch: Mismatch, sines: Sequence[SineMismatch]) -> Mismatch:
    """Add model errors measured with single sines to the model error of broadband records."""
    return replace(mismatch, views=add_sine_errors(mismatch.views, sines))
