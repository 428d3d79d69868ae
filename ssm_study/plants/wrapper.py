"""A plant around a plant: everything is the inner plant's unless a wrapper says otherwise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.plants.plant import Equilibrium, Plant
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class Wrapper(Plant):
    """Forwards to `plant`. A wrapper with memory appends its own states behind the inner plant's (`memory`)."""

    plant: Plant

    @property
    def step_s(self) -> float:  # type: ignore[override]  # a plain field elsewhere; here the inner plant's
        return self.plant.step_s

    @property
    def settling_band(self) -> float:  # type: ignore[override]  # as step_s
        return self.plant.settling_band

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return self.plant.inputs

    @property
    def outputs(self) -> tuple[Channel, ...]:
        return self.plant.outputs

    @property
    def memory(self) -> tuple[Channel, ...]:
        """The states this wrapper appends."""
        return ()

    @property
    def states(self) -> tuple[Channel, ...]:
        return (*self.plant.states, *self.memory)

    @property
    def disturbances(self) -> tuple[Channel, ...]:
        return self.plant.disturbances

    @property
    def initial_range(self) -> tuple[float, float]:
        return self.plant.initial_range

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        return self.plant.input_amplitude

    @property
    def input_clock_s(self) -> float:
        return self.plant.input_clock_s

    @property
    def noise_variance(self) -> tuple[float, ...]:
        return self.plant.noise_variance

    def fresh_memory(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N q"]:
        """What the appended states are when the plant starts from outputs `y0`."""
        return np.zeros((len(y0), 0))

    def equilibrium(self) -> Equilibrium:
        rest = self.plant.equilibrium()
        return Equilibrium(u=rest.u, x=np.append(rest.x, self.fresh_memory(rest.y[None])[0]), y=rest.y)

    def states_at(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N n"]:
        return np.concatenate([self.plant.states_at(y0), self.fresh_memory(y0)], axis=1)

    def split(self, x: Float[np.ndarray, "N n"]) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "N q"]]:
        """The inner plant's states and the appended ones."""
        inner = len(self.plant.states)
        return x[:, :inner], x[:, inner:]

    def advance(
        self, x: Float[np.ndarray, "N n"], u: Float[np.ndarray, "N m"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N n"]:
        inner, memory = self.split(x)
        return np.concatenate([self.plant.advance(inner, self.applied(memory, u), d), self.renewed(memory, u)], axis=1)

    def applied(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:  # noqa: ARG002
        """The input that reaches the inner plant."""
        return u

    def renewed(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N r"]:  # noqa: ARG002
        """The appended states one sample later."""
        return memory

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N p"]:
        return self.plant.output(self.split(x)[0])
