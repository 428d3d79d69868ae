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
        p = motor.motor_constants
        f = np.zeros((5, 5))
        coefficients = [-p.resistance, -p.k, 0.0, 0.0, v_eff]
        current_row = np.array(coefficients)
        f[0] = current_row * p.per_inductance
        f[3, 1:3] = 1.0, -1.0
        self.modes = modes
        self.limit = p.coulomb
        difference = -p.damping - p.motor_viscous
        of_motor = [p.k, difference, p.damping, -p.stiffness, 0.0]
        load_damping = -p.damping - p.load_viscous
        of_load = [0.0, p.damping, load_damping, p.stiffness, -load_nm]
        self.torque = np.array([
            of_motor,
            of_load,
        ])  # fmt: skip
        inertias = (motor.motor_inertia_kgm2, motor.load_inertia_kgm2)
        for body, inertia in enumerate(inertias):
            if modes[body] != 0:
                torque_row = self.torque[body]
                f[1 + body] = torque_row / inertia
                friction = modes[body] * p.coulomb / inertia
                f[1 + body, 4] -= friction
        self.f = f

    def at(self, z: Float[np.ndarray, "5"], t: float) -> Float[np.ndarray, "5"]:
        exponent = self.f * t
        transition = expm(exponent)
        return transition @ z

    def keeps(self, z: Float[np.ndarray, "5"], body: int) -> float:
        """Positive while the body stays in its mode: speed along its sign, or friction reserve
        while stuck."""
        if self.modes[body] != 0:
            signed_speed = self.modes[body] * z[1 + body]
            return float(signed_speed)
        torque = self.torque[body]
        size_of_torque = abs(torque @ z)
        difference = self.limit - size_of_torque
        return float(difference)


def _mode(speed: float, torque: float, limit: float) -> int:
    if speed != 0.0:
        return int(np.sign(speed))
    return 0 if abs(torque) <= limit else int(np.sign(torque))


def _end_within(flow: _Flow, z: Float[np.ndarray, "5"], body: int, span: float) -> float:
    """When the body leaves a mode it has left after `span`; a mode on its edge at 0 may end one
    tolerance later."""

    def keeps(t: float) -> float:
        state = flow.at(z, t)
        return flow.keeps(state, body)

    earliest = 0.0 if keeps(0.0) > 0.0 else SWITCH_TIME_TOLERANCE_S
    if keeps(earliest) < 0.0:
        return earliest
    end = brentq(keeps, earliest, span, xtol=SWITCH_TIME_TOLERANCE_S, rtol=1e-14)
    return float(end)


def _first_end(
    flow: _Flow, z: Float[np.ndarray, "5"], span: float, scan: float
) -> tuple[float, int] | None:
    """The first time within `span` at which a body leaves its mode, and which body; None if neither
    does."""
    looks_needed = np.ceil(span / scan)
    intervals = int(looks_needed)
    looks = max(1, intervals)
    generator = flow.f * (span / looks)
    transition = expm(generator)
    before = z
    for look in range(looks):
        after = transition @ before
        bodies = (0, 1)
        ends = []
        for body in bodies:
            if flow.keeps(after, body) < 0.0:
                end = _end_within(flow, before, body, span / looks)
                ends.append((end, body))
        if ends:
            t, body = min(ends)
            return look * span / looks + t, body
        before = after
    return None


def _period(
    motor: DCMotor, z: Float[np.ndarray, "5"], v: float, load: float
) -> tuple[Float[np.ndarray, "5"], list]:
    """One sampling period; returns the augmented state after it and the switch times within it."""
    limit = motor.motor_constants.coulomb
    t = 0.0
    ends: list[float] = []
    stuck = (0, 0)
    stuck_flow = _Flow(motor, stuck, v, load)
    torque = stuck_flow.torque
    modes = []
    for body in (0, 1):
        speed = z[1 + body]
        torque_of_body = float(torque[body] @ z)
        modes.append(_mode(speed, torque_of_body, limit))
    while True:
        both_modes = (modes[0], modes[1])
        flow = _Flow(motor, both_modes, v, load)
        span = motor.step_s - t
        scan = motor.step_s / SCANS_PER_STEP
        end = _first_end(flow, z, span, scan)
        if end is None:
            difference = motor.step_s - t
            last_state = flow.at(z, difference)
            return last_state, ends
        after, body = end
        z = flow.at(z, after)
        t = t + after
        z[1 + body] = 0.0
        torque_of_body = float(torque[body] @ z)
        slips = modes[body] != 0
        friction = limit if slips else 0.0
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
    dead_zone = motor.motor_constants.dead_zone
    voltage = u[:, 0]
    size_of_voltage = np.abs(voltage)
    difference = size_of_voltage - dead_zone
    effective = np.maximum(difference, 0.0)
    v_eff = np.sign(voltage) * effective
    z = np.append(x0, 1.0)
    states = [x0]
    times = []
    for k, v in enumerate(v_eff):
        load_now = load[k, 0]
        load_torque = float(load_now)
        z, ends = _period(motor, z, float(v), load_torque)
        state = z[:4]
        states.append(state.copy())
        times += [k * motor.step_s + t for t in ends]
    switch_times_s = np.array(times)
    states_at_samples = np.array(states)
    return ExactRun(x=states_at_samples, switch_times_s=switch_times_s)
