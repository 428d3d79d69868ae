"""A positioning servo with dry friction: its physical parameters from a record, its motion exact
between samples."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import butter, filtfilt

VELOCITY_BAND_HZ = (
    60.0  # of the motion: above it the encoder's quantisation dominates its derivatives
)
FORCE_BAND_HZ = (
    20.0  # of the regression: one filter on both sides, so that the parameters stay what they are
)
AT_REST_M_PER_S = 2e-3  # slower samples say nothing about the sign of the friction


@dataclass(frozen=True, kw_only=True)
class Servo:
    """`mass q'' = force_per_volt u - offset - viscous q' - coulomb sgn(q')`, sticking where the
    force is too small.

    SI units. Source: Janot, Gautier & Brunot (2019), the model of the electro-mechanical
    positioning system.
    """

    mass: float
    viscous: float
    coulomb: float
    offset: float
    force_per_volt: float

    def step(self, q: float, v: float, volt: float, step_s: float) -> tuple[float, float]:
        """Position and velocity after `step_s` under a held voltage: exact, sign changes located in
        closed form."""
        force = self.force_per_volt * volt - self.offset
        while step_s > 0.0:
            if v == 0.0 and abs(force) <= self.coulomb:
                return q, v
            goal = (force - math.copysign(self.coulomb, v if v != 0.0 else force)) / self.viscous
            lag = self.mass / self.viscous
            ends = (
                v != 0.0 and v * goal < 0.0
            )  # the velocity heads for the other sign: it passes zero
            stop = lag * math.log1p(-v / goal) if ends else math.inf
            span = min(step_s, stop)
            decay = math.exp(-span / lag)
            q += goal * span + (v - goal) * lag * (1.0 - decay)
            v = 0.0 if stop <= step_s else goal + (v - goal) * decay
            step_s -= span
        return q, v


def fitted(
    volt: Float[np.ndarray, "T"],
    position: Float[np.ndarray, "T"],
    step_s: float,
    force_per_volt: float,
) -> Servo:
    """The servo of a record: least squares of the force on acceleration, velocity, its sign and
    one."""
    motion = _low_pass(position, VELOCITY_BAND_HZ, step_s)
    velocity = np.gradient(motion, step_s)
    columns = [np.gradient(velocity, step_s), velocity, np.sign(velocity), np.ones_like(velocity)]
    moving = np.abs(velocity) > AT_REST_M_PER_S
    both = np.stack([*columns, force_per_volt * volt], axis=1) * moving[:, None]
    smooth = np.stack([_low_pass(column, FORCE_BAND_HZ, step_s) for column in both.T], axis=1)
    mass, viscous, coulomb, offset = np.linalg.lstsq(smooth[:, :4], smooth[:, 4], rcond=None)[
        0
    ].tolist()
    return Servo(
        mass=mass, viscous=viscous, coulomb=coulomb, offset=offset, force_per_volt=force_per_volt
    )


def _low_pass(
    signal: Float[np.ndarray, "T"], band_hz: float, step_s: float
) -> Float[np.ndarray, "T"]:
    """Zero phase, so that force and motion stay aligned."""
    b, a = butter(4, 2.0 * band_hz * step_s)
    return filtfilt(b, a, signal)


def tracked(
    servo: Servo,
    reference: Float[np.ndarray, "T"],
    disturbance: Float[np.ndarray, "T"],
    gains: tuple[float, float],
    step_s: float,
) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """Voltage and position while `u = kv (kp (r - q) - dq/dt) + disturbance` tracks `reference`
    from rest at its start.

    `gains` are `(kp, kv)`; the derivative is the backward difference, as the record's own
    controller takes it.
    """
    kp, kv = gains
    q = float(reference[0])
    v = 0.0
    before = float(reference[0])
    volt = np.empty(len(reference))
    position = np.empty(len(reference))
    for k, (target, added) in enumerate(zip(reference.tolist(), disturbance.tolist(), strict=True)):
        position[k] = q
        volt[k] = kv * (kp * (target - q) - (q - before) / step_s) + added
        before = q
        q, v = servo.step(q, v, float(volt[k]), step_s)
    return volt, position
