"""Two cascaded water tanks that can overflow, a public benchmark."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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


@dataclass(frozen=True, kw_only=True)
class CascadedTanks(Plant):
    """Plant of two water tanks in cascade, which empty by Torricelli's law and can overflow.

        dx1/dt = k4 u - k1 sqrt(x1),                       x1 <= brim, the excess spills
        dx2/dt = k2 sqrt(x1) - k3 sqrt(x2) + k5 spill + d,  x2 <= brim, and what spills here is lost

    State the levels (V of the level sensors), input pump voltage (V, negative ones pump nothing),
    output the lower level, disturbance an inflow to the lower tank (V/s). `outflow_upper,
    inflow_lower, outflow_lower` are k1, k2, k3 (sqrt(V)/s), `pump_gain` k4 (1/s), `spill_share` k5
    (pure); `settling_band` in V. Source: Schoukens et al. 2016.
    """

    inputs = (Channel(name="pump_voltage", unit="V"),)
    outputs = (Channel(name="lower_level", unit="V"),)
    states = (Channel(name="upper_level", unit="V"), Channel(name="lower_level", unit="V"))
    disturbances = (Channel(name="lower_inflow", unit="V/s"),)
    initial_range = field_property("initial_level_v", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude_v", (1,))
    noise_variance = field_property("level_noise_variance", (1,))

    outflow_upper: float
    inflow_lower: float
    outflow_lower: float
    pump_gain: float
    spill_share: float
    brim_v: float
    rest_pump_v: float
    step_s: float
    substeps: int
    initial_level_v: float
    settling_band: float
    amplitude_v: float
    clock_s: float
    level_noise_variance: float

    def __post_init__(self) -> None:
        refuse_wrong_signs(self, not_negative=("level_noise_variance", "spill_share"))
        share = self.spill_share
        remedy = "use 0 if nothing falls into the lower tank"
        require(share <= 1, "spill_share", share, "a share lies in [0, 1]", remedy)
        stays = (self.equilibrium().x < self.brim_v).all()
        require(stays, "rest_pump_v", self.rest_pump_v, "the tanks overflow at rest", "lower it")

    def equilibrium(self) -> Equilibrium:
        upper = (self.pump_gain * self.rest_pump_v / self.outflow_upper) ** 2
        lower = upper * (self.inflow_lower / self.outflow_lower) ** 2  # Torricelli at both outlets
        u = np.array([self.rest_pump_v])
        return Equilibrium(u=u, x=np.array([upper, lower]), y=np.array([lower]))

    def equilibrium_states(self, y0: Outputs) -> States:
        """States of the tanks for given lower levels, with the upper tank in equilibrium."""
        upper = np.full_like(y0, self.equilibrium().x[0])
        return np.concatenate([upper, y0], axis=1)

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        pumped = self.pump_gain * np.maximum(u[:, 0], 0.0)  # a pump does not suck
        substep_s = self.step_s / self.substeps

        def level_rates(levels: States) -> States:
            """Time derivatives of both water levels under constant pump input."""
            return self._level_rates(levels, pumped, d[:, 0])

        for _ in range(self.substeps):  # the brim is enforced after each substep
            x = integrate_runge_kutta(level_rates, x, substep_s, 1)
            x = np.clip(x, 0.0, self.brim_v)
        return x

    def _level_rates(
        self, x: States, pumped: Float[np.ndarray, "N"], d: Float[np.ndarray, "N"]
    ) -> States:
        """Time derivatives of both water levels for given levels, pump flow and disturbance."""
        roots = np.sqrt(np.clip(x, 0.0, self.brim_v))
        root_upper = roots[:, 0]
        root_lower = roots[:, 1]
        surplus = pumped - self.outflow_upper * root_upper
        spills = x[:, 0] >= self.brim_v
        spill = np.where(spills, np.maximum(surplus, 0.0), 0.0)
        upper = np.where(spills, np.minimum(surplus, 0.0), surplus)
        through_outlets = self.inflow_lower * root_upper - self.outflow_lower * root_lower
        lower = through_outlets + self.spill_share * spill + d
        return np.stack([upper, lower], axis=1)

    def output(self, x: States) -> Outputs:
        return x[:, 1:2]
