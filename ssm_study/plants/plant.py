"""The interface every plant answers: what it is called, where it rests, and one sampling period
under held input."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study import refusal
from ssm_study.signals import Channel

# Of all cases at once, a row each; a plant's own documentation says what the columns are.
States = Float[np.ndarray, "N n"]
Inputs = Float[np.ndarray, "N m"]
Disturbances = Float[np.ndarray, "N q"]
Outputs = Float[np.ndarray, "N p"]


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """`x = f(x, u)` with `y = h(x)`: held at `u (m,)`, a plant started in `x (n,)` stays there and
    reads `y (p,)`."""

    u: Float[np.ndarray, "m"]
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "p"]


class Plant(ABC):
    """`x[k+1] = f(x[k], u[k], d[k]),  y[k] = h(x[k])`: a sampled system under held input, physical
    units throughout.

    Concrete plants are frozen keyword-only dataclasses, one file and one yaml each, that name their
    signals as class attributes; wrappers are plants around a plant. Laws (tested for every yaml):
    the equilibrium is a fixed point; a batch equals its rows; two halves equal the whole;
    `output(states_at(y)) = y`; `output` never sees the input that acts after it.
    """

    step_s: float  # sampling time
    settling_band: float  # |y - y_eq| that counts as settled, unit of the output

    @property
    @abstractmethod
    def inputs(self) -> tuple[Channel, ...]: ...

    @property
    @abstractmethod
    def outputs(self) -> tuple[Channel, ...]: ...

    @property
    @abstractmethod
    def states(self) -> tuple[Channel, ...]: ...

    @property
    @abstractmethod
    def disturbances(self) -> tuple[Channel, ...]: ...

    @property
    @abstractmethod
    def initial_range(self) -> tuple[float, float]:
        """Offsets of the output from its equilibrium from which initial conditions are drawn, unit
        of the output."""

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        """Offsets of each input from its equilibrium that an excitation uses unless it is told
        otherwise."""
        return (1.0,) * len(self.inputs)

    @property
    def input_clock_s(self) -> float:
        """The shortest time an excitation holds a level unless it is told otherwise."""
        return 10 * self.step_s

    @property
    def noise_variance(self) -> tuple[float, ...]:
        """Variance of each output's measurement noise, its unit squared."""
        return (0.0,) * len(self.outputs)

    @property
    def real(self) -> bool:
        """Whether it is a device: one case at a time, from where it is, and never run again to
        check a record."""
        return False

    def stop(self) -> None:  # noqa: B027  a simulated plant needs nothing
        """Called at the end of every closed loop, also after an error: a device switches off."""

    @abstractmethod
    def equilibrium(self) -> Equilibrium: ...

    @abstractmethod
    def states_at(self, y0: Outputs) -> States:
        """States that read `y0`, all else at rest."""

    @abstractmethod
    def advance(self, x: States, u: Inputs, d: Disturbances) -> States:
        """The states one sampling period later, `u` and `d` held meanwhile."""

    @abstractmethod
    def output(self, x: States) -> Outputs:
        """The sensor's reading before the input of the same sample acts."""

    def simulate(
        self,
        u: Float[np.ndarray, "N T m"],
        x0: States | None = None,
        d: Float[np.ndarray, "N T q"] | None = None,
    ) -> tuple[Float[np.ndarray, "N T n"], Float[np.ndarray, "N T p"]]:
        """States and outputs at the sampling instants; `x0` None starts at the equilibrium, `d`
        None is undisturbed."""
        cases, samples = u.shape[:2]
        state = np.tile(self.equilibrium().x, (cases, 1)) if x0 is None else x0
        still = np.zeros((cases, len(self.disturbances)))
        x = np.empty((cases, samples, state.shape[1]))
        y = np.empty((cases, samples, len(self.outputs)))
        for k in range(samples):
            x[:, k], y[:, k] = state, self.output(state)  # y[k] is read before u[k] acts
            state = self.advance(state, u[:, k], still if d is None else d[:, k])
        return x, y


def stated(field: str, factors: tuple[int, ...] = ()) -> Any:
    """A property that answers with the plant's field of that name, or with that times each of the
    factors."""

    def read(plant: Plant) -> Any:
        value = getattr(plant, field)
        return tuple(factor * value for factor in factors) if factors else value

    return property(read)


def check_signs(
    plant: Plant, positive: tuple[str, ...] | None = None, not_negative: tuple[str, ...] = ()
) -> None:
    """Raise `BadRequest` for a setting, by its name, that has the wrong sign or is not finite.

    `positive` None: every one that is not among `not_negative`.
    """
    for name in (
        (name for name in vars(plant) if name not in not_negative) if positive is None else positive
    ):
        refusal.positive(name, getattr(plant, name), "give it in the unit of its name")
    for name in not_negative:
        refusal.at_least(0, name, getattr(plant, name), "use 0 to leave the effect out")
