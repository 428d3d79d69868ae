"""A valve with stiction: the stem stays until it is pushed hard enough, then slips to where it is
pushed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Stiction(Adversary):
    """Position `s` jumps to `u` when `|u - s| > stick`, else it stays.

    `T_1 a' = s - a`, `T_2 y' = a - y`, state `(y, a, s)`.
    """

    order = 3
    shown_by = "ordinary: the model's own loop tolerates it"

    stick: float
    first_s: float
    second_s: float

    def rate(
        self,
        x: Float[np.ndarray, "N 3"],
        u: Float[np.ndarray, "N"],  # noqa: ARG002
    ) -> Float[np.ndarray, "N 3"]:
        y, a, s = x.T
        return np.stack([(a - y) / self.second_s, (s - a) / self.first_s, np.zeros_like(s)], axis=1)

    def next_states(
        self, x: Float[np.ndarray, "N 3"], u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N 3"]:
        stem = np.where(np.abs(u[:, 0] - x[:, 2]) > self.stick, u[:, 0], x[:, 2])
        return super().next_states(np.column_stack([x[:, :2], stem]), u, d)
