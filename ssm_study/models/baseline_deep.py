"""A deep SSM: blocks of ours, one after the other. For identification only; no theorem here covers it."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.scaffold_specs import Frame, Linear, ScaffoldSpec
from ssm_study.models.spec import ModelSpec, scaled
from ssm_study.models.start import on_ring
from ssm_study.models.torch_lru import LRU
from ssm_study.models.torch_ssm import TorchModel, TorchSSM
from ssm_study.refusal import require
from ssm_study.signals import DataSet


@dataclass(frozen=True, kw_only=True)
class DeepSSM(Simulator):
    """`y = block_L(... block_1(u))`, each an SSM from rest."""

    blocks: tuple[SSM, ...]

    def simulate(self, u: Float[np.ndarray, "*batch T m"]) -> Float[np.ndarray, "*batch T p"]:
        for block in self.blocks:
            u = block.simulate(u)
        return u

    def to_json(self) -> dict[str, Any]:
        return {"kind": "deep_ssm", "blocks": [block.to_json() for block in self.blocks]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "DeepSSM":
        return cls(blocks=tuple(SSM.from_json(block) for block in data["blocks"]))


class TorchDeepSSM(TorchModel):
    """`DeepSSM` with free parameters; its state is that of all blocks, one after the other."""

    def __init__(self, blocks: list[TorchSSM]) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(blocks)
        self.orders = [block.states for block in blocks]
        self.states = sum(self.orders)

    def forward(self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "e T p"]:
        starts = [None] * len(self.blocks) if x0 is None else x0.split(self.orders, dim=1)
        for block, start in zip(self.blocks, starts, strict=True):
            u = block(u, start)
        return u

    def advance(
        self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        ends = []
        for block, start in zip(self.blocks, x0.split(self.orders, dim=1), strict=True):
            assert isinstance(block, TorchSSM)
            u, end = block.advance(u, start)
            ends.append(end)
        return u, torch.cat(ends, 1)

    def freeze(self, data: DataSet) -> DeepSSM:
        frozen, last = [], len(self.blocks) - 1
        for i, block in enumerate(self.blocks):
            assert isinstance(block, TorchSSM)
            system = block.lru.to_state_space()
            unit, zero = np.ones(system.b.shape[1]), np.zeros(system.b.shape[1])
            out, rest = np.ones(system.c.shape[0]), np.zeros(system.c.shape[0])
            frozen.append(
                SSM(
                    linear=system,
                    scaffold_in=block.scaffold_in.freeze(),
                    scaffold_out=block.scaffold_out.freeze(),
                    input_scale=data.input_scale if i == 0 else unit,
                    input_equilibrium=data.input_equilibrium if i == 0 else zero,
                    output_scale=data.output_scale if i == last else out,
                    output_equilibrium=data.output_equilibrium if i == last else rest,
                    step_s=data.step_s,
                )
            )
        return DeepSSM(blocks=tuple(frozen))


@dataclass(frozen=True, kw_only=True)
class DeepSSMSpec(ModelSpec):
    """`layers` blocks of order `order`, `channels` signals between them, `scaffold` in front of each."""

    layers: int
    order: int
    channels: int
    hidden_width: int
    scaffold: ScaffoldSpec
    slopes: tuple[float, float] | list[float] = (0.01, 1.0)

    def __post_init__(self) -> None:
        for name in ("layers", "order", "channels", "hidden_width"):
            value = getattr(self, name)
            require(value >= 1, f"model.{name}", value, "must be at least one", "use a positive whole number")

    def build(self, data: DataSet, seed: int) -> TorchDeepSSM:
        rng = np.random.default_rng(seed)
        torch.manual_seed(seed)
        records = scaled(data)
        samples = np.concatenate([u for u, _ in records])
        wires = [samples.shape[1], *[self.channels] * (self.layers - 1), records[0][1].shape[1]]
        blocks: list[TorchSSM] = []
        for enter, leave in pairwise(wires):
            seen = samples if not blocks else rng.normal(size=(500, enter))
            frame = Frame(width=self.hidden_width, slopes=(self.slopes[0], self.slopes[1]), samples=seen)
            start = on_ring(self.order, self.order % 2, (0.3, 0.99), (0.01, 1.0), (enter, leave), rng)
            through = Linear().build(Frame(width=1, slopes=frame.slopes, samples=np.zeros((1, leave))), rng)
            blocks.append(TorchSSM(self.scaffold.build(frame, rng), LRU(start, feedthrough=True), through))
        return TorchDeepSSM(blocks)
