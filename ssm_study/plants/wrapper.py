"""A plant around a plant: limits and dead time at its input."""

from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.plants.plant import Disturbances, Equilibrium, Inputs, Outputs, Plant, States
from ssm_study.refusal import at_least, require
from ssm_study.signals import Channel

Limit = float | tuple[float, ...] | list[float]
Memory = Float[np.ndarray, "N r"]  # the appended states of each case


def _inner(name: str) -> Any:  # A property that answers as the inner plant does
    return property(attrgetter(f"plant.{name}"))


@dataclass(frozen=True, kw_only=True)
class Wrapper(Plant):
    """Everything is the inner plant's unless a wrapper says otherwise; one with `memory` appends
    states of its own."""

    memory: ClassVar[tuple[Channel, ...]] = ()
    plant: Plant

    step_s, settling_band, initial_range = map(_inner, ("step_s", "settling_band", "initial_range"))
    inputs, outputs, disturbances = map(_inner, ("inputs", "outputs", "disturbances"))
    input_amplitude, input_clock_s = map(_inner, ("input_amplitude", "input_clock_s"))
    noise_variance, real, stop = map(_inner, ("noise_variance", "real", "stop"))

    @property
    def states(self) -> tuple[Channel, ...]:
        return (*self.plant.states, *self.memory)

    def fresh_memory(self) -> Float[np.ndarray, "r"]:
        """Values of the appended states of a case at its start: zeros by default."""
        return np.zeros(len(self.memory))

    def equilibrium(self) -> Equilibrium:
        rest = self.plant.equilibrium()
        return Equilibrium(u=rest.u, x=np.append(rest.x, self.fresh_memory()), y=rest.y)

    def states_at(self, y0: Outputs) -> States:
        return np.hstack([self.plant.states_at(y0), np.tile(self.fresh_memory(), (len(y0), 1))])

    def split(self, x: States) -> tuple[Float[np.ndarray, "N k"], Memory]:
        """The inner plant's states and the appended ones."""
        inner = len(self.plant.states)
        return x[:, :inner], x[:, inner:]

    def advance(self, x: States, u: Inputs, d: Disturbances) -> States:
        inner, memory = self.split(x)
        return np.concatenate(
            [self.plant.advance(inner, self.applied(memory, u), d), self.renewed(memory, u)], axis=1
        )

    def applied(self, memory: Memory, u: Inputs) -> Inputs:  # noqa: ARG002
        """The input that reaches the inner plant."""
        return u

    def renewed(self, memory: Memory, u: Inputs) -> Memory:  # noqa: ARG002
        """The appended states one sample later."""
        return memory

    def output(self, x: States) -> Outputs:
        return self.plant.output(self.split(x)[0])


@dataclass(frozen=True, kw_only=True)
class SaturatedInput(Wrapper):
    """`x+ = f(x, clip(u, lower, upper), d)`: limits in the input's unit, one number or one per
    input."""

    lower: Limit
    upper: Limit

    def __post_init__(self) -> None:
        rest = self.plant.equilibrium().u
        limits = (self.lower, self.upper)
        for name, limit in zip(("lower", "upper"), limits, strict=True):
            require(
                np.size(limit) in (1, len(rest)),
                name,
                limit,
                f"there are {len(rest)} inputs",
                "give as many",
            )
        inside = np.all(np.asarray(self.lower) <= rest) and np.all(rest <= np.asarray(self.upper))
        require(inside, "lower, upper", limits, f"do not enclose rest at {rest}", "widen them")

    def applied(self, memory: Memory, u: Inputs) -> Inputs:  # noqa: ARG002
        return np.clip(u, self.lower, self.upper)


@dataclass(frozen=True, kw_only=True)
class DelayedInput(Wrapper):
    """`x+ = f(x, u[k - samples], d)`: a dead time of whole samples; what is under way are the
    appended states."""

    samples: int

    def __post_init__(self) -> None:
        at_least(1, "samples", self.samples, "leave the wrapper out for none")

    @property
    def memory(self) -> tuple[Channel, ...]:  # type: ignore[override]  # nothing elsewhere
        ages = range(self.samples)
        return tuple(
            Channel(name=f"{c.name}_due_in_{age}", unit=c.unit) for age in ages for c in self.inputs
        )

    def fresh_memory(self) -> Float[np.ndarray, "r"]:
        return np.tile(self.plant.equilibrium().u, self.samples)

    def applied(self, memory: Memory, u: Inputs) -> Inputs:
        return memory[:, : u.shape[1]]

    def renewed(self, memory: Memory, u: Inputs) -> Memory:
        return np.concatenate([memory[:, u.shape[1] :], u], axis=1)
