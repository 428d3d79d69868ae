"""A process whose gain peaks at rest: what a sensor with a steep characteristic at its set point
shows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class PeakingGain(Adversary):
    """`T_1 a' = u - a`, `T_2 b' = a - b`, `y = b + peak w tanh(b / w)`: state `(b, a)`.

    A record at full amplitude sees slope one nearly all the time; at rest it is `1 + peak`.
    """

    order = 2
    shown_by = "validation records at a small part of the amplitude"

    first_s: float
    second_s: float
    peak: float
    width: float

    def rate(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        b, a = x.T
        return np.stack([(a - b) / self.second_s, (u - a) / self.first_s], axis=1)

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 2"]:
        b = np.zeros_like(y0)
        for _ in range(60):  # Newton's method, damped: the map is monotone and steep near zero
            slope = 1 + self.peak / np.cosh(b / self.width) ** 2
            b = b - 0.5 * (self.output(np.concatenate([b, b], axis=1)) - y0) / slope
        return np.concatenate([b, np.zeros_like(b)], axis=1)

    def output(self, x: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 1"]:
        b = x[:, :1]
        return b + self.peak * self.width * np.tanh(b / self.width)
