"""A mass on a spring whose damper thins out: its resonance is the sharper, the less it moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class ThinningDamping(Adversary):
    """`y'' + (c + d |y'|) y' + w^2 y = w^2 u`: state `(y, y')`. Near rest c alone damps it."""

    order = 2
    shown_by = "validation records at a small part of the amplitude"

    natural_rad_per_s: float
    least_damping: float
    square_damping: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, v = x.T
        w = self.natural_rad_per_s
        return np.stack(
            [v, w**2 * (u - y) - (self.least_damping + self.square_damping * np.abs(v)) * v], axis=1
        )
