"""Power of signals in frequency bands, from single periods or by Welch's averages."""

import numpy as np
import scipy
from jaxtyping import Complex, Float, Inexact, Int

# Samples per segment of Welch's estimate: bands of a tenth of a radian per sample, 60 averages in
# 4,000 samples.
SEGMENT = 64
ANGLES = np.linspace(0, np.pi, SEGMENT // 2 + 1)  # bands of power, rad/sample


def total_power(spectrum: Complex[np.ndarray, "K c"]) -> Float[np.ndarray, "K"]:
    """Power of each spectral line, summed over the channels."""
    return (np.abs(spectrum) ** 2).sum(axis=1)


def safe_ratio(
    values: Inexact[np.ndarray, "F"], by: Float[np.ndarray, "F"]
) -> Inexact[np.ndarray, "F"]:
    """Divide values by a power that may be zero."""
    return values / np.maximum(by, np.finfo(float).tiny)


def sort_lines_into_bands(lines: int) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "F"]]:
    """Band of each spectral line except the mean, and the number of lines in each band."""
    nearest = np.rint(np.linspace(0, len(ANGLES) - 1, lines))
    bands = nearest.astype(int)[1:]
    counts = np.bincount(bands, minlength=len(ANGLES))
    return bands, np.maximum(counts, 1).astype(float)


def band_means(lines: Float[np.ndarray, "K"]) -> Float[np.ndarray, "F"]:
    """Mean of a spectrum over each frequency band."""
    bands, counts = sort_lines_into_bands(len(lines))
    return np.bincount(bands, weights=lines[1:], minlength=len(ANGLES)) / counts


def welch_power_density(signals: list[Float[np.ndarray, "_ c"]]) -> Float[np.ndarray, "F"]:
    """Power density of signals by Welch's method (1967), summed over channels and averaged over
    records."""
    segment = min(SEGMENT, *(len(signal) for signal in signals))
    even = max(segment - segment % 2, 2)  # so that the last band is at pi
    powers = []
    for signal in signals:
        _, density = scipy.signal.welch(signal, nperseg=even, detrend=False, axis=0)
        powers.append(len(signal) * density.sum(axis=1))
    return np.sum(powers, axis=0)
