"""Play in the coupling: a servo turns a shaft that follows only when a gap has closed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary


@dataclass(frozen=True, kw_only=True)
class Play(Adversary):
    """`T m' = g u - m`, `h` follows `m` when `|m - h| = gap`, `T_l y' = h - y`: state `(y, m, h)`.

    At the excitation's amplitude the gap is a fiftieth of the stroke and hardly shows; near rest it
    is all there is.
    """

    order = 3
    shown_by = "validation records at a small part of the amplitude"

    gain: float
    motor_s: float
    load_s: float
    gap: float

    def rate(
        self, x: Float[np.ndarray, "N 3"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        y, m, h = x.T
        dm = (self.gain * u - m) / self.motor_s
        pushed = ((m - h >= self.gap) & (dm > 0)) | ((m - h <= -self.gap) & (dm < 0))
        return np.stack([(h - y) / self.load_s, dm, np.where(pushed, dm, 0.0)], axis=1)

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 3"]:
        return np.concatenate([y0, y0, y0], axis=1)
