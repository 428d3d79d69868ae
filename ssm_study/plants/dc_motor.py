"""The nonlinear DC motor with a two-mass drive: the plant of the study."""

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ssm_study.plants.dc_motor_kernel import advance_batch
from ssm_study.plants.plant import Equilibrium, Plant, check_signs
from ssm_study.refusal import require
from ssm_study.signals import Channel


class MotorConstants(NamedTuple):
    """What the compiled kernel reads, SI units; reciprocals because it multiplies faster than it divides."""

    resistance: float
    per_inductance: float
    k: float
    per_motor_inertia: float
    per_load_inertia: float
    stiffness: float
    damping: float
    motor_viscous: float
    load_viscous: float
    coulomb: float
    dead_zone: float


@dataclass(frozen=True, kw_only=True)
class DCMotor(Plant):
    """Armature, motor shaft, elastic coupling, load; Coulomb friction that can hold each shaft still; input dead-zone.

        L_a di_a/dt = u_eff - R_a i_a - K_m w_m,          u_eff = v_a - sgn(v_a) v_dz, or 0 inside the dead-zone
        J_m dw_m/dt = K_m i_a - T_s - B_m w_m - a0 sgn(w_m)
        J_L dw_L/dt = T_s - B_L w_L - T_d - a0 sgn(w_L),   T_s = k_s (th_m - th_L) + B_s (w_m - w_L)

    State `(i_a, w_m, w_L, th_m - th_L)`, input voltage (V), output load speed (rad/s), disturbance load torque (N m).
    `sgn` is set-valued at zero: a shaft at rest stays at rest, exactly, while the other torques on it are within `a0`.
    Stepped by a Taylor series of order 4 with located switches, steps of at most `solver_step_s`; a speed that touches
    zero twice within one such step is not seen (`dc_motor_exact` sees it). `settling_band` in rad/s.
    Source: [Z26] sec. IV; Kara & Eker 2004.
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
        positive = ("resistance_ohm", "inductance_h", "torque_constant_nm_per_a", "motor_inertia_kgm2",
                    "load_inertia_kgm2", "shaft_stiffness_nm_per_rad", "step_s", "solver_step_s",
                    "initial_speed_rad_per_s", "settling_band", "amplitude_v", "clock_s")  # fmt: skip
        not_negative = ("shaft_damping_nms_per_rad", "motor_viscous_nms_per_rad", "load_viscous_nms_per_rad",
                        "coulomb_torque_nm", "dead_zone_v", "speed_noise_variance")  # fmt: skip
        check_signs(self, positive, not_negative)
        electrical_s = self.inductance_h / self.resistance_ohm
        require(
            self.solver_step_s <= electrical_s,
            "solver_step_s",
            self.solver_step_s,
            f"longer than the armature's time constant of {electrical_s:.3g} s, where the series turns unstable",
            "shorten it",
        )

    @property
    def initial_range(self) -> tuple[float, float]:
        return -self.initial_speed_rad_per_s, self.initial_speed_rad_per_s

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        return (self.amplitude_v,)

    @property
    def input_clock_s(self) -> float:
        return self.clock_s

    @property
    def noise_variance(self) -> tuple[float, ...]:
        return (self.speed_noise_variance,)

    @cached_property
    def constants(self) -> MotorConstants:
        return MotorConstants(
            resistance=float(self.resistance_ohm),
            per_inductance=1.0 / self.inductance_h,
            k=float(self.torque_constant_nm_per_a),
            per_motor_inertia=1.0 / self.motor_inertia_kgm2,
            per_load_inertia=1.0 / self.load_inertia_kgm2,
            stiffness=float(self.shaft_stiffness_nm_per_rad),
            damping=float(self.shaft_damping_nms_per_rad),
            motor_viscous=float(self.motor_viscous_nms_per_rad),
            load_viscous=float(self.load_viscous_nms_per_rad),
            coulomb=float(self.coulomb_torque_nm),
            dead_zone=float(self.dead_zone_v),
        )

    def equilibrium(self) -> Equilibrium:
        return Equilibrium(u=np.zeros(1), x=np.zeros(4), y=np.zeros(1))

    def states_at(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 4"]:
        """Both shafts turning at `y0`, no current, no twist."""
        still = np.zeros_like(y0)
        return np.concatenate([still, y0, y0, still], axis=1)

    def advance(
        self, x: Float[np.ndarray, "N 4"], u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N 1"]
    ) -> Float[np.ndarray, "N 4"]:
        substeps = ceil(self.step_s / self.solver_step_s - 1e-9)
        return advance_batch(self.constants, x, u, d, self.step_s / substeps, substeps)

    def output(self, x: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 1"]:
        return x[:, 2:3]

    def energy_j(self, x: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch"]:
        """`(L_a i_a^2 + J_m w_m^2 + J_L w_L^2 + k_s twist^2) / 2`: never grows without input or disturbance."""
        weights = (
            self.inductance_h,
            self.motor_inertia_kgm2,
            self.load_inertia_kgm2,
            self.shaft_stiffness_nm_per_rad,
        )
        return 0.5 * np.sum(np.array(weights) * x**2, axis=-1)
