"""A body in a fluid: speed under linear and quadratic drag, thrust behind a lag."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Drag(Adversary):
    """`m y' = f - (b + c |y|) y`, `T f' = u - f`: state `(y, f)`."""

    order = 2
    shown_by = "ordinary"

    mass: float
    linear: float
    quadratic: float
    thrust_s: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, f = x.T
        return np.stack(
            [
                (f - (self.linear + self.quadratic * np.abs(y)) * y) / self.mass,
                (u - f) / self.thrust_s,
            ],
            axis=1,
        )
