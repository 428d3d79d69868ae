"""Five plants with a steep gain near rest and a dead time, to try a rule that was made on others.

A loop on such a plant swings at an amplitude where the gain is large, while a broadband record
jitters over the steep piece and shows a smaller one. The rules that look for this were made on the
titration curves of `benchmarks/adversarial`; the shapes and numbers here were written down before
the first run and not changed after it. `benchmarks/coverage_designs.py` runs them by name.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary

States = Float[np.ndarray, "N n"]
Outputs = Float[np.ndarray, "N 1"]
Level = Float[np.ndarray, "N"]

BISECTIONS = 60


@dataclass(frozen=True, kw_only=True)
class SteepPlant(Adversary):
    """`lag_s b' = c - b`, `second_s c' = u(t - 3 h) - c`, `y = curve(b)` with an odd rising curve:
    state `(b, c, u_1, u_2, u_3)`, the last three in samples."""

    order = 5
    shown_by = "single sines"

    lag_s: float = 0.5
    second_s: float = 0.1

    @abstractmethod
    def curve(self, b: Level) -> Level:
        """Static output curve, steep at zero."""

    def rate(self, x: States, u: Float[np.ndarray, "N"]) -> States:
        moved = np.zeros_like(x)
        moved[:, 0] = (x[:, 1] - x[:, 0]) / self.lag_s
        moved[:, 1] = (u - x[:, 1]) / self.second_s
        return moved

    def next_states(
        self, x: States, u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N q"]
    ) -> States:
        moved = super().next_states(x, x[:, 4:], d)
        return np.column_stack([moved[:, :2], u[:, 0], x[:, 2:4]])

    def equilibrium_states(self, y0: Outputs) -> States:
        """States with a given output: `b` by bisection, everything else at rest."""
        low = np.full(len(y0), -1e3)
        high = np.full(len(y0), 1e3)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            is_above = self.curve(middle) > y0[:, 0]
            high = np.where(is_above, middle, high)
            low = np.where(is_above, low, middle)
        x = np.zeros((len(y0), self.order))
        x[:, 0] = (low + high) / 2
        return x

    def output(self, x: States) -> Outputs:
        return self.curve(x[:, 0])[:, None]


@dataclass(frozen=True, kw_only=True)
class LogarithmicProbe(SteepPlant):
    """A probe that reads the logarithm of a concentration, as for pH: `height asinh(b / width)`,
    slope eight at rest."""

    height: float = 0.24
    width: float = 0.03

    def curve(self, b: Level) -> Level:
        return self.height * np.arcsinh(b / self.width)


@dataclass(frozen=True, kw_only=True)
class RootMeter(SteepPlant):
    """A flow read from the square root of a pressure difference, rounded at zero: `b / (b^2 +
    width^2)^(1/4)`, slope ten at rest."""

    lag_s: float = 0.8
    width: float = 0.01

    def curve(self, b: Level) -> Level:
        return b / (b**2 + self.width**2) ** 0.25


@dataclass(frozen=True, kw_only=True)
class UnequalSwitch(SteepPlant):
    """A switch that is steeper on one side of rest: `b + height w tanh(b / w) / width`, `w` of each
    side; slope thirteen at rest."""

    lag_s: float = 0.4
    height: float = 0.6
    width: float = 0.05
    other: float = 0.15

    def curve(self, b: Level) -> Level:
        side = np.where(b > 0, self.width, self.other)
        return b + self.height * side / self.width * np.tanh(b / side)


@dataclass(frozen=True, kw_only=True)
class ResonantProbe(SteepPlant):
    """An arctangent behind a lightly damped resonance: `b + 2 height / pi atan(b / width)`, slope
    seven at rest."""

    natural_rad_per_s: float = 3.0
    damping: float = 0.5
    height: float = 0.4
    width: float = 0.04

    def rate(self, x: States, u: Float[np.ndarray, "N"]) -> States:
        moved = np.zeros_like(x)
        moved[:, 0] = x[:, 1]
        pull = u - x[:, 0]
        brake = 2 * self.damping / self.natural_rad_per_s * x[:, 1]
        moved[:, 1] = self.natural_rad_per_s**2 * (pull - brake)
        return moved

    def curve(self, b: Level) -> Level:
        return b + 2 * self.height / np.pi * np.arctan(b / self.width)


@dataclass(frozen=True, kw_only=True)
class SteepValve(SteepPlant):
    """A valve that opens abruptly: the curve acts on the input, before the dead time, so the
    model's input map can learn it; slope nine at rest."""

    lag_s: float = 0.6
    height: float = 0.4
    width: float = 0.05

    def curve(self, b: Level) -> Level:
        return b

    def rate(self, x: States, u: Float[np.ndarray, "N"]) -> States:
        opened = u + self.height * np.tanh(u / self.width)
        return super().rate(x, opened)


STEEP: dict[str, Any] = {
    "logarithmic_probe": LogarithmicProbe,
    "root_meter": RootMeter,
    "unequal_switch": UnequalSwitch,
    "resonant_probe": ResonantProbe,
    "steep_valve": SteepValve,
}
