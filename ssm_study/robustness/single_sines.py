"""Model error measured with a single sine, which puts the whole power of a record at one frequency.

Of two periods `E_1, E_2` at that line

    g = sqrt(max(Re(E_1 conj E_2), 0) + LIMIT se) / |U|,    se^2 = S_n^2 / 2 + S_n Re(E_1 conj E_2)

is the upper limit of the mismatch gain, so what noise hides is not zero. Where it exceeds what the
record of the nearest amplitude shows in this band, it replaces that, and the excess counts as
remainder: its phase is not used. Source: docs/trust.md, "What is measured for it".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude, RecordErrors

LIMIT = 2.0  # standard errors added to what repeats
SINGLE = 0.99  # share of the power in one line, of a sine
SAME = 1e-9  # of a sine's range, by which two of its cycles may differ


@dataclass(frozen=True, kw_only=True)
class SineMismatch:
    """Model error measured with a single sine at one frequency and amplitude. `gain` is an upper
    limit of error over input at one `angle` (rad/sample) and one `amplitude`, the input's rms
    (scaled).

    The powers are over the input's at that line: of the error that repeats, of the model's output,
    their `cross` power (real part) and of the noise. They are None where an earlier version stored
    the gain alone.
    """

    angle: float
    amplitude: float
    gain: float
    error_power: float | None = None
    model_power: float | None = None
    cross_power: float | None = None
    noise_power: float | None = None


def has_single_sine_input(record_errors: RecordErrors) -> bool:
    """Whether the periodic part of a record's input has nearly all its power at one frequency."""
    if record_errors.period is None:
        return False
    drive = _input_power_at_lines(record_errors)[1:]
    total = drive.sum()
    return bool(drive.max() >= SINGLE * total)


def _input_power_at_lines(record_errors: RecordErrors) -> Float[np.ndarray, "L"]:
    """Power of a record's input at each spectral line, in the second of two equal periods."""
    _, second_period = record_errors.period_spectra(record_errors.u)
    power = np.abs(second_period) ** 2
    return np.asarray(power.sum(axis=1))


def steady_sine_errors(records: Sequence[RecordErrors]) -> list[RecordErrors]:
    """Model errors in the steady state of those records whose input is a single sine. Their period
    is such that a third of the sine remains for settling."""
    sines = []
    for errors in records:
        if not has_single_sine_input(errors):
            continue
        assert errors.period is not None
        drive = _input_power_at_lines(errors)[1:]
        cycles = 1 + int(drive.argmax())
        cycle = errors.period // cycles
        is_elsewhere = errors.u != errors.u[-1]
        is_moving = is_elsewhere.any(axis=1)
        moving_samples = np.flatnonzero(is_moving)
        first = int(moving_samples[0])
        end = int(moving_samples[-1]) + 1
        wave = errors.u[first:end]
        differences = np.abs(wave[cycle:] - wave[:-cycle])
        largest_difference = differences.max()
        cycles_of_wave = (len(wave) + 1) // cycle
        period = cycle * (cycles_of_wave // 3)
        if not period or largest_difference > SAME * np.ptp(wave):
            continue  # a piece of a log that also moves otherwise
        cut = {name: getattr(errors, name)[:end] for name in ("moving", "u", "model", "e")}
        start = end - 2 * period
        last_two_periods = replace(errors, **cut, start=start, period=period)
        sines.append(last_two_periods)
    return sines


def measure_error_at_sine(
    record_errors: RecordErrors, noise: Float[np.ndarray, "F"]
) -> SineMismatch:
    """Measure the model error of a record with two equal periods at the frequency where its input
    is strongest. `noise` is a sample's power in each band."""
    assert record_errors.period is not None
    drive = _input_power_at_lines(record_errors)
    line = 1 + int(drive[1:].argmax())
    angle = 2 * np.pi * line / record_errors.period
    noise_of_sample = float(np.interp(angle, ANGLES, noise))
    noise_power = record_errors.period * noise_of_sample
    input_power = float(drive[line])
    powers = _powers_at_spectral_line(record_errors, line)
    relative_powers = {name: power / input_power for name, power in powers.items()}
    relative_noise = noise_power / input_power
    repeats = max(relative_powers["error_power"], 0.0)
    variance = relative_noise**2 / 2 + relative_noise * repeats
    standard_error = np.sqrt(variance)
    upper_limit = repeats + LIMIT * standard_error
    gain = np.sqrt(upper_limit)
    wave = record_errors.u[record_errors.start :]
    amplitude = np.sqrt((wave**2).mean())
    return SineMismatch(
        angle=float(angle),
        amplitude=float(amplitude),
        gain=float(gain),
        noise_power=relative_noise,
        **relative_powers,
    )


def _powers_at_spectral_line(record_errors: RecordErrors, spectral_line: int) -> dict[str, float]:
    """Powers of model error and model output at one spectral line, and the real part of the cross
    power of both."""
    error_spectra = record_errors.period_spectra(record_errors.e)
    model_spectra = record_errors.period_spectra(record_errors.model)
    first, second = error_spectra[:, spectral_line]
    model = model_spectra[1, spectral_line]
    product = first * second.conj()
    repeating = product.real
    mean_error = (first + second) / 2
    cross_spectrum = mean_error * model.conj()
    cross = cross_spectrum.real
    model_powers = np.abs(model) ** 2
    return {
        "error_power": float(repeating.sum()),
        "model_power": float(model_powers.sum()),
        "cross_power": float(cross.sum()),
    }


def add_sine_errors(
    errors_by_amplitude: Sequence[ModelErrorAtAmplitude], sines: Sequence[SineMismatch]
) -> tuple[ModelErrorAtAmplitude, ...]:
    """Add model errors measured with single sines to the recorded model errors at the nearest input
    amplitude. Sines well below the smallest amplitude get an entry of their own, which otherwise
    equals the smallest amplitude's."""
    raised = list(errors_by_amplitude)
    smallest = raised[0]
    below = [sine for sine in sines if sine.amplitude < smallest.amplitude / 2]
    if below:
        amplitude = min(sine.amplitude for sine in below)
        raised.insert(0, replace(smallest, amplitude=amplitude))
    for sine in sines:
        ratios = [sine.amplitude / view.amplitude for view in raised]
        distances = [abs(np.log(ratio)) for ratio in ratios]
        nearest = int(np.argmin(distances))
        raised[nearest] = increase_gain_near_sine(raised[nearest], sine)
    return tuple(raised)


def increase_gain_near_sine(
    amplitude_error: ModelErrorAtAmplitude, sine: SineMismatch
) -> ModelErrorAtAmplitude:
    """Increase the recorded gain of the model error near a single sine's frequency to the gain
    measured with the sine, if that is larger."""
    above = int(np.searchsorted(ANGLES, sine.angle))
    band_below = max(above - 1, 0)
    band_above = min(above, len(ANGLES) - 1)
    bands = [band_below, band_above]
    recorded_gain = float(np.interp(sine.angle, ANGLES, amplitude_error.by_frequency))
    if sine.gain <= recorded_gain:
        return amplitude_error
    by_frequency = amplitude_error.by_frequency.copy()
    remainder = amplitude_error.rest.copy()
    excess = np.sqrt(sine.gain**2 - recorded_gain**2)
    by_frequency[bands] = np.maximum(by_frequency[bands], sine.gain)
    recorded_remainder = remainder[bands]
    with_excess = np.hypot(recorded_remainder, excess)
    remainder[bands] = np.maximum(recorded_remainder, with_excess)
    return replace(amplitude_error, by_frequency=by_frequency, rest=remainder)
