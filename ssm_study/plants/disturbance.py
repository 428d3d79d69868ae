"""Disturbances that act on a plant over time, the same for every case."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import at_least, positive, require


class Disturbance(ABC):
    """`signal(time_s (T,)) -> (T,)`, in the unit of the disturbance channel it acts on (the
    motor's: load torque, N m).

    In a closed loop that is the plant's first channel.
    """

    @abstractmethod
    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]: ...


@dataclass(frozen=True, kw_only=True)
class NoDisturbance(Disturbance):
    """`d = 0`."""

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.zeros_like(time_s)


@dataclass(frozen=True, kw_only=True)
class StepDisturbance(Disturbance):
    """`d = size` for `at_s <= t < until_s` (None: for ever)."""

    size: float
    at_s: float
    until_s: float | None = None

    def __post_init__(self) -> None:
        ordered = self.until_s is None or self.at_s < self.until_s
        require(
            ordered,
            "at_s, until_s",
            (self.at_s, self.until_s),
            "not in order",
            "give at_s < until_s",
        )

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        end = np.inf if self.until_s is None else self.until_s
        return np.where((time_s >= self.at_s - 1e-9) & (time_s < end - 1e-9), float(self.size), 0.0)


@dataclass(frozen=True, kw_only=True)
class PeriodicDisturbance(Disturbance):
    """`d = amplitude sin(2 pi frequency_hz t)`."""

    amplitude: float
    frequency_hz: float

    def __post_init__(self) -> None:
        positive("frequency_hz", self.frequency_hz, "use a step instead")

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return self.amplitude * np.sin(2 * np.pi * self.frequency_hz * time_s)


@dataclass(frozen=True, kw_only=True)
class RampDisturbance(Disturbance):
    """`d` rises (or falls) at `slope_per_s` from `from_s` until `until_s`, constant before and
    after."""

    slope_per_s: float
    from_s: float
    until_s: float

    def __post_init__(self) -> None:
        ordered = 0 <= self.from_s < self.until_s
        require(
            ordered,
            "from_s, until_s",
            (self.from_s, self.until_s),
            "not in order",
            "give 0 <= from_s < until_s",
        )

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return self.slope_per_s * (np.clip(time_s, self.from_s, self.until_s) - self.from_s)


@dataclass(frozen=True, kw_only=True)
class RandomDisturbance(Disturbance):
    """`d` uniform in `[-amplitude, amplitude]`, drawn anew every `hold_s` and a function of seed
    and time alone."""

    amplitude: float
    hold_s: float
    seed: int = 0

    def __post_init__(self) -> None:
        positive("hold_s", self.hold_s, "give seconds")
        at_least(0, "seed", self.seed, "use 0")

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        holds, which = np.unique(
            np.floor(time_s / self.hold_s + 1e-9).astype(np.int64), return_inverse=True
        )
        draws = [np.random.default_rng([self.seed, int(hold)]).uniform(-1.0, 1.0) for hold in holds]
        return self.amplitude * np.array(draws, dtype=np.float64)[which]
