"""Interface of simulated plants: signals, equilibrium, and simulation of one sampling period under
constant input."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study import refusal
from ssm_study.signals import Channel

# All cases at once, a row each; a plant's own documentation says what the columns are.
States = Float[np.ndarray, "N n"]
Inputs = Float[np.ndarray, "N m"]
Disturbances = Float[np.ndarray, "N q"]
Outputs = Float[np.ndarray, "N p"]


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """Equilibrium of a plant: constant input, state and output with `x = f(x, u)` and `y = h(x)`.

    Held at `u (m,)`, a plant started in `x (n,)` stays there and reads `y (p,)`.
    """

    u: Float[np.ndarray, "m"]
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "p"]


class Plant(ABC):
    """Base class of plants that are simulated in discrete time with input held constant between
    samples.

    `x[k+1] = f(x[k], u[k], d[k]),  y[k] = h(x[k])`. Concrete plants are frozen keyword-only
    dataclasses, one file and one yaml each, that name their
    signals as class attributes; wrappers are plants around a plant. Laws (tested for every yaml):
    the equilibrium is a fixed point; a batch equals its rows; two halves equal the whole;
    `output(equilibrium_states(y)) = y`; `output` never sees the input that acts after it.
    """

    step_s: float  # sampling time
    settling_band: float  # |y - y_eq| that counts as settled, unit of the output

    @property
    @abstractmethod
    def inputs(self) -> tuple[Channel, ...]:
        """Names and units of the plant's inputs."""

    @property
    @abstractmethod
    def outputs(self) -> tuple[Channel, ...]:
        """Names and units of the plant's outputs."""

    @property
    @abstractmethod
    def states(self) -> tuple[Channel, ...]:
        """Names and units of the plant's states."""

    @property
    @abstractmethod
    def disturbances(self) -> tuple[Channel, ...]:
        """Names and units of the plant's disturbances."""

    @property
    @abstractmethod
    def initial_range(self) -> tuple[float, float]:
        """Range of initial outputs in closed-loop experiments, as offsets from the plant's
        equilibrium."""

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        """Default amplitude of excitation signals, as offset of each plant input from its
        equilibrium."""
        return (1.0,) * len(self.inputs)

    @property
    def input_clock_s(self) -> float:
        """Default of the shortest holding time of an excitation level (clock period), in
        seconds."""
        return 10 * self.step_s

    @property
    def noise_variance(self) -> tuple[float, ...]:
        """Variance of the measurement noise on each output of the plant."""
        return (0.0,) * len(self.outputs)

    @property
    def is_physical(self) -> bool:
        """Whether the plant is a physical device and not a simulation.

        A device runs one case at a time, from where it is, and never again to check a record.
        """
        return False

    def stop(self) -> None:  # noqa: B027  a simulated plant needs nothing
        """Switch a physical plant off at the end of a closed-loop run. Called at the end of every
        closed loop, also after an error."""

    @abstractmethod
    def equilibrium(self) -> Equilibrium:
        """Input, state and output of a plant at its equilibrium."""

    @abstractmethod
    def equilibrium_states(self, y0: Outputs) -> States:
        """States of a plant at given outputs, with all other states in equilibrium."""

    @abstractmethod
    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        """States of a plant one sampling period later, under constant input and disturbance."""

    def disturbance_effect(self, measured: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n"]:
        """Raise `BadRequest`, because only an identified model has an input for measured
        disturbances."""
        problem = f"{type(self).__name__} has no input for a measured disturbance"
        remedy = "close the loop on the identified model, or use the plant's own disturbance"
        raise refusal.BadRequest("disturbance", len(measured), problem, remedy)

    @abstractmethod
    def output(self, x: States) -> Outputs:
        """Outputs of a plant for given states."""

    def simulate(
        self,
        u: Float[np.ndarray, "N T m"],
        x0: States | None = None,
        d: Float[np.ndarray, "N T q"] | None = None,
    ) -> tuple[Float[np.ndarray, "N T n"], Float[np.ndarray, "N T p"]]:
        """Simulate a plant's states and outputs at the sampling instants for given input sequences.

        `x0` None starts at the equilibrium, `d` None is undisturbed.
        """
        cases, samples = u.shape[:2]
        state = x0
        if state is None:
            state = np.tile(self.equilibrium().x, (cases, 1))
        no_disturbance = np.zeros((cases, len(self.disturbances)))
        x = np.empty((cases, samples, state.shape[1]))
        y = np.empty((cases, samples, len(self.outputs)))
        for k in range(samples):
            x[:, k] = state
            y[:, k] = self.output(state)  # y[k] is read before u[k] acts
            disturbance = no_disturbance if d is None else d[:, k]
            state = self.next_states(state, u[:, k], disturbance)
        return x, y


def field_property(field: str, factors: tuple[int, ...] = ()) -> Any:
    """Make a property that returns a field of the plant, multiplied by given constants."""

    def read_field(plant: Plant) -> Any:
        """Value of an attribute of the plant, or the value multiplied by each of several
        constants."""
        value = getattr(plant, field)
        if not factors:
            return value
        return tuple(factor * value for factor in factors)

    return property(read_field)


def refuse_wrong_signs(
    plant: Plant, positive: tuple[str, ...] | None = None, not_negative: tuple[str, ...] = ()
) -> None:
    """Raise `BadRequest` for physical constants of a plant that have the wrong sign or are not
    finite.

    By default every constant that is not among `not_negative` must be positive.
    """
    if positive is None:
        positive = tuple(name for name in vars(plant) if name not in not_negative)
    for name in positive:
        refusal.require_positive(name, getattr(plant, name), "give it in the unit of its name")
    for name in not_negative:
        refusal.require_at_least(0, name, getattr(plant, name), "use 0 to leave the effect out")
