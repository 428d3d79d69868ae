"""An actuator that moves no faster than it can, and an encoder of finite resolution."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class RateLimited(Adversary):
    """`a' = clip((u - a) / T_1, fastest)`, `T_2 y' = a - y`, read in steps of `resolution`: state
    `(y, a)`."""

    order = 2
    shown_by = "ordinary"

    first_s: float
    second_s: float
    fastest: float
    resolution: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, a = x.T
        return np.stack(
            [(a - y) / self.second_s, np.clip((u - a) / self.first_s, -self.fastest, self.fastest)],
            axis=1,
        )

    def output(self, x: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 1"]:
        return self.resolution * np.round(x[:, :1] / self.resolution)
