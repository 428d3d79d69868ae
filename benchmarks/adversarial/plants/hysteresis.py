"""Smooth hysteresis between a command and the force it makes (Bouc-Wen), as in a piezo or a
magnet."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Hysteresis(Adversary):
    """`T_1 a' = u - a`, `z' = a' (1 - |z| / width) ...`, `T_2 y' = a - share z - y`: state `(y, a,
    z)`."""

    order = 3
    shown_by = "ordinary"

    first_s: float
    second_s: float
    width: float
    share: float

    def rate(
        self, x: Float[np.ndarray, "N 3"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        y, a, z = x.T
        da = (u - a) / self.first_s
        dz = da - np.abs(da) * z / self.width
        return np.stack([(a - self.share * z - y) / self.second_s, da, dz], axis=1)
