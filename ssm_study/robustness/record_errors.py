"""Free-run errors of the model on one record, and the gain from input to model error at one input
amplitude.

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
    assign_lines_to_bands,
    band_means,
    line_powers,
    safe_ratio,
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
InputSignal = Float[np.ndarray, "T m"]
OutputSignal = Float[np.ndarray, "T p"]
InputSpectrum = Complex[np.ndarray, "K m"]
OutputSpectrum = Complex[np.ndarray, "K p"]
BandGains = Float[np.ndarray, "F"]
ComplexBandGains = Complex[np.ndarray, "F"]
Spectra = tuple[Complex[np.ndarray, "2 K p"], InputSpectrum, OutputSpectrum]


@dataclass(frozen=True, kw_only=True)
class ModelErrorAtAmplitude:
    """Model error in all records of one input amplitude, by frequency band. See the module for
    `linear` (Q) and `rest`, both at `ANGLES`.

    `amplitude` is the input's rms; `response` the output's power over the model's, one where they
    agree, zero where the plant holds still.
    """

    amplitude: float
    gain: float
    by_frequency: BandGains
    linear: ComplexBandGains
    rest: BandGains
    response: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RecordErrors:
    """Free-run errors of the model on one record: scaled input, model output and error. `period`
    samples repeat from `start`, twice. `moving`: the input, and measured disturbances beside it;
    `name` tells the record by its input's rms."""

    name: str
    moving: Float[np.ndarray, "T j"]
    u: InputSignal
    model: OutputSignal
    e: OutputSignal
    start: int = 0
    period: int | None = None

    @classmethod
    def from_record(cls, model: Model, record: Trajectory, start_up_samples: int) -> "RecordErrors":
        """Simulate a model in free run on a record and collect its scaled input, output and
        error."""
        simulated = simulate_record(model, record, start_up_samples)
        scored = slice(start_up_samples, None)
        moving = record.inputs_and_disturbances
        start, period = find_repetition(moving[scored]) or (0, None)
        scale = model.scale
        scaled_moving = scale.with_disturbances_as_inputs().scaled_input(moving)
        scaled_input = scale.scaled_input(record.u)
        scaled_output = scale.scaled_output(simulated)
        error = (record.y - simulated) / scale.output_scale
        mean_square = (scaled_input**2).mean()
        return cls(
            name=f"input of rms {np.sqrt(mean_square):.2g}",
            moving=scaled_moving[scored],
            u=scaled_input[scored],
            model=scaled_output[scored],
            e=error[scored],
            start=start,
            period=period,
        )

    @property
    def output(self) -> OutputSignal:
        """Measured output of the record in scaled units."""
        return self.e + self.model

    @property
    def input_rms(self) -> float:
        """Root mean square of the record's input."""
        mean_square = (self.u**2).mean()
        return float(np.sqrt(mean_square))

    def mean_square_input(self) -> float:
        """Mean square of the record's input."""
        mean_square = (self.u**2).mean()
        return float(mean_square)

    def log_gain_standard_error(self) -> float:
        """Standard error of the logarithm of one record's gain from input to model error, estimated
        from blocks of the record."""
        errors = np.array_split(self.e, BLOCKS)
        inputs = np.array_split(self.u, BLOCKS)
        ratios = []
        for e, u in zip(errors, inputs, strict=True):
            if np.any(u) and np.any(e):
                error_energy = (e**2).sum()
                input_energy = (u**2).sum()
                ratios.append(float(error_energy / input_energy))
        if len(ratios) < 2:
            return 0.0
        deviation = np.std(np.log(ratios))
        standard_error = deviation / np.sqrt(len(ratios))
        return 0.5 * float(standard_error)  # half: of g, not of g^2

    def period_spectra(self, signal: Float[np.ndarray, "T c"]) -> Complex[np.ndarray, "2 L c"]:
        """Fourier transforms of a signal over each of the record's two equal periods."""
        assert self.period is not None
        end = self.start + 2 * self.period
        repeating = signal[self.start : end]
        both_periods = repeating.reshape(2, self.period, -1)
        transforms = np.fft.rfft(both_periods, axis=1)
        return np.asarray(transforms)

    def error_spectra(self) -> Spectra:
        """Fourier transforms of the model error in both periods of a record, and of input and model
        output in the second."""
        of_error = self.period_spectra(self.e)
        _, of_input = self.period_spectra(self.u)
        _, of_model = self.period_spectra(self.model)
        return of_error, of_input, of_model


def open_loop_errors(
    model: Model, validation: Trajectories, mismatch_records: Trajectories, start_up_samples: int
) -> list[RecordErrors]:
    """Free-run errors of the model on every open-loop record, except on records that return to a
    constant input."""
    records = [*validation]
    for trial in mismatch_records:
        if not trial.closed_loop and not is_return_to_rest(trial):
            records.append(trial)
    return [RecordErrors.from_record(model, record, start_up_samples) for record in records]


def moving_closed_loop_errors(
    model: Model, mismatch_records: Trajectories, start_up_samples: int
) -> list[RecordErrors]:
    """Free-run errors of the model on closed-loop records whose output keeps moving, without
    start-up samples."""
    loops = []
    for trial in mismatch_records:
        if not trial.closed_loop:
            continue
        unscored = count_initial_state_samples(trial, start_up_samples)
        errors = RecordErrors.from_record(model, trial, unscored)
        if errors.u.any() and oscillation_amplitude(errors.output) > MOVING:
            loops.append(errors)
    return loops


def count_initial_state_samples(record: Trajectory, start_up_samples: int) -> int:
    """Number of samples at the beginning of a closed-loop record that only serve to estimate the
    initial state. It is a third, `IN_LOOP` at most."""
    share, most_samples = IN_LOOP
    unscored = min(int(share * len(record)), most_samples)
    return max(start_up_samples, unscored)


def model_error_from_averages(records: list[RecordErrors]) -> ModelErrorAtAmplitude:
    """Model error by frequency, from Welch's averages over records whose input does not repeat.
    Noise counts as model error, and no linear part is separated."""
    inputs = [record.u for record in records]
    errors = [record.e for record in records]
    input_energies = [(u**2).sum() for u in inputs]
    error_energies = [(e**2).sum() for e in errors]
    input_energy = float(sum(input_energies))
    error_energy = float(sum(error_energies))
    input_power = welch_power_density(inputs)
    error_power = welch_power_density(errors)
    bands = np.linspace(0, np.pi, len(input_power))
    without_input = np.where(error_power > 0, np.inf, 0.0)
    ratio = np.divide(error_power, input_power, out=without_input, where=input_power > 0)
    gains = np.sqrt(ratio)
    by_frequency = np.interp(ANGLES, bands, gains)
    total_gain = float(np.sqrt(error_energy / input_energy))
    return _error_from_total_gain(records, by_frequency, total_gain)


def _error_from_total_gain(
    records: list[RecordErrors], gain_by_frequency: BandGains, total_gain: float
) -> ModelErrorAtAmplitude:
    """Model error at one input amplitude, with its linear part set to zero, from its gain per
    frequency band and its total gain."""
    all_inputs = np.concatenate([record.u for record in records])
    mean_square = np.mean(all_inputs**2)
    amplitude = float(np.sqrt(mean_square))
    linear = np.zeros(len(ANGLES), dtype=complex)
    return ModelErrorAtAmplitude(
        amplitude=amplitude,
        gain=total_gain,
        by_frequency=gain_by_frequency,
        linear=linear,
        rest=gain_by_frequency,
    )


def model_error_in_closed_loop(
    records: list[RecordErrors], noise: BandGains | None
) -> ModelErrorAtAmplitude:
    """Model error by frequency in closed loop, the largest of several records. A mean would hide a
    small one behind a large one."""
    gains = [_closed_loop_gains(record, noise) for record in records]
    resolved_gains = [resolved for resolved, _ in gains]
    by_frequency = np.max(resolved_gains, axis=0)
    total = max(gain for _, gain in gains)
    return _error_from_total_gain(records, by_frequency, total)


def _closed_loop_gains(record: RecordErrors, noise: BandGains | None) -> tuple[BandGains, float]:
    """Gain from input to model error in a closed-loop record, by frequency and in total, with noise
    subtracted.

    Where no record measured the noise it is taken for white, as strong as e in its quietest bands.
    Welch's average over N samples has the relative error `sqrt(1.06 L / 2 N)`, L the segment
    (Hann's window, half overlapping); by frequency the gain is raised by as many of them, since
    what a loop that failed shows must refute it.
    """
    input_power = welch_power_density([record.u])
    error_power = welch_power_density([record.e])
    segment = len(input_power)
    bands = np.linspace(0, np.pi, segment)
    samples = len(record.u)
    is_inner = (bands > 0) & (bands < np.pi)
    sides = np.where(is_inner, 2.0, 1.0)  # Welch's density has one side
    if noise is None:
        inner_bands = error_power[1:-1]
        one_sided = np.quantile(inner_bands, QUIET) / 2
    else:
        one_sided = samples * np.interp(bands, ANGLES, noise)
    noise_power = sides * one_sided
    relative_error = np.sqrt(1.06 * segment / samples)
    largest_share = 1 + SURE * relative_error
    counted = np.maximum(error_power - largest_share * noise_power, 0.0)
    squared_gains = safe_ratio(largest_share * counted, input_power)
    gains = np.sqrt(squared_gains)
    squared_total = counted.sum() / input_power.sum()
    by_frequency = np.interp(ANGLES, bands, gains)
    return by_frequency, float(np.sqrt(squared_total))


def estimate_noise(records: list[RecordErrors]) -> BandGains:
    """Noise power in each frequency band, from the difference between the two equal periods of
    records. It is the same at all amplitudes, so that the median over the records is used."""
    powers = []
    for record in records:
        both_periods, *_ = record.error_spectra()
        first, second = both_periods
        noise_lines = line_powers(first - second) / 2
        powers.append(band_means(noise_lines) / record.period)
    return np.asarray(np.median(powers, axis=0))


def model_error_from_periods(
    record: RecordErrors, has_no_doubt: bool, noise: BandGains
) -> ModelErrorAtAmplitude:
    """Model error by frequency, from a record with two equal periods of input, in which the
    difference between the periods is noise. With two periods `E_1, E_2`, `Re(E_1 conj E_2)` is the
    power that repeats, without bias: noise is independent.

    In a band that the input does not excite nothing is subtracted: the gain is the one measured,
    noise included. Averaged over the M lines of a band its variance is `(S_n^2 / 2 + S_n S_e) / M`.
    Below the largest amplitude only what exceeds `SURE` of its standard deviations counts.
    """
    both_periods, drive, model = record.error_spectra()
    first, second = both_periods
    noise_power = noise * record.period
    _, lines = assign_lines_to_bands(len(drive))
    input_power = band_means(line_powers(drive))
    model_power = band_means(line_powers(model))
    repeats = _repeating_power(first, second)
    doubt: Any = 0.0
    if not has_no_doubt:
        variance = (noise_power**2 / 2 + noise_power * np.maximum(repeats, 0.0)) / lines
        doubt = SURE * np.sqrt(variance)
    chance = 0.0 if has_no_doubt else SURE**2
    least = (1 + chance) * noise_power / 2 / lines
    mean_error = (first + second) / 2
    linear = np.zeros(len(ANGLES), dtype=complex)
    if record.e.shape[1] == record.u.shape[1] == 1:
        linear = _significant_linear_part(mean_error, model, least)
    explained = model_power * np.abs(linear) ** 2
    whole = np.maximum(repeats - doubt, 0.0)
    rest = np.maximum(repeats - explained - doubt, 0.0)
    # Little or no input: by chance nothing repeats there, or anything.
    is_unexcited = input_power < EXCITED * input_power.mean()
    measured = band_means((line_powers(first) + line_powers(second)) / 2)
    whole = np.where(is_unexcited, measured, whole)
    rest = np.where(is_unexcited, measured, rest)
    linear = np.where(is_unexcited, 0.0, linear)
    plant_power = model_power * np.abs(1 + linear) ** 2 + rest
    squared_gain = whole.sum() / input_power.sum()
    by_frequency = np.sqrt(safe_ratio(whole, input_power))
    remainder = np.sqrt(safe_ratio(rest, input_power))
    total_model_power = max(model_power.sum(), np.finfo(float).tiny)
    return ModelErrorAtAmplitude(
        amplitude=record.input_rms,
        gain=float(np.sqrt(squared_gain)),
        by_frequency=by_frequency,
        linear=linear,
        rest=remainder,
        response=float(plant_power.sum() / total_model_power),
    )


def _repeating_power(first: OutputSpectrum, second: OutputSpectrum) -> BandGains:
    """Power in each frequency band of the part of a signal that repeats in two equal periods, in
    which noise averages out."""
    lines = (first * second.conj()).real
    return band_means(lines.sum(axis=1))


def _significant_linear_part(
    error: OutputSpectrum, model: OutputSpectrum, least_power: BandGains
) -> ComplexBandGains:
    """Linear part of the model error in each frequency band, set to zero where it explains no more
    than a given power."""
    linear = _linear_part(error, model)
    model_power = band_means(line_powers(model))
    explained = model_power * np.abs(linear) ** 2
    is_significant = explained > least_power
    return np.where(is_significant, linear, 0.0)


def _linear_part(error: OutputSpectrum, model: OutputSpectrum) -> ComplexBandGains:
    """Linear part of the model error in each frequency band, `S_(e, y_model) / S_(y_model)`. The
    error e is the mean of both periods, which halves the noise's variance."""
    cross_lines = error * model.conj()
    cross_spectrum = cross_lines.sum(axis=1)
    real_part = band_means(cross_spectrum.real)
    imaginary_part = band_means(cross_spectrum.imag)
    model_power = band_means(line_powers(model))
    return safe_ratio(real_part + 1j * imaginary_part, model_power)
