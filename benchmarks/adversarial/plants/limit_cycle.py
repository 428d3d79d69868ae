"""Rest is unstable: a small limit cycle around it, drowned in a record at full amplitude."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class LimitCycle(Adversary):
    """`y'' - 2 zeta w (1 - (y / size)^2) y' + w^2 y = w^2 u`, damped beyond `size`: state `(y, y')`
    (van der Pol)."""

    order = 2
    shown_by = "the rest at the end of the records, which does not come to rest"

    natural_rad_per_s: float
    damping: float
    size: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, v = x.T
        w = self.natural_rad_per_s
        damp = 2 * self.damping * w * (1 - np.minimum((y / self.size) ** 2, 4.0))
        return np.stack([v, w**2 * (u - y) + damp * v], axis=1)
