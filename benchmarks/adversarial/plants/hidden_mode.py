"""A lightly damped mode above the excitation's band, behind a slow first-order process."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class HiddenMode(Adversary):
    """`T s' = u - s`, `q'' = w^2 (c u - q) - 2 zeta w q'`, `y = s + q`: state `(s, q, q')`.

    The mode lies where a signal that holds its levels for ten samples has a thousandth of its
    power.
    """

    order = 3
    shown_by = "validation records whose spectrum reaches to half the sampling rate"

    slow_s: float
    mode_rad_per_s: float
    damping: float
    share: float

    def rate(
        self, x: Float[np.ndarray, "N 3"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        s, q, v = x.T
        w = self.mode_rad_per_s
        return np.stack(
            [(u - s) / self.slow_s, v, w**2 * (self.share * u - q) - 2 * self.damping * w * v],
            axis=1,
        )

    def output(self, x: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 1"]:
        return x[:, :1] + x[:, 1:2]
