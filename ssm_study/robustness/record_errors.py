"""Errors of the model in one record, and the model error that they show at one amplitude of the
input.

Two periods of one input tell what repeats from noise; of an input that does not repeat there are
Welch's averages, in which noise counts as mismatch; a trial in closed loop has its own rule.
Source: docs/trust.md, "What is measured for it".
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.models.metrics import simulate_record
from ssm_study.models.structured import Model
from ssm_study.robustness.bands import (
    ANGLES,
    band_means,
    safe_ratio,
    sort_lines_into_bands,
    total_power,
    welch_power_density,
)
from ssm_study.robustness.return_to_rest import SURE, is_return_to_rest, oscillation_amplitude
from ssm_study.signals import Trajectories, Trajectory, find_repetition

# A band with less than this share of the input's mean power is not excited: g is measured there,
# and uncertain.
EXCITED = 0.01
# quantile of the bands of e that is taken for white noise in a closed loop where no record measured
# it
QUIET = 0.25
# share, and most samples, of a trial in closed loop that only tell its initial state
IN_LOOP = (1 / 3, 300)
# share of the output's scale by which it swings in the last quarter of a loop that does not come to
# rest
MOVING = 0.05
BLOCKS = 8  # pieces of the largest record, whose scatter tells how far its gain is known
Spectra = tuple[
    Complex[np.ndarray, "2 K p"], Complex[np.ndarray, "K m"], Complex[np.ndarray, "K p"]
]


@dataclass(frozen=True, kw_only=True)
class View:
    """Model error in the records of one input amplitude. See the module for `linear` (Q) and
    `rest`, both at `ANGLES`.

    `amplitude` is the input's rms; `response` the output's power over the model's, one where they
    agree, zero where the plant holds still.
    """

    amplitude: float
    gain: float
    by_frequency: Float[np.ndarray, "F"]
    linear: Complex[np.ndarray, "F"]
    rest: Float[np.ndarray, "F"]
    response: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RecordErrors:
    """Free-run errors of the model on one record: scaled input, model output and error. `period`
    samples repeat from `start`, twice. `moving`: the input, and measured disturbances beside it;
    `name` tells the record by its input's rms."""

    name: str
    moving: Float[np.ndarray, "T j"]
    u: Float[np.ndarray, "T m"]
    model: Float[np.ndarray, "T p"]
    e: Float[np.ndarray, "T p"]
    start: int = 0
    period: int | None = None

    @classmethod
    def from_record(cls, model: Model, record: Trajectory, start_up_samples: int) -> "RecordErrors":
        """Simulate the model on a record and collect its scaled errors."""
        simulated = simulate_record(model, record, start_up_samples)
        scored = slice(start_up_samples, None)
        start, period = find_repetition(record.inputs_and_disturbances[scored]) or (0, None)
        moving = model.scale.with_disturbances_as_inputs().scaled_input(
            record.inputs_and_disturbances
        )
        scaled_input = model.scale.scaled_input(record.u)
        error = (record.y - simulated) / model.scale.output_scale
        return cls(
            name=f"input of rms {np.sqrt((scaled_input**2).mean()):.2g}",
            moving=moving[scored],
            u=scaled_input[scored],
            model=model.scale.scaled_output(simulated)[scored],
            e=error[scored],
            start=start,
            period=period,
        )

    @property
    def output(self) -> Float[np.ndarray, "T p"]:
        """Measured output in scaled units."""
        return self.e + self.model

    @property
    def amplitude(self) -> float:
        """Root mean square of the input."""
        return float(np.sqrt((self.u**2).mean()))

    def strength(self) -> float:
        """Mean square of the input."""
        return float((self.u**2).mean())

    def spread(self) -> float:
        """Standard error of the logarithm of a record's gain from input to model error, from pieces
        of the record."""
        errors = np.array_split(self.e, BLOCKS)
        inputs = np.array_split(self.u, BLOCKS)
        ratios = []
        for e, u in zip(errors, inputs, strict=True):
            if np.any(u) and np.any(e):
                ratios.append(float((e**2).sum() / (u**2).sum()))
        if len(ratios) < 2:
            return 0.0
        standard_error = np.std(np.log(ratios)) / np.sqrt(len(ratios))
        return 0.5 * float(standard_error)  # half: of g, not of g^2

    def periods(self, signal: Float[np.ndarray, "T c"]) -> Complex[np.ndarray, "2 L c"]:
        """Fourier transforms of both periods of a signal."""
        assert self.period is not None
        pieces = signal[self.start : self.start + 2 * self.period]
        return np.asarray(np.fft.rfft(pieces.reshape(2, self.period, -1), axis=1))

    def spectra(self) -> Spectra:
        """Fourier transforms of both periods of the error, and of input and model output in the
        second period."""
        return self.periods(self.e), self.periods(self.u)[1], self.periods(self.model)[1]


def open_loop_errors(
    model: Model, validation: Trajectories, trials: Trajectories, start_up_samples: int
) -> list[RecordErrors]:
    """Errors of the model in every record in open loop, except records that return to a constant
    input."""
    records = [*validation]
    for trial in trials:
        if not trial.closed_loop and not is_return_to_rest(trial):
            records.append(trial)
    return [RecordErrors.from_record(model, record, start_up_samples) for record in records]


def moving_loop_errors(
    model: Model, trials: Trajectories, start_up_samples: int
) -> list[RecordErrors]:
    """Errors of the model in closed-loop records that keep moving, without start-up samples."""
    loops = []
    for trial in trials:
        if trial.closed_loop:
            errors = RecordErrors.from_record(
                model, trial, unscored_samples(trial, start_up_samples)
            )
            if errors.u.any() and oscillation_amplitude(errors.output) > MOVING:
                loops.append(errors)
    return loops


def unscored_samples(trial: Trajectory, start_up_samples: int) -> int:
    """Number of samples at the beginning of a closed-loop record by which its initial state is
    estimated. It is a third, `IN_LOOP` at most."""
    return max(start_up_samples, min(int(IN_LOOP[0] * len(trial)), IN_LOOP[1]))


def mismatch_from_averages(records: list[RecordErrors]) -> View:
    """Model error from records whose input does not repeat, by averaged spectra. Noise counts as
    model error, and no linear part is separated."""
    inputs = [record.u for record in records]
    errors = [record.e for record in records]
    input_energy = float(sum((u**2).sum() for u in inputs))
    error_energy = float(sum((e**2).sum() for e in errors))
    power_u = welch_power_density(inputs)
    power_e = welch_power_density(errors)
    bands = np.linspace(0, np.pi, len(power_u))
    without_input = np.where(power_e > 0, np.inf, 0.0)
    ratio = np.divide(power_e, power_u, out=without_input, where=power_u > 0)
    by_frequency = np.interp(ANGLES, bands, np.sqrt(ratio))
    return _mismatch_from_total_gain(
        records, by_frequency, float(np.sqrt(error_energy / input_energy))
    )


def _mismatch_from_total_gain(
    records: list[RecordErrors], resolved: Float[np.ndarray, "F"], gain: float
) -> View:
    """Model error at one amplitude from records that show only its gain over all frequencies
    together."""
    amplitude = float(np.sqrt(np.mean(np.concatenate([r.u for r in records]) ** 2)))
    linear = np.zeros(len(ANGLES), dtype=complex)
    return View(amplitude=amplitude, gain=gain, by_frequency=resolved, linear=linear, rest=resolved)


def mismatch_in_closed_loop(
    records: list[RecordErrors], noise: Float[np.ndarray, "F"] | None
) -> View:
    """Largest model error in any closed-loop record. A mean would hide a small one behind a large
    one."""
    gains = [_closed_loop_gains(record, noise) for record in records]
    by_frequency = np.max([resolved for resolved, _ in gains], axis=0)
    total = max(gain for _, gain in gains)
    return _mismatch_from_total_gain(records, by_frequency, total)


def _closed_loop_gains(
    record: RecordErrors, noise: Float[np.ndarray, "F"] | None
) -> tuple[Float[np.ndarray, "F"], float]:
    """Gain from input to model error in a closed-loop record, by frequency and in total, beyond the
    noise.

    Where no record measured the noise it is taken for white, as strong as e in its quietest bands.
    Welch's average over N samples has the relative error `sqrt(1.06 L / 2 N)`, L the segment
    (Hann's window, half overlapping); by frequency the gain is raised by as many of them, since
    what a loop that failed shows must refute it.
    """
    power_u = welch_power_density([record.u])
    power_e = welch_power_density([record.e])
    bands = np.linspace(0, np.pi, len(power_u))
    samples = len(record.u)
    sides = np.where((bands > 0) & (bands < np.pi), 2.0, 1.0)  # Welch's density has one side
    if noise is None:
        one_sided = np.quantile(power_e[1:-1], QUIET) / 2
    else:
        one_sided = samples * np.interp(bands, ANGLES, noise)
    noise_power = sides * one_sided
    largest_share = 1 + SURE * np.sqrt(1.06 * len(power_u) / samples)
    counted = np.maximum(power_e - largest_share * noise_power, 0.0)
    gains = np.sqrt(safe_ratio(largest_share * counted, power_u))
    total_gain = float(np.sqrt(counted.sum() / power_u.sum()))
    return np.interp(ANGLES, bands, gains), total_gain


def estimate_noise(records: list[RecordErrors]) -> Float[np.ndarray, "F"]:
    """Noise power in each frequency band, from the difference of repeated periods. It is the same
    at all amplitudes, so that the median over the records is used."""
    powers = []
    for record in records:
        first, second = record.spectra()[0]
        powers.append(band_means(total_power(first - second) / 2) / record.period)
    return np.asarray(np.median(powers, axis=0))


def mismatch_from_periods(record: RecordErrors, sure: bool, noise: Float[np.ndarray, "F"]) -> View:
    """Model error from a record with two equal periods, whose difference is noise. With two periods
    `E_1, E_2`, `Re(E_1 conj E_2)` is the power that repeats, without bias: noise is independent.

    In a band that the input does not excite nothing is subtracted: the gain is the one measured,
    noise included. Averaged over the M lines of a band its variance is `(S_n^2 / 2 + S_n S_e) / M`.
    Below the largest amplitude only what exceeds `SURE` of its standard deviations counts.
    """
    both, drive, model = record.spectra()
    first, second = both
    noise_power = noise * record.period
    _, lines = sort_lines_into_bands(len(drive))
    power_u = band_means(total_power(drive))
    power_model = band_means(total_power(model))
    repeats = band_means((first * second.conj()).real.sum(axis=1))  # noise averages out, see above
    doubt: Any = 0.0
    if not sure:
        variance = (noise_power**2 / 2 + noise_power * np.maximum(repeats, 0.0)) / lines
        doubt = SURE * np.sqrt(variance)
    linear = _linear_part((first + second) / 2, model)
    least = (1 + (0.0 if sure else SURE**2)) * noise_power / 2 / lines
    is_known = power_model * np.abs(linear) ** 2 > least
    is_scalar = (record.e.shape[1] == 1) & (record.u.shape[1] == 1)
    linear = np.where(is_known & is_scalar, linear, 0.0)
    explained = power_model * np.abs(linear) ** 2
    whole = np.maximum(repeats - doubt, 0.0)
    rest = np.maximum(repeats - explained - doubt, 0.0)
    # Little or no input: by chance nothing repeats there, or anything.
    unexcited = power_u < EXCITED * power_u.mean()
    measured = band_means((total_power(first) + total_power(second)) / 2)
    whole = np.where(unexcited, measured, whole)
    rest = np.where(unexcited, measured, rest)
    linear = np.where(unexcited, 0.0, linear)
    answered = (power_model * np.abs(1 + linear) ** 2 + rest).sum()
    total_gain = np.sqrt(whole.sum() / power_u.sum())
    by_frequency = np.sqrt(safe_ratio(whole, power_u))
    remainder = np.sqrt(safe_ratio(rest, power_u))
    model_power = max(power_model.sum(), np.finfo(float).tiny)
    return View(
        amplitude=record.amplitude,
        gain=float(total_gain),
        by_frequency=by_frequency,
        linear=linear,
        rest=remainder,
        response=float(answered / model_power),
    )


def _linear_part(
    error: Complex[np.ndarray, "K p"], model: Complex[np.ndarray, "K p"]
) -> Complex[np.ndarray, "F"]:
    """Linear part of the model error in each band, `S_(e, y_model) / S_(y_model)`. The error e is
    the mean of both periods, which halves the noise's variance."""
    cross = (error * model.conj()).sum(axis=1)
    banded_cross = band_means(cross.real) + 1j * band_means(cross.imag)
    return safe_ratio(banded_cross, band_means(total_power(model)))
