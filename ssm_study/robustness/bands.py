"""Power of signals in frequency bands, from single periods or by Welch's averages."""

import numpy as np
import scipy
from jaxtyping import Complex, Float, Inexact, Int

# Samples per segment of Welch's estimate: bands of a tenth of a radian per sample, 60 averages in
# 4,000 samples.
SEGMENT = 64
BANDS = SEGMENT // 2 + 1
ANGLES = np.linspace(0, np.pi, BANDS)  # bands of power, rad/sample

LinePowers = Float[np.ndarray, "K"]
BandPowers = Float[np.ndarray, "F"]
BandValues = Inexact[np.ndarray, "F"]


def line_powers(spectrum: Complex[np.ndarray, "K c"]) -> LinePowers:
    """Power of a signal at each of its spectral lines, summed over the channels."""
    power = np.abs(spectrum) ** 2
    return power.sum(axis=1)


def safe_ratio(numerators: BandValues, powers: BandPowers) -> BandValues:
    """Ratio of values to signal powers; a power of zero counts as the smallest positive number.

    The spectrum of an exact square wave has bands without any power. An error there makes the ratio
    some 1e300, its root 1e150, which stand for an unbounded gain. The stability margin of such a
    record is some 1e-150: zero.
    """
    smallest = np.finfo(float).tiny
    return numerators / np.maximum(powers, smallest)


def assign_lines_to_bands(line_count: int) -> tuple[Int[np.ndarray, "K"], BandPowers]:
    """Index of the frequency band of each spectral line except the mean, and the number of lines in
    each band."""
    last_band = BANDS - 1
    places = np.linspace(0, last_band, line_count)
    nearest = np.rint(places).astype(int)
    bands = nearest[1:]
    counts = np.bincount(bands, minlength=BANDS)
    divisors = np.maximum(counts, 1)
    return bands, divisors.astype(float)


def band_means(spectrum: LinePowers) -> BandPowers:
    """Mean of a power spectrum over each frequency band."""
    bands, counts = assign_lines_to_bands(len(spectrum))
    without_mean = spectrum[1:]
    sums = np.bincount(bands, weights=without_mean, minlength=BANDS)
    return sums / counts


def welch_power_density(signals: list[Float[np.ndarray, "_ c"]]) -> BandPowers:
    """Power density of signals by Welch's method (1967), summed over channels and averaged over
    records."""
    lengths = [len(signal) for signal in signals]
    segment = min(SEGMENT, *lengths)
    even = max(segment - segment % 2, 2)  # so that the last band is at pi
    powers = []
    for signal in signals:
        _, density = scipy.signal.welch(signal, nperseg=even, detrend=False, axis=0)
        total_density = density.sum(axis=1)
        powers.append(len(signal) * total_density)
    return np.sum(powers, axis=0)
