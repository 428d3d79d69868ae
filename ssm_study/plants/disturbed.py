"""A plant that the world acts on by a profile over time: step, periodic or random disturbances."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ssm_study.plants.wrapper import Wrapper
from ssm_study.refusal import require
from ssm_study.signals import Channel


@runtime_checkable
class Profile(Protocol):
    """A disturbance over time: `signal(time_s (T,)) -> (T,)`, in the unit of the disturbance channel."""

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]: ...


@dataclass(frozen=True, kw_only=True)
class Disturbed(Wrapper):
    """`x+ = f(x, u, d + profile(t))` on one disturbance channel; the time since the start is an appended state."""

    profile: Profile
    channel: int = 0

    def __post_init__(self) -> None:
        count = len(self.plant.disturbances)
        require(0 <= self.channel < count, "channel", self.channel, f"the plant has {count} disturbances", "use 0")

    @property
    def memory(self) -> tuple[Channel, ...]:
        return (Channel(name="elapsed_time", unit="s"),)

    def fresh_memory(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N 1"]:
        return np.zeros((len(y0), 1))

    def advance(
        self, x: Float[np.ndarray, "N n"], u: Float[np.ndarray, "N m"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N n"]:
        inner, elapsed = self.split(x)
        d = d.copy()
        d[:, self.channel] += self.profile.signal(elapsed[:, 0])
        return np.concatenate([self.plant.advance(inner, u, d), elapsed + self.plant.step_s], axis=1)


@dataclass(frozen=True, kw_only=True)
class StepProfile:
    """`d = size` for `at_s <= t < until_s` (None: for ever)."""

    size: float
    at_s: float
    until_s: float | None = None

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        end = np.inf if self.until_s is None else self.until_s
        return np.where((time_s >= self.at_s - 1e-9) & (time_s < end - 1e-9), float(self.size), 0.0)


@dataclass(frozen=True, kw_only=True)
class PeriodicProfile:
    """`d = amplitude sin(2 pi frequency_hz t)`."""

    amplitude: float
    frequency_hz: float

    def __post_init__(self) -> None:
        require(self.frequency_hz > 0, "frequency_hz", self.frequency_hz, "must be positive", "use a step instead")

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return self.amplitude * np.sin(2 * np.pi * self.frequency_hz * time_s)


@dataclass(frozen=True, kw_only=True)
class RandomProfile:
    """`d` uniform in `[-amplitude, amplitude]`, drawn anew every `hold_s` and a function of seed and time alone."""

    amplitude: float
    hold_s: float
    seed: int = 0

    def __post_init__(self) -> None:
        require(0 < self.hold_s < np.inf, "hold_s", self.hold_s, "must be positive", "give seconds")
        require(self.seed >= 0, "seed", self.seed, "must not be negative", "use 0")

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        holds, which = np.unique(np.floor(time_s / self.hold_s + 1e-9).astype(np.int64), return_inverse=True)
        draws = [np.random.default_rng([self.seed, int(hold)]).uniform(-1.0, 1.0) for hold in holds]
        return self.amplitude * np.array(draws, dtype=np.float64)[which]
