"""One heater of the temperature control laboratory (Arduino), its model or the board itself:
radiation makes the gain
of a hot one fall."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from ssm_study.plants.integration import integrate_runge_kutta
from ssm_study.plants.plant import Equilibrium, Plant, field_property, refuse_wrong_signs
from ssm_study.refusal import require
from ssm_study.signals import Channel
from tclab_study import board

STEFAN_BOLTZMANN = 5.67e-8  # W/(m^2 K^4)
ZERO_C_K = 273.15


@dataclass(frozen=True, kw_only=True)
class TemperatureLab(Plant):
    """Energy balance of a transistor and the thermistor glued to it.

        m c dT/dt = U A (T_a - T) + eps sigma A (T_a^4 - T^4) + a Q + d,     tau dT_s/dt = T - T_s,
           0 <= Q <= 100 %

    State `(T, T_s)` in degrees C, input the heater's duty Q (%), output T_s, disturbance a heat
    flow (W).
    `transfer_w_per_m2k` U, `emissivity` eps (pure), `heater_w_per_percent` a; `settling_band` in K.
    Source:
    Oliveira & Hedengren, An APMonitor temperature lab PID control experiment for undergraduate
    students, ETFA 2019.

    With `hardware` every sample is one of the board (`board.Board`), in real time: one case after
    another from where it
    is; both states read its sensor, no disturbance acts but its own, and `air_c` must be the
    room's.
    """

    inputs = (Channel(name="heater", unit="%"),)
    outputs = (Channel(name="temperature", unit="degC"),)
    states = (Channel(name="transistor", unit="degC"), Channel(name="sensor", unit="degC"))
    disturbances = (Channel(name="heat_flow", unit="W"),)

    mass_kg: float
    heat_capacity_j_per_kgk: float
    transfer_w_per_m2k: float
    area_m2: float
    emissivity: float
    heater_w_per_percent: float
    sensor_time_s: float
    air_c: float
    rest_percent: float
    amplitude_percent: float
    clock_s: float
    initial_offset_k: float
    temperature_noise_variance: float
    step_s: float
    settling_band: float
    hardware: bool = False

    def __post_init__(self) -> None:
        may_be_zero = ("hardware", "air_c", "emissivity", "temperature_noise_variance")
        refuse_wrong_signs(
            self, tuple(name for name in vars(self) if name not in may_be_zero), may_be_zero[2:]
        )
        require(
            self.rest_percent <= 100,
            "rest_percent",
            self.rest_percent,
            "the heater ends at 100 %",
            "use 30",
        )

    @property
    def is_physical(self) -> bool:
        return self.hardware

    def stop(self) -> None:
        if self.hardware:
            board.release()

    initial_range = field_property("initial_offset_k", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude_percent", (1,))

    @property
    def noise_variance(self) -> tuple[float, ...]:
        return (
            0.0 if self.hardware else self.temperature_noise_variance,
        )  # the board's own is in what it reads

    def equilibrium(self) -> Equilibrium:
        heated = self.heater_w_per_percent * self.rest_percent
        hot = brentq(
            lambda t: self._lost(t) + heated,
            self.air_c,
            self.air_c + heated / self._transfer + 1.0,
            xtol=1e-13,
        )
        return Equilibrium(
            u=np.array([self.rest_percent]), x=np.array([hot, hot]), y=np.array([hot])
        )

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N 2"]:
        """Transistor and sensor as warm as each other; of the board as warm as it is."""
        if self.hardware:
            y0 = np.full((len(y0), 1), board.attached().read())
        return np.concatenate([y0, y0], axis=1)

    def simulate(
        self,
        u: Float[np.ndarray, "N T 1"],
        x0: Float[np.ndarray, "N 2"] | None = None,
        d: Float[np.ndarray, "N T 1"] | None = None,
    ) -> tuple[Float[np.ndarray, "N T 2"], Float[np.ndarray, "N T 1"]]:
        """On the board one record after another, each from where the one before left it."""
        if not self.hardware:
            return super().simulate(u, x0, d)
        try:
            found = [
                super(TemperatureLab, self).simulate(
                    one[None], self.equilibrium_states(np.zeros((1, 1)))
                )
                for one in u
            ]
        finally:
            self.stop()
        x, y = zip(*found, strict=True)
        return np.concatenate(x), np.concatenate(y)

    def next_states(
        self, x: Float[np.ndarray, "N 2"], u: Float[np.ndarray, "N 1"], d: Float[np.ndarray, "N 1"]
    ) -> Float[np.ndarray, "N 2"]:
        if self.hardware:
            require(
                len(x) == 1,
                "loop.initial_conditions",
                len(x),
                "a board runs one case at a time",
                "use 1",
            )
            return np.full((1, 2), board.attached().hold(float(u[0, 0]), self.step_s))
        heat = self.heater_w_per_percent * np.clip(u[:, 0], 0.0, 100.0) + d[:, 0]
        return integrate_runge_kutta(
            lambda z: self._level_rates(z, heat), x, self.step_s, substeps=4
        )

    def _level_rates(
        self, x: Float[np.ndarray, "N 2"], heat: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 2"]:
        transistor, sensor = x.T
        warming = (heat + self._lost(transistor)) / (self.mass_kg * self.heat_capacity_j_per_kgk)
        return np.stack([warming, (transistor - sensor) / self.sensor_time_s], axis=1)

    def output(self, x: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 1"]:
        return x[:, 1:2]

    @property
    def _transfer(self) -> float:
        return self.transfer_w_per_m2k * self.area_m2

    def _lost(self, t: Float[np.ndarray, "N"] | float) -> Float[np.ndarray, "N"] | float:
        radiated = (self.air_c + ZERO_C_K) ** 4 - (t + ZERO_C_K) ** 4
        return (
            self._transfer * (self.air_c - t)
            + self.emissivity * STEFAN_BOLTZMANN * self.area_m2 * radiated
        )
