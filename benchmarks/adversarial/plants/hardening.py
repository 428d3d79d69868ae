"""A spring that hardens: its frequency rises with the displacement, and the loop starts farther out
than the record."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Hardening(Adversary):
    """`y'' + 2 zeta w y' + w^2 (y + k y^3) = w^2 u`: state `(y, y')`.

    The excitation moves it within a part of the initial range; beyond, the spring is several times
    as stiff.
    """

    order = 2
    shown_by = "free decays from the initial range"

    natural_rad_per_s: float
    damping: float
    cubic: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, v = x.T
        w = self.natural_rad_per_s
        return np.stack([v, w**2 * (u - y - self.cubic * y**3) - 2 * self.damping * w * v], axis=1)
