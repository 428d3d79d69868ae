"""Single-sine experiments where a loop is most sensitive, for a mismatch that a broadband record
hides.

A loop that swings does so at one frequency, near a peak of `|T_ue|`, at an amplitude of its own. A
broadband record spreads its power over all lines and jitters a steep static curve, so the gain that
one sine meets there may never show. Here one line has the whole power: of two periods `E_1, E_2` at
that line

    g = sqrt(max(Re(E_1 conj E_2), 0) + LIMIT se) / |U|,    se^2 = S_n^2 / 2 + S_n Re(E_1 conj E_2)

is the upper limit of the mismatch gain, so what noise hides is not zero. Where it exceeds what the
record of the nearest amplitude shows in this band, it replaces that, and the excess counts as
remainder: its phase is not used. Source: docs/trust.md, "What is measured for it".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.frequency import frequency_response
from ssm_study.models.structured import Model
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.record_errors import RecordErrors, View
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    largest_singular_values,
    sensitivity,
    slope_combinations,
)
from ssm_study.signals import Trajectories
from ssm_study.systems import Balls, Gains

LIMIT = 2.0  # standard errors added to what repeats
PEAKS = 2  # frequencies at most
FEWEST_LINES = 4  # periods of the sine in one period of the record, at least


@dataclass(frozen=True, kw_only=True)
class SineMismatch:
    """Mismatch measured with a single sine. Upper limit `gain` of the mismatch over the input at
    one `angle` (rad/sample) and one `amplitude`, the input's rms (scaled)."""

    angle: float
    amplitude: float
    gain: float


def peak_lines(model: Model, pair: Gains, balls: Balls, period: int) -> list[int]:
    """Frequencies, as lines of a period, at which the loop is most sensitive to model errors."""
    size = np.zeros(len(FINE_ANGLES))
    for end in slope_combinations(model.system, pair, balls):
        response = frequency_response(sensitivity(*end), FINE_ANGLES)
        size = np.maximum(size, largest_singular_values(response))
    padded = np.concatenate([[0.0], size, [0.0]])
    is_peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])
    peaks = np.flatnonzero(is_peak)
    lines: list[int] = []
    for peak in peaks[np.argsort(-size[peaks])]:
        line = int(np.rint(FINE_ANGLES[peak] * period / (2 * np.pi)))
        line = min(max(line, FEWEST_LINES), period // 2 - 1)
        if line not in lines:
            lines.append(line)
    return sorted(lines[:PEAKS])


def measure_sine(errors: RecordErrors, noise: Float[np.ndarray, "F"], period: int) -> SineMismatch:
    """Mismatch at the strongest line of the last two periods of a record. `noise` is a sample's
    power in each band."""
    start = len(errors.u) - 2 * period
    steady = replace(errors, start=start, period=period)
    drive = (np.abs(steady.periods(errors.u)[1]) ** 2).sum(axis=1)
    line = 1 + int(drive[1:].argmax())
    angle = 2 * np.pi * line / period
    first, second = steady.periods(errors.e)[:, line]
    repeats = max(float((first * second.conj()).real.sum()), 0.0)
    noise_power = period * float(np.interp(angle, ANGLES, noise))
    error = np.sqrt(noise_power**2 / 2 + noise_power * repeats)
    return SineMismatch(
        angle=float(angle),
        amplitude=float(np.sqrt((errors.u[start:] ** 2).mean())),
        gain=float(np.sqrt((repeats + LIMIT * error) / drive[line])),
    )


def measure_sine_mismatch(
    model: Model, records: Trajectories, mismatch: Mismatch, period: int
) -> list[SineMismatch]:
    """Measure the mismatch at the sine's frequency in each single-sine record."""
    noise = np.array(mismatch.noise)
    return [
        measure_sine(RecordErrors.from_record(model, record, 0), noise, period)
        for record in records
    ]


def add_sines(mismatch: Mismatch, sines: Sequence[SineMismatch]) -> Mismatch:
    """Mismatch of the broadband records, raised where single sines measured more. Sines well below
    the smallest amplitude get one of their own, which else equals the smallest one's."""
    views = list(mismatch.views)
    smallest = views[0]
    below = [sine for sine in sines if sine.amplitude < smallest.amplitude / 2]
    if below:
        amplitude = min(sine.amplitude for sine in below)
        views.insert(0, replace(smallest, amplitude=amplitude))
    for sine in sines:
        distances = [abs(np.log(sine.amplitude / view.amplitude)) for view in views]
        nearest = int(np.argmin(distances))
        views[nearest] = add_sine(views[nearest], sine)
    return replace(mismatch, views=tuple(views))


def add_sine(view: View, sine: SineMismatch) -> View:
    """Mismatch at one amplitude, raised near the frequency of a sine that measured more."""
    above = int(np.searchsorted(ANGLES, sine.angle))
    bands = [max(above - 1, 0), min(above, len(ANGLES) - 1)]
    shown = float(np.interp(sine.angle, ANGLES, view.by_frequency))
    if sine.gain <= shown:
        return view
    by_frequency = view.by_frequency.copy()
    remainder = view.rest.copy()
    excess = np.sqrt(sine.gain**2 - shown**2)
    by_frequency[bands] = np.maximum(by_frequency[bands], sine.gain)
    remainder[bands] = np.maximum(remainder[bands], np.hypot(remainder[bands], excess))
    return replace(view, by_frequency=by_frequency, rest=remainder)
