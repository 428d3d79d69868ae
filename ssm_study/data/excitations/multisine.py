"""Multisine excitation with a low crest factor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.data.excitations.excitation import Excitation, SignalRequest, check_frequency_band
from ssm_study.refusal import require, require_at_least

FEWEST_LINES = 2
# of the peak: deep enough to make progress, shallow enough to converge (Van der Ouderaa et al.
# 1988)
CLIP_AT = 0.85


@dataclass(frozen=True, kw_only=True)
class Multisine(Excitation):
    """Excitation signal: a sum of sines with random phases and equal power at all frequencies of a
    band. `u(t) = A sum_k cos(2 pi k t / T + phi_k) / peak`, all lines k of the band, T the length
    of the record.

    Random phases, then `crest_iterations` rounds of clipping in time and restoring the flat
    spectrum, which lowers the crest factor peak/rms (random phases: about 3; afterwards about 1.6).
    `band_low_hz` None is the first line, `band_high_hz` None is `0.5 / clock_s`. Source: Pintelon &
    Schoukens 2012, sec. 5.3; Van der Ouderaa et al. 1988.
    """

    kind = "multisine"

    band_low_hz: float | None = None
    band_high_hz: float | None = None
    crest_iterations: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        check_frequency_band(self.band_low_hz, self.band_high_hz, "band_")
        require_at_least(
            0, "excitation.crest_iterations", self.crest_iterations, "use 0 for random phases"
        )

    def unit_signal(
        self, request: SignalRequest, rng: np.random.Generator
    ) -> Float[np.ndarray, "T m"]:
        frequencies = np.fft.rfftfreq(request.samples, request.step_s)
        low = 0.0 if self.band_low_hz is None else self.band_low_hz
        high = 0.5 / request.clock_s if self.band_high_hz is None else self.band_high_hz
        nyquist = 0.5 / request.step_s
        band = frequencies > 0
        band &= frequencies >= low * (1 - 1e-9)
        band &= frequencies <= high * (1 + 1e-9)
        band &= frequencies < nyquist * (1 - 1e-9)  # the Nyquist line has no phase to choose
        field = "excitation.band_low_hz, excitation.band_high_hz"
        lines = int(band.sum())
        problem = (
            f"holds {lines} frequencies of a record of {request.samples} samples every "
            f"{request.step_s:g} s"
        )
        remedy = "widen the band or lengthen the record"
        require(lines >= FEWEST_LINES, field, (low, high), problem, remedy)
        samples = request.samples
        channels = [self._channel_signal(band, samples, rng) for _ in range(request.inputs)]
        return np.stack(channels, axis=1)

    def _channel_signal(
        self, band: np.ndarray, samples: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "T"]:
        """Generate the multisine of one input channel, with the lowest crest factor among several
        random choices of phases."""
        phases = np.exp(2j * np.pi * rng.random(len(band)))
        best = np.fft.irfft(np.where(band, phases, 0.0), samples)
        for _ in range(self.crest_iterations):
            level = CLIP_AT * np.abs(best).max()
            clipped = np.fft.rfft(np.clip(best, -level, level))
            phases = np.exp(1j * np.angle(clipped))
            candidate = np.fft.irfft(np.where(band, phases, 0.0), samples)
            if np.abs(candidate).max() >= np.abs(best).max():
                break
            best = candidate
        return best / np.abs(best).max()
