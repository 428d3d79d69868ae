"""A heat exchanger about its operating point: the flow is the input, so gain and lag both change
with it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Exchanger(Adversary):
    """`T a' = (1 + change v) v - (1 + change v) a`, `v = u / (1 + |u|)`, `T_s y' = a - y`: state
    `(y, a)`.

    More flow is faster; the sensor lags behind.
    """

    order = 2
    shown_by = "ordinary"

    lag_s: float
    sensor_s: float
    change: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, a = x.T
        v = u / (1 + np.abs(u))
        return np.stack(
            [(a - y) / self.sensor_s, (1 + self.change * v) * (v - a) / self.lag_s], axis=1
        )
