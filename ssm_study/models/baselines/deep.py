"""A deep SSM: blocks of ours, one after the other. For identification only; no theorem here covers
it."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from ssm_study.models.identified import SSM, Inputs, Outputs, Simulator
from ssm_study.models.scaffolds.linear import Linear
from ssm_study.models.scaffolds.scaffold import Frame, Trainable
from ssm_study.models.spec import ModelSpec, on_ring, scaled
from ssm_study.models.torch_ssm import LRU, Signals, States, TorchModel, TorchSSM
from ssm_study.signals import DataSet, Scale

SLOPES = (0.01, 1.0)  # of each scaffolding, scaled units


@dataclass(frozen=True, kw_only=True)
class DeepSSM(Simulator, names=("deep_ssm",)):
    """`y = block_L(... block_1(u))`, each an SSM from rest."""

    blocks: tuple[SSM, ...]

    def simulate(self, u: Inputs) -> Outputs:
        for block in self.blocks:
            u = block.simulate(u)
        return u


class TorchDeepSSM(TorchModel):
    """`DeepSSM` with free parameters; its state is that of all blocks, one after the other."""

    def __init__(self, blocks: list[TorchSSM]) -> None:
        super().__init__()
        self.blocks: Any = nn.ModuleList(blocks)
        self.orders = [block.states for block in blocks]
        self.states = sum(self.orders)

    def forward(self, u: Signals, x0: States | None = None) -> Signals:
        starts = [None] * len(self.blocks) if x0 is None else x0.split(self.orders, dim=1)
        for block, start in zip(self.blocks, starts, strict=True):
            u = block(u, start)
        return u

    def advance(self, u: Signals, x0: States) -> tuple[Signals, States]:
        ends = []
        for block, start in zip(self.blocks, x0.split(self.orders, dim=1), strict=True):
            u, end = block.advance(u, start)
            ends.append(end)
        return u, torch.cat(ends, 1)

    def freeze(self, data: DataSet) -> DeepSSM:
        """Signals between the blocks have no unit: only the outer ends are scaled."""
        frozen, ends = [], vars(data.scale)
        for i, block in enumerate(self.blocks):
            sides = ("input",) * (i == 0) + ("output",) * (i == len(self.blocks) - 1)
            outer = {name: values for name, values in ends.items() if name.startswith(sides)}
            unit = Scale.unit(block.lru.modes().b.shape[1], len(block.lru.d))
            frozen.append(block.freeze(replace(data, scale=replace(unit, **outer))))
        return DeepSSM(blocks=tuple(frozen))


@dataclass(frozen=True, kw_only=True)
class DeepSSMSpec(ModelSpec):
    """`layers` blocks of order `order`, `channels` signals between them, `scaffold` in front of
    each."""

    sizes: ClassVar = ("layers", "order", "channels", "hidden_width")

    layers: int
    order: int
    channels: int
    hidden_width: int
    scaffold: Trainable

    def build(self, data: DataSet, seed: int) -> TorchDeepSSM:
        rng = np.random.default_rng(seed)
        records = scaled(data)
        samples = np.concatenate([u for u, _ in records])
        wires = [samples.shape[1], *[self.channels] * (self.layers - 1), records[0][1].shape[1]]
        blocks: list[TorchSSM] = []
        for enter, leave in pairwise(wires):
            seen = samples if not blocks else rng.normal(size=(500, enter))
            frame = Frame(width=self.hidden_width, slopes=SLOPES, samples=seen)
            start = on_ring(
                self.order, self.order % 2, (0.3, 0.99), (0.01, 1.0), (enter, leave), rng
            )
            through = Linear().build(replace(frame, samples=np.zeros((1, leave))), rng)
            blocks.append(
                TorchSSM(self.scaffold.build(frame, rng), LRU(start, feedthrough=True), through)
            )
        return TorchDeepSSM(blocks)
