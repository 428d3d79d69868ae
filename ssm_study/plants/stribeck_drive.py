"""Servo drive whose friction falls when it begins to move (Stribeck), with an amplifier that
saturates."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.plants.plant import (
    Disturbances,
    Equilibrium,
    Inputs,
    Outputs,
    Plant,
    States,
    field_property,
    refuse_wrong_signs,
)
from ssm_study.refusal import require
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class StribeckDrive(Plant):
    """Plant: servo drive with one inertia, Stribeck friction and a limited current.

        tau di/dt = sat(u) - i,    J dw/dt = K i - b w - F(w) - d
        F(w) = sgn(w) (Fc + (Fs - Fc) exp(-(w/ws)^2)),   at rest any torque up to Fs

    State `(i, w)`, input current command (A), output speed (rad/s), disturbance load torque (N m).
    Each substep solves the current exactly and thresholds the speed by what friction can take away:
    first order, and rest is exactly 0.0. `settling_band` in rad/s. Source of the friction:
    Armstrong-Helouvry, Dupont, Canudas de Wit 1994; its values are this project's.
    """

    inputs = (Channel(name="current_command", unit="A"),)
    outputs = (Channel(name="speed", unit="rad/s"),)
    states = (Channel(name="current", unit="A"), Channel(name="speed", unit="rad/s"))
    disturbances = (Channel(name="load_torque", unit="N m"),)
    initial_range = field_property("initial_speed_rad_per_s", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude_a", (1,))
    noise_variance = field_property("speed_noise_variance", (1,))

    current_lag_s: float
    current_limit_a: float
    torque_constant_nm_per_a: float
    inertia_kgm2: float
    viscous_nms_per_rad: float
    coulomb_torque_nm: float
    static_torque_nm: float
    stribeck_speed_rad_per_s: float
    step_s: float
    substeps: int
    initial_speed_rad_per_s: float
    settling_band: float
    amplitude_a: float
    clock_s: float
    speed_noise_variance: float

    def __post_init__(self) -> None:
        signs = (
            "viscous_nms_per_rad",
            "coulomb_torque_nm",
            "static_torque_nm",
            "speed_noise_variance",
        )
        refuse_wrong_signs(self, not_negative=signs)
        static_nm = self.static_torque_nm
        is_higher = static_nm >= self.coulomb_torque_nm
        problem = "below the Coulomb torque"
        require(is_higher, "static_torque_nm", static_nm, problem, "raise it")

    def equilibrium(self) -> Equilibrium:
        return Equilibrium(u=np.zeros(1), x=np.zeros(2), y=np.zeros(1))

    def equilibrium_states(self, y0: Outputs) -> States:
        return np.concatenate([np.zeros_like(y0), y0], axis=1)

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        h = self.step_s / self.substeps
        keep = np.exp(-h / self.current_lag_s)
        drive = np.clip(u[:, 0], -self.current_limit_a, self.current_limit_a)
        i = x[:, 0]
        w = x[:, 1]
        for _ in range(self.substeps):
            torque = self.torque_constant_nm_per_a * i - self.viscous_nms_per_rad * w - d[:, 0]
            frictionless = w + (h / self.inertia_kgm2) * torque
            friction = (h / self.inertia_kgm2) * self.friction_torque_nm(w)
            w = np.sign(frictionless) * np.maximum(np.abs(frictionless) - friction, 0.0)
            i = drive + (i - drive) * keep  # exact over the substep
        return np.stack([i, w], axis=1)

    def friction_torque_nm(self, w: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Magnitude of the Stribeck friction torque, in N m, at a given speed. It is `Fs` at rest
        and falls to `Fc`."""
        extra = self.static_torque_nm - self.coulomb_torque_nm
        fading = np.exp(-((w / self.stribeck_speed_rad_per_s) ** 2))
        return self.coulomb_torque_nm + extra * fading

    def output(self, x: States) -> Outputs:
        return x[:, 1:2]
