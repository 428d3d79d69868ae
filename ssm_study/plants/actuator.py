"""What lies between a controller and a plant's input: limits and dead time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.plants.wrapper import Wrapper
from ssm_study.refusal import require
from ssm_study.signals import Channel

Limit = float | tuple[float, ...] | list[float]


@dataclass(frozen=True, kw_only=True)
class SaturatedInput(Wrapper):
    """`x+ = f(x, clip(u, lower, upper), d)`: limits in the input's unit, one number or one per input."""

    lower: Limit
    upper: Limit

    def __post_init__(self) -> None:
        rest = self.plant.equilibrium().u
        for name in ("lower", "upper"):
            count = np.size(getattr(self, name))
            require(count in (1, len(rest)), name, getattr(self, name), f"there are {len(rest)} inputs", "give as many")
        inside = np.all(np.asarray(self.lower) <= rest) and np.all(rest <= np.asarray(self.upper))
        require(bool(inside), "lower, upper", (self.lower, self.upper), f"do not enclose rest at {rest}", "widen them")

    def applied(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:  # noqa: ARG002
        return np.clip(u, self.lower, self.upper)


@dataclass(frozen=True, kw_only=True)
class DelayedInput(Wrapper):
    """`x+ = f(x, u[k - samples], d)`: a dead time of whole samples; what is under way are the appended states."""

    samples: int

    def __post_init__(self) -> None:
        require(
            self.samples >= 1, "samples", self.samples, "a delay has at least one", "leave the wrapper out for none"
        )

    @property
    def memory(self) -> tuple[Channel, ...]:
        ages = range(self.samples, 0, -1)
        return tuple(Channel(name=f"{c.name}_due_in_{a - 1}", unit=c.unit) for a in reversed(ages) for c in self.inputs)

    def fresh_memory(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N q"]:
        return np.tile(self.plant.equilibrium().u, (len(y0), self.samples))

    def applied(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        return memory[:, : u.shape[1]]

    def renewed(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N r"]:
        return np.concatenate([memory[:, u.shape[1] :], u], axis=1)
