"""Quadruple tank with two pumps and two level sensors, a common laboratory plant with two inputs
and two outputs."""

from dataclasses import dataclass

import numpy as np

from ssm_study.plants.integration import integrate_runge_kutta
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

GRAVITY_CM_PER_S2 = 981.0
PerPump = tuple[float, float] | list[float]
PerTank = tuple[float, float, float, float] | list[float]
LENGTHS = {"area_cm2": 4, "outlet_cm2": 4, "pump_cm3_per_vs": 2, "rest_pump_v": 2}


@dataclass(frozen=True, kw_only=True)
class QuadrupleTank(Plant):
    """Plant of four coupled water tanks, filled by two pumps.

    Tank 3 drains into 1 and 4 into 2.

        A_i dh_i/dt = inflows - a_i sqrt(2 g h_i);  pump j gives k_j v_j: gamma_j of it below, the
        rest across

    State the levels (cm), inputs pump voltages (V), outputs the lower levels as sensor voltages
    (V), disturbances inflows to the lower tanks (cm^3/s); `settling_band` in V. Source: Johansson
    2000, minimum-phase setting.
    """

    inputs = (Channel(name="pump_1_voltage", unit="V"), Channel(name="pump_2_voltage", unit="V"))
    outputs = (Channel(name="level_1_voltage", unit="V"), Channel(name="level_2_voltage", unit="V"))
    states = tuple(Channel(name=f"level_{i}", unit="cm") for i in (1, 2, 3, 4))
    disturbances = (
        Channel(name="inflow_1", unit="cm^3/s"),
        Channel(name="inflow_2", unit="cm^3/s"),
    )
    initial_range = field_property("initial_level_v", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude_v", (1, 1))
    noise_variance = field_property("level_noise_variance", (1, 1))

    area_cm2: PerTank
    outlet_cm2: PerTank
    pump_cm3_per_vs: PerPump
    share_below: PerPump
    sensor_v_per_cm: float
    rest_pump_v: PerPump
    step_s: float
    substeps: int
    initial_level_v: float
    settling_band: float
    amplitude_v: float
    clock_s: float
    level_noise_variance: float

    def __post_init__(self) -> None:
        for name, count in LENGTHS.items():
            values = getattr(self, name)
            problem = f"{count} numbers are needed"
            require(len(values) == count, name, values, problem, "give one per tank or pump")
        shares = self.share_below
        are_shares = len(shares) == 2 and max(shares) < 1
        require(are_shares, "share_below", shares, "must be two shares below 1", "use 0.6")
        refuse_wrong_signs(self, not_negative=("level_noise_variance",))

    def equilibrium(self) -> Equilibrium:
        """Equilibrium of the four tanks, at which the outflow of each tank equals its inflow."""
        u = np.array(self.rest_pump_v, dtype=np.float64)
        into = self._pump_flows(u[None])[0]
        from_upper = np.array([into[2], into[3], 0.0, 0.0])  # upper tanks drain into lower ones
        flow = into + from_upper
        x = (flow / np.array(self.outlet_cm2)) ** 2 / (2 * GRAVITY_CM_PER_S2)
        return Equilibrium(u=u, x=x, y=self.output(x[None])[0])

    def equilibrium_states(self, y0: Outputs) -> States:
        """States of the four tanks for given lower levels, with the upper tanks in equilibrium."""
        upper = np.tile(self.equilibrium().x[2:], (len(y0), 1))
        lower = y0 / self.sensor_v_per_cm
        return np.concatenate([lower, upper], axis=1)

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        into = self._pump_flows(u)
        into[:, :2] += d

        def level_rates(levels: States) -> States:
            """Time derivatives of the four water levels under constant pump input."""
            return self._level_rates(levels, into)

        levels = integrate_runge_kutta(level_rates, x, self.step_s, self.substeps)
        return np.maximum(levels, 0.0)

    def _level_rates(self, h: States, into: States) -> States:
        """Time derivatives of the four water levels for given levels and inflows."""
        speed = np.sqrt(2 * GRAVITY_CM_PER_S2 * np.maximum(h, 0.0))  # Torricelli
        out = np.array(self.outlet_cm2) * speed
        out_of_upper = out[:, 2:]
        from_above = np.concatenate([out_of_upper, np.zeros_like(out_of_upper)], axis=1)
        return (into + from_above - out) / np.array(self.area_cm2)

    def _pump_flows(self, u: Inputs) -> States:
        """Flows from both pumps into each of the four tanks, in cm^3/s. A negative voltage pumps
        nothing."""
        flow = np.array(self.pump_cm3_per_vs) * np.maximum(u, 0.0)
        share = np.array(self.share_below)
        into_lower = share * flow
        into_upper = ((1 - share) * flow)[:, ::-1]
        return np.concatenate([into_lower, into_upper], axis=1)

    def output(self, x: States) -> Outputs:
        return self.sensor_v_per_cm * x[:, :2]
