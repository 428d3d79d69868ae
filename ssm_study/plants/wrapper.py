"""Wrappers of plants that add a limit or a dead time at the input."""

from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.plants.plant import Disturbances, Equilibrium, Inputs, Outputs, Plant, States
from ssm_study.refusal import require, require_at_least
from ssm_study.signals import Channel

Limit = float | tuple[float, ...] | list[float]
Memory = Float[np.ndarray, "N r"]  # the appended states of each case


def _wrapped_plant_property(name: str) -> Any:
    """Property that returns the property of the same name of the plant inside a wrapper."""
    return property(attrgetter(f"plant.{name}"))


@dataclass(frozen=True, kw_only=True)
class PlantWrapper(Plant):
    """Base class of plants that wrap another plant and change a part of its behaviour, such as the
    input.

    A wrapper with `memory_channels` appends states of its own.
    """

    memory_channels: ClassVar[tuple[Channel, ...]] = ()
    plant: Plant

    step_s = _wrapped_plant_property("step_s")
    settling_band = _wrapped_plant_property("settling_band")
    initial_range = _wrapped_plant_property("initial_range")
    inputs = _wrapped_plant_property("inputs")
    outputs = _wrapped_plant_property("outputs")
    disturbances = _wrapped_plant_property("disturbances")
    input_amplitude = _wrapped_plant_property("input_amplitude")
    input_clock_s = _wrapped_plant_property("input_clock_s")
    noise_variance = _wrapped_plant_property("noise_variance")
    is_physical = _wrapped_plant_property("is_physical")
    stop = _wrapped_plant_property("stop")

    @property
    def states(self) -> tuple[Channel, ...]:
        return (*self.plant.states, *self.memory_channels)

    def initial_memory(self) -> Float[np.ndarray, "r"]:
        """Initial values of the states that a plant wrapper adds to the wrapped plant."""
        return np.zeros(len(self.memory_channels))

    def equilibrium(self) -> Equilibrium:
        rest = self.plant.equilibrium()
        x = np.append(rest.x, self.initial_memory())
        return Equilibrium(u=rest.u, x=x, y=rest.y)

    def equilibrium_states(self, y0: Outputs) -> States:
        memory = np.tile(self.initial_memory(), (len(y0), 1))
        return np.hstack([self.plant.equilibrium_states(y0), memory])

    def split_states(self, x: States) -> tuple[Float[np.ndarray, "N k"], Memory]:
        """Split a wrapper's state into the state of the wrapped plant and the states that the
        wrapper adds."""
        inner = len(self.plant.states)
        return x[:, :inner], x[:, inner:]

    def next_states(self, x: States, u: Inputs, d: Disturbances) -> States:
        inner, memory = self.split_states(x)
        advanced = self.plant.next_states(inner, self.applied_input(memory, u), d)
        return np.concatenate([advanced, self.next_memory(memory, u)], axis=1)

    def applied_input(self, memory: Memory, u: Inputs) -> Inputs:  # noqa: ARG002
        """Input that reaches the wrapped plant when a given input is applied to the wrapper."""
        return u

    def next_memory(self, memory: Memory, u: Inputs) -> Memory:  # noqa: ARG002
        """Next values of the states that a plant wrapper adds to the wrapped plant."""
        return memory

    def output(self, x: States) -> Outputs:
        return self.plant.output(self.split_states(x)[0])


@dataclass(frozen=True, kw_only=True)
class SaturatedInput(PlantWrapper):
    """Plant wrapper that limits the input, `x+ = f(x, clip(u, lower, upper), d)`.

    Limits in the input's unit, one number or one per input.
    """

    lower: Limit
    upper: Limit

    def __post_init__(self) -> None:
        rest = self.plant.equilibrium().u
        problem = f"the plant has {len(rest)} inputs"
        for name in ("lower", "upper"):
            limit = getattr(self, name)
            has_a_limit_each = np.size(limit) in (1, len(rest))
            require(
                has_a_limit_each, name, limit, problem, "give one number for all, or one for each"
            )
        is_above = np.all(np.asarray(self.lower) <= rest)
        is_below = np.all(rest <= np.asarray(self.upper))
        limits = (self.lower, self.upper)
        problem = f"do not enclose rest at {rest}"
        require(is_above and is_below, "lower, upper", limits, problem, "widen them")

    def applied_input(self, memory: Memory, u: Inputs) -> Inputs:  # noqa: ARG002
        return np.clip(u, self.lower, self.upper)


@dataclass(frozen=True, kw_only=True)
class DelayedInput(PlantWrapper):
    """Plant wrapper that delays the input by whole samples, `x+ = f(x, u[k - samples], d)`.

    The inputs that are under way are the appended states.
    """

    samples: int

    def __post_init__(self) -> None:
        require_at_least(1, "samples", self.samples, "leave the wrapper out for none")

    @property
    def memory_channels(self) -> tuple[Channel, ...]:  # type: ignore[override]  # nothing elsewhere
        """Names and units of the additional states in which a dead time stores past inputs."""
        channels = []
        for age in range(self.samples):
            for channel in self.inputs:
                channels.append(Channel(name=f"{channel.name}_due_in_{age}", unit=channel.unit))
        return tuple(channels)

    def initial_memory(self) -> Float[np.ndarray, "r"]:
        return np.tile(self.plant.equilibrium().u, self.samples)

    def applied_input(self, memory: Memory, u: Inputs) -> Inputs:
        return memory[:, : u.shape[1]]

    def next_memory(self, memory: Memory, u: Inputs) -> Memory:
        return np.concatenate([memory[:, u.shape[1] :], u], axis=1)
