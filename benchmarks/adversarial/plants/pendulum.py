"""A damped pendulum swung through large angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Pendulum(Adversary):
    """`y'' + 2 zeta w y' + w^2 sin y = w^2 u`, rad: state `(y, y')`."""

    order = 2
    shown_by = "ordinary"

    natural_rad_per_s: float
    damping: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, v = x.T
        w = self.natural_rad_per_s
        return np.stack([v, w**2 * (u - np.sin(y)) - 2 * self.damping * w * v], axis=1)
