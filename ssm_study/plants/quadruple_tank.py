"""Four tanks, two pumps, two level sensors: the field's two-input two-output laboratory plant."""

from dataclasses import dataclass

import numpy as np

from ssm_study.plants.integration import runge_kutta
from ssm_study.plants.plant import (
    Disturbances,
    Equilibrium,
    Inputs,
    Outputs,
    Plant,
    States,
    check_signs,
    stated,
)
from ssm_study.refusal import require
from ssm_study.signals import Channel

GRAVITY_CM_PER_S2 = 981.0
Gains = tuple[float, float] | list[float]
Four = tuple[float, float, float, float] | list[float]


@dataclass(frozen=True, kw_only=True)
class QuadrupleTank(Plant):
    """Pump 1 fills tanks 1 and 4, pump 2 fills 2 and 3; tank 3 drains into 1 and 4 into 2.

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
    initial_range = stated("initial_level_v", (-1, 1))
    input_clock_s = stated("clock_s")
    input_amplitude = stated("amplitude_v", (1, 1))
    noise_variance = stated("level_noise_variance", (1, 1))

    area_cm2: Four
    outlet_cm2: Four
    pump_cm3_per_vs: Gains
    share_below: Gains
    sensor_v_per_cm: float
    rest_pump_v: Gains
    step_s: float
    substeps: int
    initial_level_v: float
    settling_band: float
    amplitude_v: float
    clock_s: float
    level_noise_variance: float

    def __post_init__(self) -> None:
        for name, count in (
            ("area_cm2", 4),
            ("outlet_cm2", 4),
            ("pump_cm3_per_vs", 2),
            ("rest_pump_v", 2),
        ):
            values = getattr(self, name)
            require(
                len(values) == count,
                name,
                values,
                f"{count} numbers are needed",
                "give one per tank or pump",
            )
        shares = self.share_below
        require(
            len(shares) == 2 and max(shares) < 1, "share_below", shares, "not in (0, 1)", "use 0.6"
        )
        check_signs(self, not_negative=("level_noise_variance",))

    def equilibrium(self) -> Equilibrium:
        """Each outlet passes what flows in: `a_i sqrt(2 g h_i) = inflow_i`."""
        u = np.array(self.rest_pump_v, dtype=np.float64)
        into = self._pumped(u[None])[0]
        flow = into + np.array(
            [into[2], into[3], 0.0, 0.0]
        )  # the upper tanks drain into the lower ones
        x = (flow / np.array(self.outlet_cm2)) ** 2 / (2 * GRAVITY_CM_PER_S2)
        return Equilibrium(u=u, x=x, y=self.output(x[None])[0])

    def states_at(self, y0: Outputs) -> States:
        """The lower levels as asked, the upper ones at rest."""
        upper = np.tile(self.equilibrium().x[2:], (len(y0), 1))
        return np.concatenate([y0 / self.sensor_v_per_cm, upper], axis=1)

    def advance(self, x: States, u: Inputs, d: Disturbances) -> States:
        into = self._pumped(u)
        into[:, :2] += d
        return np.maximum(
            runge_kutta(lambda h: self._rate(h, into), x, self.step_s, self.substeps), 0.0
        )

    def _rate(self, h: States, into: States) -> States:
        out = np.array(self.outlet_cm2) * np.sqrt(
            2 * GRAVITY_CM_PER_S2 * np.maximum(h, 0.0)
        )  # Torricelli
        fallen = np.concatenate([out[:, 2:], np.zeros_like(out[:, 2:])], axis=1)
        return (into + fallen - out) / np.array(self.area_cm2)

    def _pumped(self, u: Inputs) -> States:
        """Flow from the pumps into each tank, cm^3/s; a negative voltage pumps nothing."""
        flow = np.array(self.pump_cm3_per_vs) * np.maximum(u, 0.0)
        below = np.array(self.share_below)
        return np.concatenate([below * flow, ((1 - below) * flow)[:, ::-1]], axis=1)

    def output(self, x: States) -> Outputs:
        return self.sensor_v_per_cm * x[:, :2]
