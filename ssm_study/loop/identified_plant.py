"""The identified model in the plant's place: for recorded data, where there is no plant to close the loop on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.loop.trajectory import equilibrium
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Equilibrium, Plant
from ssm_study.refusal import require
from ssm_study.signals import Channel


@dataclass(frozen=True, kw_only=True)
class IdentifiedPlant(Plant):
    """`x+ = A x + B S_u(u) + B d,  y = S_y(C x)`: the model answers for itself, so the loop says nothing of mismatch.

    The state is the model's (scaled), `u` and `y` are physical; `d (m)` disturbs the recurrence's scaled input.
    Initial outputs lie within one `output_scale` of the equilibrium, and 5 % of it counts as settled, unless given.
    Raises `BadRequest` for a model with feedthrough: the loop reads the output before the input acts.
    """

    model: SSM
    input_channels: tuple[Channel, ...]
    output_channels: tuple[Channel, ...]
    initial_offset: float | None = None
    settled_within: float | None = None

    def __post_init__(self) -> None:
        require(
            not np.any(self.model.linear.d),
            "model.feedthrough",
            "D is not zero",
            "the loop samples the output before the input acts",
            "identify with model.feedthrough=false",
        )
        channels, needed = (len(self.inputs), len(self.outputs)), (len(self.model.input_scale), self._width)
        require(channels == needed, "channels", channels, f"the model has {needed}", "name each of its signals")

    @property
    def _width(self) -> int:
        return len(self.model.output_scale)

    @property
    def step_s(self) -> float:  # type: ignore[override]  # a plain field elsewhere; here the model knows it
        return self.model.step_s

    @property
    def settling_band(self) -> float:  # type: ignore[override]  # as step_s
        return 0.05 * float(self.model.output_scale.min()) if self.settled_within is None else self.settled_within

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return self.input_channels

    @property
    def outputs(self) -> tuple[Channel, ...]:
        return self.output_channels

    @property
    def states(self) -> tuple[Channel, ...]:
        return tuple(Channel(name=f"x{i}", unit="1") for i in range(self.model.order))

    @property
    def disturbances(self) -> tuple[Channel, ...]:
        return tuple(Channel(name=f"scaled_input_{i}", unit="1") for i in range(self.model.linear.b.shape[1]))

    @property
    def initial_range(self) -> tuple[float, float]:
        reach = float(self.model.output_scale.min()) if self.initial_offset is None else self.initial_offset
        return -reach, reach

    def equilibrium(self) -> Equilibrium:
        return Equilibrium(
            u=self.model.input_equilibrium, x=np.zeros(self.model.order), y=self.model.output_equilibrium
        )

    def states_at(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N n"]:
        """States in which a constant input would hold `y0`: the model released from a set point."""
        return np.stack([equilibrium(self.model, y)[0] for y in y0])

    def advance(
        self, x: Float[np.ndarray, "N n"], u: Float[np.ndarray, "N m"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N n"]:
        return self.model.advance(x, self.model.lift(u) + d)

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N p"]:
        return self.model.read(x, np.zeros((len(x), self.model.linear.b.shape[1])))
