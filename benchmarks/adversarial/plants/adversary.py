"""What all of these plants share: one input, one output, rest at zero, one right-hand side each."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.plants.integration import integrate_runge_kutta
from ssm_study.plants.plant import Equilibrium, Plant, field_property
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class Adversary(Plant):
    """`dx/dt = rate(x, u)`, `y = h(x)`, `h` the state number `reading` unless a plant says
    otherwise.

    `shown_by` names the record that shows the fault, written down before any sweep: `ordinary`
    where there is none.
    """

    inputs = (Channel(name="input", unit="V"),)
    outputs = (Channel(name="output", unit="1"),)
    disturbances = ()

    order: ClassVar[int]
    reading: ClassVar[int] = 0
    shown_by: ClassVar[str]

    step_s: float = 0.05
    substeps: int = 10
    settling_band: float = 0.05
    reach: float = 1.0
    amplitude: float = 1.0
    clock_s: float = 0.5
    noise: float = 1e-4

    @abstractmethod
    def rate(
        self, x: Float[np.ndarray, "N n"], u: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N n"]:
        """Right-hand side, inputs held."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return tuple(Channel(name=f"x{i}", unit="1") for i in range(self.order))

    initial_range = field_property("reach", (-1, 1))
    input_clock_s = field_property("clock_s")
    input_amplitude = field_property("amplitude", (1,))
    noise_variance = field_property("noise", (1,))

    def equilibrium(self) -> Equilibrium:
        return Equilibrium(u=np.zeros(1), x=np.zeros(self.order), y=np.zeros(1))

    def equilibrium_states(self, y0: Float[np.ndarray, "N 1"]) -> Float[np.ndarray, "N n"]:
        x = np.zeros((len(y0), self.order))
        x[:, self.reading] = y0[:, 0]
        return x

    def next_states(
        self,
        x: Float[np.ndarray, "N n"],
        u: Float[np.ndarray, "N 1"],
        d: Float[np.ndarray, "N q"],  # noqa: ARG002 - none acts here
    ) -> Float[np.ndarray, "N n"]:
        return integrate_runge_kutta(lambda z: self.rate(z, u[:, 0]), x, self.step_s, self.substeps)

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N 1"]:
        return x[:, self.reading : self.reading + 1]
