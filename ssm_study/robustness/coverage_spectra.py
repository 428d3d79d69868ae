"""Spectra of the model error in one record: from two periods of a repeated input, otherwise by
Welch's method.

`m` is the model's output for the record's input, `e = y - m` what it misses, all scaled. Source:
docs/theory.md, "Measured discs".
"""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.robustness.bands import ANGLES, line_powers
from ssm_study.robustness.record_errors import QUIET, RecordErrors
from ssm_study.robustness.return_to_rest import SURE

Powers = Float[np.ndarray, "L"]


@dataclass(frozen=True, kw_only=True)
class MismatchSpectrum:
    """Spectra of model output, input and model error of one record at its spectral lines. Angles
    are in rad/sample; the error e has one or two periods.

    `sides` is 2 for a line that stands for a conjugate pair, 1 for the mean and for pi. Of a record
    whose input does not repeat there is one period, and its "lines" are the bins of Welch's
    estimate, in which powers stand in place of transforms.
    """

    name: str
    amplitude: float
    angles: Powers
    sides: Powers
    model: Complex[np.ndarray, "2 L p"]
    error: Complex[np.ndarray, "2 L p"]
    input_power: Powers
    noise: Powers

    def error_minus_centre(self, centre: float) -> Complex[np.ndarray, "2 L p"]:
        """Spectrum of `e - c m`: model error minus the disc's centre c times the model output, in
        both periods."""
        return self.error - centre * self.model

    @property
    def model_power(self) -> Powers:
        """Power of the model's output at each spectral line in the second period."""
        return line_powers(self.model[1])


@dataclass(frozen=True, kw_only=True)
class AveragedSpectrum:
    """Power spectra, by Welch's averages, of a record whose input does not repeat. `cross` is that
    of e with the model's output, real part.

    `drawn` is the noise's share of e's power, and `sure` the factor by which an average may be off:
    zero and one in open loop, where noise counts as mismatch.
    """

    name: str
    amplitude: float
    angles: Powers
    model_power: Powers
    error_power: Powers
    cross: Powers
    input_power: Powers
    drawn: Powers
    sure: Powers

    def error_power_about_centre(self, centre: float) -> Powers:
        """Power of `e - c m`, model error minus the disc's centre c times the model output, in each
        frequency bin, with noise subtracted."""
        cross_power = 2 * centre * self.cross
        power = self.error_power - cross_power + centre**2 * self.model_power
        noise_power = self.sure * self.drawn
        without_noise = np.maximum(power - noise_power, 0.0)
        return self.sure * without_noise


def line_spectrum(record_errors: RecordErrors, noise: Float[np.ndarray, "F"]) -> MismatchSpectrum:
    """Line spectra of input, model output and model error in a record whose input has two equal
    periods."""
    assert record_errors.period is not None
    lines = np.arange(record_errors.period // 2 + 1)
    angles = 2 * np.pi * lines / record_errors.period
    is_mean = np.isclose(angles, 0.0)
    has_no_conjugate = is_mean | np.isclose(angles, np.pi)
    sides = np.where(has_no_conjugate, 1.0, 2.0)
    model = record_errors.period_spectra(record_errors.model)
    error = record_errors.period_spectra(record_errors.e)
    _, second_input = record_errors.period_spectra(record_errors.u)
    noise_at_lines = np.interp(angles, ANGLES, noise)
    return MismatchSpectrum(
        name=record_errors.name,
        amplitude=record_errors.input_rms,
        angles=angles,
        sides=sides,
        model=model,
        error=error,
        input_power=line_powers(second_input),
        noise=record_errors.period * noise_at_lines,
    )


def averaged_spectrum(record_errors: RecordErrors) -> AveragedSpectrum:
    """Power spectra, by Welch's averages, of an open-loop record; noise counts as model error."""
    powers = _welch_powers(record_errors)
    none = np.zeros_like(powers["angles"])
    ones = np.ones_like(powers["angles"])
    return AveragedSpectrum(
        name=record_errors.name, amplitude=record_errors.input_rms, drawn=none, sure=ones, **powers
    )


def averaged_spectrum_in_loop(
    record_errors: RecordErrors, noise: Float[np.ndarray, "F"] | None
) -> AveragedSpectrum:
    """Power spectra of a closed-loop record by Welch's averages, with an estimate of the record's
    noise. The noise is `noise` from records in open loop, else white and as strong as e in its
    quietest bands."""
    powers = _welch_powers(record_errors)
    angles = powers["angles"]
    samples = len(record_errors.u)
    if noise is None:
        inner_bands = powers["error_power"][1:-1]
        one_sided = np.quantile(inner_bands, QUIET) / 2
    else:
        one_sided = samples * np.interp(angles, ANGLES, noise)
    has_conjugate = (angles > 0) & (angles < np.pi)
    sides = np.where(has_conjugate, 2.0, 1.0)
    bands = len(angles)
    relative_error = float(np.sqrt(1.06 * bands / samples))
    drawn = sides * one_sided
    sure = np.full(bands, 1 + SURE * relative_error)
    return AveragedSpectrum(
        name=record_errors.name, amplitude=record_errors.input_rms, drawn=drawn, sure=sure, **powers
    )


def _welch_powers(record_errors: RecordErrors) -> dict[str, Powers]:
    """Power spectra, by Welch's averages, of a record's input, model output and model error, and
    the cross power of model output and error."""
    longest = 2 * (len(ANGLES) - 1)
    segment = min(longest, len(record_errors.u))
    even = max(segment // 2 * 2, 2)
    pairs = {
        "model_power": (record_errors.model, record_errors.model),
        "error_power": (record_errors.e, record_errors.e),
        "cross": (record_errors.e, record_errors.model),
        "input_power": (record_errors.u, record_errors.u),
    }
    powers = {}
    for name, (first, second) in pairs.items():
        _, density = scipy.signal.csd(first, second, nperseg=even, detrend=False, axis=0)
        total_density = density.real.sum(axis=1)
        powers[name] = len(record_errors.u) * total_density
    lines = len(powers["input_power"])
    powers["angles"] = np.linspace(0, np.pi, lines)
    return powers
