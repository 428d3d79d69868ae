"""Dead time of three samples before a second-order process."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class DeadTime(Adversary):
    """`T_1 a' = u(t - 3 h) - a`, `T_2 y' = a - y`: state `(y, a, u_1, u_2, u_3)`, the last three in
    samples."""

    order = 5
    shown_by = "ordinary"

    first_s: float
    second_s: float

    def rate(
        self, x: Float[np.ndarray, "N 5"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 5"]:
        y = x[:, 0]
        a = x[:, 1]
        still = np.zeros_like(y)
        return np.stack(
            [(a - y) / self.second_s, (u - a) / self.first_s, still, still, still], axis=1
        )

    def next_states(
        self, x: Float[np.ndarray, "N 5"], u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N 5"]:
        moved = super().next_states(x, x[:, 4:], d)
        return np.column_stack([moved[:, :2], u[:, 0], x[:, 2:4]])
