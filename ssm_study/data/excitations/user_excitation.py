"""Excitation signal for a plant of the user's own, to be applied by the user and recorded as a
log."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.data.excitations.excitation import APRBS, SignalRequest
from ssm_study.refusal import require, require_positive

AMPLITUDES = (
    1.0,
    0.5,
    0.2,
)  # of the way from rest to the limits: a plant may answer small inputs differently
PERIODS = 2  # what differs between equal periods is noise, and is measured so by itself
HOLDS_PER_SETTLING = 10  # the shortest hold is a tenth of the settling time: fast modes show
LONGEST_HOLD = 5  # of these holds, half of the settling time: slow modes do
SINE_AMPLITUDES = (1.0, 0.2, 0.05, 0.01)  # likewise of single sines
SINE_CYCLES = 4  # at least, in one of the three equal parts of a sine
PERIOD_IN_SETTLINGS = 20  # some seventy levels a period: S_u is seen all over the range


@dataclass(frozen=True, kw_only=True)
class IdentificationExperiment:
    """Identification experiment for a user's own plant, whose input signal the user applies and
    records. It rests, then has two equal periods of random levels at each amplitude, then rests;
    then likewise a single sine of each frequency in `sines` (rad/sample) at each amplitude; all
    within `lower, upper`.

    `settle_s` is how long the plant takes to come to rest, roughly: from a step by hand or a first
    log. `rest` must lie strictly inside the limits. Raises `BadRequest` for a settling time below
    twenty samples.
    """

    lower: float
    upper: float
    rest: float
    step_s: float
    settle_s: float
    seed: int = 0
    sines: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        limits = (self.lower, self.rest, self.upper)
        problem = "rest must lie strictly between the limits"
        remedy = "give --lower < --rest < --upper"
        between = -np.inf < self.lower < self.rest < self.upper < np.inf
        require(between, "lower, rest, upper", limits, problem, remedy)
        require_positive("step_s", self.step_s, "give it in seconds")
        require_positive("settle_s", self.settle_s, "give it in seconds")
        enough = self.settle_s >= 2 * HOLDS_PER_SETTLING * self.step_s
        problem = (
            "the plant comes to rest within fewer than twenty samples, too few to see its dynamics"
        )
        require(enough, "settle_s", self.settle_s, problem, "sample faster: a smaller --step-s")

    def input_signal(self) -> Float[np.ndarray, "T"]:
        """Generate the input signal of an identification experiment on the user's plant, one value
        per sampling period."""
        settling = round(self.settle_s / self.step_s)
        rng = np.random.default_rng(self.seed)
        samples = PERIOD_IN_SETTLINGS * settling
        clock_s = self.settle_s / HOLDS_PER_SETTLING
        request = SignalRequest(
            samples=samples, step_s=self.step_s, amplitude=(1.0,), clock_s=clock_s
        )
        parts = [still := np.full(2 * settling, self.rest)]
        for amplitude in AMPLITUDES:
            levels = (
                amplitude * APRBS(longest_hold_clocks=LONGEST_HOLD).unit_signal(request, rng)[:, 0]
            )
            reach = np.where(levels > 0, self.upper - self.rest, self.rest - self.lower)
            parts += [self.rest + reach * levels] * PERIODS + [still]
        for angle in self.sines:
            for amplitude in SINE_AMPLITUDES:
                parts += [self.sine_signal(angle, amplitude, settling), still]
        return np.concatenate(parts)

    def sine_signal(self, angle: float, amplitude: float, settling: int) -> Float[np.ndarray, "T"]:
        """Generate a sine with a whole number of samples per cycle, in three equal parts: one for
        settling and two for measuring. It has three parts, each as long as the plant takes to
        settle."""
        cycle = max(round(2 * np.pi / angle), 4)
        cycles = max(-(-settling // cycle), SINE_CYCLES)
        reach = amplitude * min(self.upper - self.rest, self.rest - self.lower)
        wave = reach * np.sin(2 * np.pi * np.arange(cycle) / cycle)
        return self.rest + np.tile(wave, 3 * cycles)  # the same bits in every cycle

    def write_csv(self, path: Path) -> str:
        """Write the input signal of an identification experiment to a CSV file, and return a
        sentence that describes it."""
        u = self.input_signal()
        time_s = np.arange(len(u)) * self.step_s
        table = pd.DataFrame({"time_s": time_s, "input": u})
        table.to_csv(path, index=False)
        lasts = f"{len(u)} samples, {len(u) * self.step_s / 60:.1f} minutes"
        if self.sines:
            hertz = [f"{angle / (2 * np.pi * self.step_s):.3g}" for angle in self.sines]
            *before, last = hertz
            frequencies = f"{', '.join(before)} and {last}" if before else last
            lasts += f", the last with single sines at {frequencies} Hz"
        return f"{path}: {lasts}, inputs from {u.min():.4g} to {u.max():.4g}, rest {self.rest:.4g}"
