"""Nonlinear DC motor with two masses, the main example plant of this project."""

from collections import namedtuple
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np

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

# What the compiled kernel reads, SI units; reciprocals because it multiplies faster than it
# divides.
MotorConstants = namedtuple(
    "MotorConstants",
    "resistance per_inductance k per_motor_inertia per_load_inertia "
    "stiffness damping motor_viscous load_viscous coulomb dead_zone",
)


NOT_NEGATIVE = (
    "shaft_damping_nms_per_rad",
    "motor_viscous_nms_per_rad",
    "load_viscous_nms_per_rad",
    "coulomb_torque_nm",
    "dead_zone_v",
    "speed_noise_variance",
)


@dataclass(frozen=True, kw_only=True)
class DCMotor(Plant):
    """Plant: DC motor that drives a load through an elastic coupling, with Coulomb friction.

    Coulomb friction can hold each shaft still; the input has a dead-zone.

        L_a di_a/dt = u_eff - R_a i_a - K_m w_m,          u_eff = v_a - sgn(v_a) v_dz, or 0 inside
        the dead-zone
        J_m dw_m/dt = K_m i_a - T_s - B_m w_m - a0 sgn(w_m)
        J_L dw_L/dt = T_s - B_L w_L - T_d - a0 sgn(w_L),   T_s = k_s (th_m - th_L) + B_s (w_m - w_L)

    State `(i_a, w_m, w_L, th_m - th_L)`, input voltage (V), output load speed (rad/s), disturbance
    load torque (N m). `sgn` is set-valued at zero: a shaft at rest stays at rest, exactly, while
    the other torques on it are within `a0`. Stepped by a Taylor series of order 4 with located
    switches, steps of at most `solver_step_s`; a speed that touches zero twice within one such step
    is not seen (`tests/dc_motor_exact.py` does). `settling_band` in rad/s. Source: [Z26] sec. IV;
    Kara & Eker 2004.
    """

    inputs = (Channel(name="armature_voltage", unit="V"),)
    outputs = (Channel(name="load_speed", unit="rad/s"),)
    states = (
        Channel(name="armature_current", unit="A"),
        Channel(name="motor_speed", unit="rad/s"),
        Channel(name="load_speed", unit="rad/s"),
        Channel(name="shaft_twist", unit="rad"),
    )
    disturbances = (Channel(name="load_torque", unit="N m"),)
    initial_range = field_property("initial_speed_rad_per_s", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude_v", (1,))
    noise_variance = field_property("speed_noise_variance", (1,))

    resistance_ohm: float
    inductance_h: float
    torque_constant_nm_per_a: float
    motor_inertia_kgm2: float
    load_inertia_kgm2: float
    shaft_stiffness_nm_per_rad: float
    shaft_damping_nms_per_rad: float
    motor_viscous_nms_per_rad: float
    load_viscous_nms_per_rad: float
    coulomb_torque_nm: float
    dead_zone_v: float
    step_s: float
    solver_step_s: float
    initial_speed_rad_per_s: float
    settling_band: float
    amplitude_v: float
    clock_s: float
    speed_noise_variance: float

    def __post_init__(self) -> None:
        refuse_wrong_signs(self, not_negative=NOT_NEGATIVE)
        step_s = self.solver_step_s
        electrical_s = self.inductance_h / self.resistance_ohm
        problem = (
            f"longer than the armature's time constant of {electrical_s:.3g} s, where the series "
            "turns unstable"
        )
        require(step_s <= electrical_s, "solver_step_s", step_s, problem, "shorten it")

    @cached_property
    def motor_constants(self) -> MotorConstants:
        """Physical constants of the motor in the form that the compiled simulation takes."""
        return MotorConstants(
            resistance=float(self.resistance_ohm),
            per_inductance=float(1.0 / self.inductance_h),
            k=float(self.torque_constant_nm_per_a),
            per_motor_inertia=float(1.0 / self.motor_inertia_kgm2),
            per_load_inertia=float(1.0 / self.load_inertia_kgm2),
            stiffness=float(self.shaft_stiffness_nm_per_rad),
            damping=float(self.shaft_damping_nms_per_rad),
            motor_viscous=float(self.motor_viscous_nms_per_rad),
            load_viscous=float(self.load_viscous_nms_per_rad),
            coulomb=float(self.coulomb_torque_nm),
            dead_zone=float(self.dead_zone_v),
        )

    def equilibrium(self) -> Equilibrium:
        return Equilibrium(u=np.zeros(1), x=np.zeros(4), y=np.zeros(1))

    def equilibrium_states(self, y0: Outputs) -> States:
        """States of the motor with both shafts at a given speed, no current and no twist."""
        still = np.zeros_like(y0)
        return np.concatenate([still, y0, y0, still], axis=1)

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        # Imported here: numba takes a while to load, and describing a motor does without.
        from ssm_study.plants.dc_motor_kernel import advance_batch

        substeps = ceil(self.step_s / self.solver_step_s - 1e-9)
        substep_s = self.step_s / substeps
        # Contiguous: for every other layout of the three numba would compile the kernel once more.
        arrays = [np.ascontiguousarray(array) for array in (x, u, d)]
        return advance_batch(self.motor_constants, *arrays, substep_s, substeps)

    def output(self, x: States) -> Outputs:
        return x[:, 2:3]
