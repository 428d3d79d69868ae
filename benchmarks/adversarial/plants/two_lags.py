"""Two lags and a mild saturation of the input: the plant of a textbook."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class TwoLags(Adversary):
    """`T_1 a' = full tanh(u / full) - a`, `T_2 y' = a - y`: state `(y, a)`."""

    order = 2
    shown_by = "ordinary"

    first_s: float
    second_s: float
    full: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        y, a = x.T
        return np.stack(
            [(a - y) / self.second_s, (self.full * np.tanh(u / self.full) - a) / self.first_s],
            axis=1,
        )
