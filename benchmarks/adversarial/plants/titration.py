"""A steep static curve at rest behind a lag and a dead time, as of a titration: a broadband input
dithers over the steep piece, which a single sine meets in full."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Titration(Adversary):
    """`T b' = u(t - 3 h) - b`, `y = b + height tanh(b / width)`: state `(b, u_1, u_2, u_3)`, the
    last three in samples. The slope at rest is `1 + height / width`.
    """

    order = 4
    shown_by = "single sines"

    lag_s: float
    height: float
    width: float

    def rate(
        self, x: Float[np.ndarray, "N 4"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 4"]:
        moved = np.zeros_like(x)
        moved[:, 0] = (u - x[:, 0]) / self.lag_s
        return moved

    def next_states(
        self, x: Float[np.ndarray, "N 4"], u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N 4"]:
        moved = super().next_states(x, x[:, 3:], d)
        return np.column_stack([moved[:, 0], u[:, 0], x[:, 1:3]])

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 4"]:
        b = np.zeros_like(y0)
        for _ in range(60):  # Newton's method, damped: the map is monotone and steep near zero
            slope = 1 + self.height / self.width / np.cosh(b / self.width) ** 2
            states = np.concatenate([b, np.zeros((len(b), 3))], axis=1)
            b = b - 0.5 * (self.output(states) - y0) / slope
        return np.concatenate([b, np.zeros((len(b), 3))], axis=1)

    def output(self, x: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 1"]:
        b = x[:, :1]
        return b + self.height * np.tanh(b / self.width)
