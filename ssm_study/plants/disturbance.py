"""Disturbances that act on a plant, as functions of time."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require, require_at_least, require_positive

Signal = Float[np.ndarray, "T"]


class Disturbance(ABC):
    """Base class of disturbances on a plant as functions of time, in the unit of the disturbed
    channel.

    In a closed loop that is the plant's first channel (the motor's: load torque, N m).
    """

    @abstractmethod
    def signal(self, time_s: Signal) -> Signal:
        """Values of a disturbance at given times."""


@dataclass(frozen=True, kw_only=True)
class NoDisturbance(Disturbance):
    """Disturbance that is zero at all times."""

    def signal(self, time_s: Signal) -> Signal:
        return np.zeros_like(time_s)


@dataclass(frozen=True, kw_only=True)
class StepDisturbance(Disturbance):
    """Disturbance that is a step of a given `size`, in the unit of the disturbed channel. It begins
    at `at_s` and ends at `until_s`, or never."""

    size: float
    at_s: float
    until_s: float | None = None

    def __post_init__(self) -> None:
        is_ordered = self.until_s is None or self.at_s < self.until_s
        times = (self.at_s, self.until_s)
        require(is_ordered, "at_s, until_s", times, "not in order", "give at_s < until_s")

    def signal(self, time_s: Signal) -> Signal:
        end_s = np.inf if self.until_s is None else self.until_s
        has_begun = time_s >= self.at_s - 1e-9
        lasts = time_s < end_s - 1e-9
        return np.where(has_begun & lasts, float(self.size), 0.0)


@dataclass(frozen=True, kw_only=True)
class PeriodicDisturbance(Disturbance):
    """Disturbance that is a sine of given amplitude and frequency."""

    amplitude: float
    frequency_hz: float

    def __post_init__(self) -> None:
        require_positive("frequency_hz", self.frequency_hz, "use a step instead")

    def signal(self, time_s: Signal) -> Signal:
        return self.amplitude * np.sin(2 * np.pi * self.frequency_hz * time_s)


@dataclass(frozen=True, kw_only=True)
class RampDisturbance(Disturbance):
    """Disturbance that changes linearly between two times and is constant before and after."""

    slope_per_s: float
    from_s: float
    until_s: float

    def __post_init__(self) -> None:
        is_ordered = 0 <= self.from_s < self.until_s
        times = (self.from_s, self.until_s)
        remedy = "give 0 <= from_s < until_s"
        require(is_ordered, "from_s, until_s", times, "not in order", remedy)

    def signal(self, time_s: Signal) -> Signal:
        time_on_ramp_s = np.clip(time_s, self.from_s, self.until_s) - self.from_s
        return self.slope_per_s * time_on_ramp_s


@dataclass(frozen=True, kw_only=True)
class RandomDisturbance(Disturbance):
    """Disturbance of uniformly distributed random levels, each held for a fixed time.

    Levels lie within `amplitude` of zero, in the unit of what it acts on. They depend on seed and
    time alone.
    """

    amplitude: float
    hold_s: float
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("hold_s", self.hold_s, "give seconds")
        require_at_least(0, "seed", self.seed, "use 0")

    def signal(self, time_s: Signal) -> Signal:
        hold_of_sample = np.floor(time_s / self.hold_s + 1e-9).astype(np.int64)
        holds, which = np.unique(hold_of_sample, return_inverse=True)
        streams = (np.random.default_rng([self.seed, int(hold)]) for hold in holds)
        draws = [stream.uniform(-1.0, 1.0) for stream in streams]
        return self.amplitude * np.array(draws, dtype=np.float64)[which]
