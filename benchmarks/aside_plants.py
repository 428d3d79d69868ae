"""Eight plants that nothing else in this project was made on or tried with, to see whether the
choices of `auto` come out covered on plants aside.

All have one input, one output, and come to rest by themselves at zero. Their numbers were written
down before the first run and not changed after it. `benchmarks/coverage_by_seed.py` runs them by
name. Sources: textbook equations, cited in each docstring.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.adversarial.plants.adversary import Adversary

States = Float[np.ndarray, "N n"]
Inputs = Float[np.ndarray, "N"]


@dataclass(frozen=True, kw_only=True)
class StirredReactor(Adversary):
    """Reaction of first order in a stirred tank whose inflow is the input: `T a' = (1 + share u)
    (feed - a) - k a` about its equilibrium, measured through a sensor's lag. Both gain and lag
    change with the inflow."""

    order = 2
    shown_by = "ordinary"

    tank_s: float = 0.8
    sensor_s: float = 0.2
    share: float = 0.7
    reaction: float = 1.5
    reach: float = 0.12
    settling_band: float = 0.006
    noise: float = 1e-6

    def rate(self, x: States, u: Inputs) -> States:
        y, a = x.T
        flow = 1 + self.share * np.tanh(u)
        rest = 1 / (1 + self.reaction)
        concentration = rest + a
        change = flow * (1 - concentration) - self.reaction * concentration
        return np.stack([(a - y) / self.sensor_s, change / self.tank_s], axis=1)


@dataclass(frozen=True, kw_only=True)
class InverseResponse(Adversary):
    """Two lags in parallel of opposite sign: the output first goes the wrong way (as the level of a
    boiler's drum), with a mild saturation of the input."""

    order = 2
    shown_by = "ordinary"

    slow_s: float = 0.6
    fast_s: float = 0.12
    opposite: float = 0.5
    full: float = 1.5

    def rate(self, x: States, u: Inputs) -> States:
        y, fast = x.T
        drive = self.full * np.tanh(u / self.full)
        slow = y + self.opposite * fast
        slow_change = ((1 + self.opposite) * drive - slow) / self.slow_s
        fast_change = (drive - fast) / self.fast_s
        return np.stack([slow_change - self.opposite * fast_change, fast_change], axis=1)


@dataclass(frozen=True, kw_only=True)
class FlexibleShaft(Adversary):
    """Motor and load on a flexible shaft with inner damping; the speed of the load is measured, and
    the load's bearing drags with the square of its speed."""

    order = 3
    shown_by = "ordinary"

    motor_inertia: float = 0.05
    load_inertia: float = 0.1
    stiffness: float = 20.0
    inner_damping: float = 0.3
    friction: float = 0.4
    drag: float = 0.3

    def rate(self, x: States, u: Inputs) -> States:
        load, motor, twist = x.T
        torque = self.stiffness * twist + self.inner_damping * (motor - load)
        braking = 0.5 * self.friction * load + self.drag * np.abs(load) * load
        load_change = (torque - braking) / self.load_inertia
        motor_change = (u - torque - 0.5 * self.friction * motor) / self.motor_inertia
        return np.stack([load_change, motor_change, motor - load], axis=1)


@dataclass(frozen=True, kw_only=True)
class EqualPercentageValve(Adversary):
    """Flow through a valve whose opening acts exponentially, `v = 2 (R^u - 1) / (R - 1/R)`, behind
    the actuator's lag, then a tank with a linear outflow."""

    order = 2
    shown_by = "ordinary"

    actuator_s: float = 0.15
    tank_s: float = 0.7
    ratio: float = 2.5

    def rate(self, x: States, u: Inputs) -> States:
        level, opening = x.T
        flow = 2 * (self.ratio ** np.clip(opening, -1.5, 1.5) - 1) / (self.ratio - 1 / self.ratio)
        return np.stack([(flow - level) / self.tank_s, (u - opening) / self.actuator_s], axis=1)


@dataclass(frozen=True, kw_only=True)
class BentSensor(Adversary):
    """Three equal lags read by a sensor whose curve flattens, `y = tanh(c x) / c`."""

    order = 3
    shown_by = "ordinary"

    lag_s: float = 0.25
    bend: float = 0.6

    def rate(self, x: States, u: Inputs) -> States:
        last, middle, first = x.T
        before = np.stack([middle, first, u], axis=1)
        return (before - np.stack([last, middle, first], axis=1)) / self.lag_s

    def output(self, x: States) -> Float[np.ndarray, "N 1"]:
        return np.tanh(self.bend * x[:, :1]) / self.bend

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> States:
        x = np.zeros((len(y0), self.order))
        x[:, 0] = np.arctanh(np.clip(self.bend * y0[:, 0], -0.95, 0.95)) / self.bend
        return x


@dataclass(frozen=True, kw_only=True)
class MagneticValve(Adversary):
    """Force of a coil that saturates, on a damped spring: `T i' = u - i`, `F = i / sqrt(1 + i^2)`,
    `y'' = w^2 (F - y) - 2 d w y'`."""

    order = 3
    shown_by = "ordinary"

    coil_s: float = 0.06
    natural_rad_per_s: float = 5.0
    damping: float = 0.35

    def rate(self, x: States, u: Inputs) -> States:
        y, speed, current = x.T
        force = current / np.sqrt(1 + current**2)
        w = self.natural_rad_per_s
        change = w**2 * (force - y) - 2 * self.damping * w * speed
        return np.stack([speed, change, (u - current) / self.coil_s], axis=1)


@dataclass(frozen=True, kw_only=True)
class TyreSideslip(Adversary):
    """Lateral motion of a car at one speed: yaw rate from the steering angle, with tyres whose side
    force saturates (single-track model, `F(a) = tanh(a)`)."""

    order = 2
    shown_by = "ordinary"

    yaw_s: float = 0.3
    slip_s: float = 0.4
    coupling: float = 0.5

    def rate(self, x: States, u: Inputs) -> States:
        yaw, slip = x.T
        front = np.tanh(u - slip - self.coupling * yaw)
        rear = np.tanh(slip - self.coupling * yaw)
        yaw_change = (front + rear - 0.5 * yaw) / self.yaw_s
        slip_change = (front - rear - 0.5 * slip - 0.3 * yaw) / self.slip_s
        return np.stack([yaw_change, slip_change], axis=1)


@dataclass(frozen=True, kw_only=True)
class SlowSpread(Adversary):
    """Heat in a rod of five cells, heated at one end and measured at the third; it loses more heat
    the hotter it is (radiation, linear and cubic)."""

    order = 5
    reading = 2
    shown_by = "ordinary"

    spread_per_s: float = 8.0
    loss_per_s: float = 0.6
    radiation: float = 0.5

    def rate(self, x: States, u: Inputs) -> States:
        left = np.concatenate([x[:, :1], x[:, :-1]], axis=1)
        right = np.concatenate([x[:, 1:], x[:, -1:]], axis=1)
        loss = self.loss_per_s * (x + self.radiation * x**3)
        change = self.spread_per_s * (left + right - 2 * x) - loss
        change[:, 0] += 3.0 * u
        return change


ASIDE: dict[str, type[Adversary]] = {
    "stirred_reactor": StirredReactor,
    "inverse_response": InverseResponse,
    "flexible_shaft": FlexibleShaft,
    "equal_percentage_valve": EqualPercentageValve,
    "bent_sensor": BentSensor,
    "magnetic_valve": MagneticValve,
    "tyre_sideslip": TyreSideslip,
    "slow_spread": SlowSpread,
}
