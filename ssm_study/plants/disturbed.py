"""A plant that the world acts on meanwhile: step, periodic or random disturbances."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.plants.disturbance import Disturbance
from ssm_study.plants.wrapper import Wrapper
from ssm_study.refusal import require
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class Disturbed(Wrapper):
    """`x+ = f(x, u, d + disturbance(t))` on one disturbance channel; the time since the start is an appended state."""

    disturbance: Disturbance
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
        d[:, self.channel] += self.disturbance.signal(elapsed[:, 0])
        return np.concatenate([self.plant.advance(inner, u, d), elapsed + self.plant.step_s], axis=1)
