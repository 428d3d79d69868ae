"""The trainable model: scaffolding, recurrent unit, scaffolding, in scaled units."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.torch_lru import LRU
from ssm_study.models.torch_recurrence import end_state, respond
from ssm_study.models.torch_scaffold import TorchScaffold
from ssm_study.signals import DataSet


class TorchModel(nn.Module, ABC):
    """A trainable model on scaled signals; `states` is the length of the initial state it accepts.

    `estimates_start`: whether a free run of the stored model estimates the state a record starts from (`free_run`).
    `differentiates_forward`: whether Levenberg-Marquardt can have its Jacobian.
    """

    states: int
    estimates_start: ClassVar[bool] = False
    differentiates_forward: ClassVar[bool] = True

    @abstractmethod
    def forward(self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "e T p"]: ...

    @abstractmethod
    def advance(
        self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        """The output, and the state after the last sample: what the next window of a record starts from."""

    @abstractmethod
    def freeze(self, data: DataSet) -> Simulator:
        """The explicit numbers, with the scales they were trained under."""


class TorchSSM(TorchModel):
    """`x+ = A x + B S_u(u),  y = S_y(C x + D S_u(u))` on scaled signals `u (e, T, m)`, `y (e, T, p)`."""

    estimates_start = True

    def __init__(self, scaffold_in: TorchScaffold, lru: LRU, scaffold_out: TorchScaffold) -> None:
        super().__init__()
        self.scaffold_in, self.lru, self.scaffold_out = scaffold_in, lru, scaffold_out
        self.states = lru.order

    def forward(self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "e T p"]:
        return self.respond(self.scaffold_in(u), x0)

    def respond(
        self, ubar: Float[Tensor, "*models e T m"], x0: Float[Tensor, "e n"] | None = None
    ) -> Float[Tensor, "*models e T p"]:
        """The output for an input that has passed `S_u` already; `x0` ordered as in `to_state_space`."""
        return self.scaffold_out(self.lru(ubar, x0))

    def advance(
        self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        return self.advance_lifted(self.scaffold_in(u), x0)

    def advance_lifted(
        self, ubar: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        """`advance` for an input that has passed `S_u` already."""
        modes, modal = self.lru.modes(), self.lru.initial_state(x0)
        end = self.lru.real_state(end_state(modes, ubar, modal))
        return self.scaffold_out(respond(modes, ubar, modal)), end

    def freeze(self, data: DataSet) -> SSM:
        return SSM(
            linear=self.lru.to_state_space(),
            scaffold_in=self.scaffold_in.freeze(),
            scaffold_out=self.scaffold_out.freeze(),
            input_scale=data.input_scale.astype(np.float64),
            output_scale=data.output_scale.astype(np.float64),
            input_equilibrium=data.input_equilibrium.astype(np.float64),
            output_equilibrium=data.output_equilibrium.astype(np.float64),
            step_s=data.step_s,
        )
