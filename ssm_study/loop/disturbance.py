"""What the world does to the plant meanwhile: a disturbance over time, the same for every case."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require


class Disturbance(ABC):
    """`signal(time_s) -> (T,)` for the plant's first disturbance channel, in its unit (the motor: load torque, N m)."""

    @abstractmethod
    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]: ...


@dataclass(frozen=True, kw_only=True)
class NoDisturbance(Disturbance):
    """`d = 0`."""

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.zeros_like(time_s)


@dataclass(frozen=True, kw_only=True)
class StepDisturbance(Disturbance):
    """`d = size` from `at_s` until `until_s` (None: for ever)."""

    size: float
    at_s: float
    until_s: float | None = None

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        acting = (time_s >= self.at_s - 1e-12) & (time_s < (np.inf if self.until_s is None else self.until_s))
        return np.where(acting, float(self.size), 0.0)


@dataclass(frozen=True, kw_only=True)
class PeriodicDisturbance(Disturbance):
    """`d = amplitude sin(2 pi frequency_hz t)`."""

    amplitude: float
    frequency_hz: float

    def __post_init__(self) -> None:
        require(self.frequency_hz > 0, "frequency_hz", self.frequency_hz, "must be positive", "use a step instead")

    def signal(self, time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return self.amplitude * np.sin(2 * np.pi * self.frequency_hz * time_s)
