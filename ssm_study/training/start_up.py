"""The states that records start from, as a score will estimate them: from samples that are not scored."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.free_run import initial_state
from ssm_study.models.torch_ssm import TorchSSM
from ssm_study.signals import DataSet, Trajectory


class StartUp(nn.Module):
    """`forward(model)`: the states `(e, n)` of `records` that `free_run` estimates from their start-up samples.

    A record that starts in motion says nothing about a model that simulates it from rest: validation would then stop
    a training, or choose among several, by the error of the initial state.
    """

    def __init__(self, records: tuple[Trajectory, ...], data: DataSet) -> None:
        super().__init__()
        self.records, self.data = records, data

    @torch.no_grad()
    def forward(self, model: TorchSSM) -> Float[Tensor, "e n"]:
        like = model.lru.nu
        if not all(torch.isfinite(parameter).all() for parameter in model.parameters()):
            return like.new_full((len(self.records), model.states), torch.nan)
        stored = model.freeze(self.data)
        states = [initial_state(stored, record, self.data.start_up_samples) for record in self.records]
        return torch.from_numpy(np.stack(states)).to(like)
