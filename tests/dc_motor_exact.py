"""The event-accurate motor: a matrix exponential in each stick/slip mode, switch times by root
finding.

An oracle for `DCMotor`, sharing its parameters and nothing else: it is slow, and right to rounding.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm
from scipy.optimize import brentq

from ssm_study.plants.dc_motor import DCMotor

SWITCH_TIME_TOLERANCE_S = 1e-12  # asked of the root finder; the promise is 1e-10 s
SCANS_PER_STEP = 64  # looks per sampling period for a mode that ends and resumes in between

Modes = tuple[int, int]  # of motor shaft and load: -1, +1 slipping that way, 0 stuck


@dataclass(frozen=True, kw_only=True)
class ExactRun:
    """States at the sampling instants (`T + 1`, the last one after the last input) and the times at
    which modes end."""

    x: Float[np.ndarray, "T 4"]
    switch_times_s: Float[np.ndarray, "S"]


class _Flow:
    """`d/dt (x, 1) = F (x, 1)` in one mode, held input and disturbance."""

    def __init__(self, motor: DCMotor, modes: Modes, v_eff: float, load_nm: float) -> None:
        p = motor.constants
        f = np.zeros((5, 5))
        current_row = np.array([-p.resistance, -p.k, 0.0, 0.0, v_eff])
        f[0] = current_row * p.per_inductance
        f[3, 1:3] = 1.0, -1.0
        self.modes = modes
        self.limit = p.coulomb
        difference = -p.damping - p.motor_viscous
        of_motor = [p.k, difference, p.damping, -p.stiffness, 0.0]
        of_load = [0.0, p.damping, -p.damping - p.load_viscous, p.stiffness, -load_nm]
        self.torque = np.array([
            of_motor,
            of_load,
        ])  # fmt: skip
        inertias = (motor.motor_inertia_kgm2, motor.load_inertia_kgm2)
        for body, inertia in enumerate(inertias):
            if modes[body] != 0:
                f[1 + body] = self.torque[body] / inertia
                f[1 + body, 4] -= modes[body] * p.coulomb / inertia
        self.f = f

    def at(self, z: Float[np.ndarray, "5"], t: float) -> Float[np.ndarray, "5"]:
        return expm(self.f * t) @ z

    def keeps(self, z: Float[np.ndarray, "5"], body: int) -> float:
        """Positive while the body stays in its mode: speed along its sign, or friction reserve
        while stuck."""
        if self.modes[body] != 0:
            return float(self.modes[body] * z[1 + body])
        difference = self.limit - abs(self.torque[body] @ z)
        return float(difference)


def _mode(speed: float, torque: float, limit: float) -> int:
    if speed != 0.0:
        return int(np.sign(speed))
    return 0 if abs(torque) <= limit else int(np.sign(torque))


def _end_within(flow: _Flow, z: Float[np.ndarray, "5"], body: int, span: float) -> float:
    """When the body leaves a mode it has left after `span`; a mode on its edge at 0 may end one
    tolerance later."""

    def keeps(t: float) -> float:
        return flow.keeps(flow.at(z, t), body)

    earliest = 0.0 if keeps(0.0) > 0.0 else SWITCH_TIME_TOLERANCE_S
    if keeps(earliest) < 0.0:
        return earliest
    return float(brentq(keeps, earliest, span, xtol=SWITCH_TIME_TOLERANCE_S, rtol=1e-14))


def _first_end(
    flow: _Flow, z: Float[np.ndarray, "5"], span: float, scan: float
) -> tuple[float, int] | None:
    """The first time within `span` at which a body leaves its mode, and which body; None if neither
    does."""
    intervals = int(np.ceil(span / scan))
    looks = max(1, intervals)
    transition = expm(flow.f * (span / looks))
    before = z
    for look in range(looks):
        after = transition @ before
        bodies = (0, 1)
        ends = [
            (_end_within(flow, before, body, span / looks), body)
            for body in bodies
            if flow.keeps(after, body) < 0.0
        ]
        if ends:
            t, body = min(ends)
            return look * span / looks + t, body
        before = after
    return None


def _period(
    motor: DCMotor, z: Float[np.ndarray, "5"], v: float, load: float
) -> tuple[Float[np.ndarray, "5"], list]:
    """One sampling period; returns the augmented state after it and the switch times within it."""
    limit = motor.constants.coulomb
    t = 0.0
    ends: list[float] = []
    torque = _Flow(motor, (0, 0), v, load).torque
    modes = [_mode(z[1 + b], float(torque[b] @ z), limit) for b in (0, 1)]
    while True:
        flow = _Flow(motor, (modes[0], modes[1]), v, load)
        span = motor.step_s - t
        scan = motor.step_s / SCANS_PER_STEP
        end = _first_end(flow, z, span, scan)
        if end is None:
            difference = motor.step_s - t
            return flow.at(z, difference), ends
        after, body = end
        z = flow.at(z, after)
        t = t + after
        z[1 + body] = 0.0
        torque_of_body = float(torque[body] @ z)
        friction = limit if modes[body] != 0 else 0.0
        modes[body] = _mode(0.0, torque_of_body, friction)
        ends.append(t)


def simulate_exactly(
    motor: DCMotor,
    u: Float[np.ndarray, "T 1"],
    x0: Float[np.ndarray, "4"],
    d: Float[np.ndarray, "T 1"] | None = None,
) -> ExactRun:
    """`x[k]` for `k = 0 .. T` under voltage `u` and load torque `d`, switch times to 1e-10 s."""
    load = np.zeros_like(u) if d is None else d
    dead_zone = motor.constants.dead_zone
    difference = np.abs(u[:, 0]) - dead_zone
    v_eff = np.sign(u[:, 0]) * np.maximum(difference, 0.0)
    z = np.append(x0, 1.0)
    states = [x0]
    times = []
    for k, v in enumerate(v_eff):
        z, ends = _period(motor, z, float(v), float(load[k, 0]))
        states.append(z[:4].copy())
        times += [k * motor.step_s + t for t in ends]
    switch_times_s = np.array(times)
    return ExactRun(x=np.array(states), switch_times_s=switch_times_s)
