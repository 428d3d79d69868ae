"""A slow mode: creep that takes longer than a record, with as much gain as the fast part."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class SlowMode(Adversary):
    """`T f' = g v - f`, `T_a v' = u - v`, `T_s s' = share u - s`, `y = f + s`: state `(f, v, s)`.

    `T_s` is thousands of samples; half of an initial output is creep, which the model never saw.
    """

    order = 3
    shown_by = "free decays from the initial range, which do not come to rest"

    fast_s: float
    actuator_s: float
    slow_s: float
    share: float

    def rate(
        self, x: Float[np.ndarray, "N 3"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        f, v, s = x.T
        return np.stack(
            [(v - f) / self.fast_s, (u - v) / self.actuator_s, (self.share * u - s) / self.slow_s],
            axis=1,
        )

    def output(self, x: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 1"]:
        return x[:, :1] + x[:, 2:3]

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 3"]:
        return np.concatenate([0.5 * y0, np.zeros_like(y0), 0.5 * y0], axis=1)
