"""Deterministic excitation signals: a sweep over frequencies (chirp) and a sweep over levels
(staircase)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.data.excitations.excitation import Excitation, SignalRequest, check_frequency_band
from ssm_study.refusal import require, require_at_least


@dataclass(frozen=True, kw_only=True)
class Chirp(Excitation):
    """Excitation signal: a chirp, a sine whose frequency rises linearly with time. `u = A sin(phi +
    2 pi (f0 t + (f1 - f0) t^2 / 2T))`: from f0 to f1 over the record.

    Random initial phase; every second channel sweeps downwards. `low_hz` None is one period per
    record, `high_hz` None is `0.5 / clock_s`.
    """

    kind = "chirp"

    low_hz: float | None = None
    high_hz: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_frequency_band(self.low_hz, self.high_hz)

    def unit_signal(
        self, request: SignalRequest, rng: np.random.Generator
    ) -> Float[np.ndarray, "T m"]:
        t = np.arange(request.samples) * request.step_s
        length = request.samples * request.step_s
        low = 1.0 / length if self.low_hz is None else self.low_hz
        high = 0.5 / request.clock_s if self.high_hz is None else self.high_hz
        nyquist = 0.5 / request.step_s
        problem = f"not in ({low:g}, {nyquist:g}] Hz"
        remedy = "sweep inside"
        require(low < high <= nyquist, "excitation.high_hz", high, problem, remedy)
        turns = low * t + (high - low) * t**2 / (2 * length)
        columns = []
        for j in range(request.inputs):
            column = np.sin(2 * np.pi * (rng.random() + turns))
            columns.append(column[::-1] if j % 2 else column)
        return np.stack(columns, axis=1)


@dataclass(frozen=True, kw_only=True)
class Staircase(Excitation):
    """Excitation signal: a staircase that ascends and descends over the input range. `levels`
    values spaced uniformly over `[-A, A]`, climbed and descended, each held for `hold_clocks`
    clocks.

    Shows the static map: long holds let each level settle. Every channel starts at a random point
    of the climb.
    """

    kind = "staircase"

    levels: int
    hold_clocks: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(3, "excitation.levels", self.levels, "use 11 or so")
        require_at_least(1, "excitation.hold_clocks", self.hold_clocks, "use 5 or so")

    def unit_signal(
        self, request: SignalRequest, rng: np.random.Generator
    ) -> Float[np.ndarray, "T m"]:
        up = np.linspace(-1.0, 1.0, self.levels)
        levels = np.concatenate([up, up[-2:0:-1]])
        cycle = np.repeat(levels, self.hold_clocks * request.clock_period_samples)
        starts = [rng.integers(len(cycle)) for _ in range(request.inputs)]
        cycles = [np.roll(cycle, -start) for start in starts]
        return np.stack([np.resize(rolled, request.samples) for rolled in cycles], axis=1)
