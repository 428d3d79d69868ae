"""GRU and LSTM models for comparison, trained in torch and stored as explicit numbers."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import expit
from torch import nn

from ssm_study.models.identified import Inputs, Outputs, Simulator
from ssm_study.models.scaffolds.scaffold import tensor_to_numpy
from ssm_study.models.spec import ModelSpec
from ssm_study.models.torch_ssm import Signals, States, TorchModel
from ssm_study.refusal import require_at_least, require_one_of
from ssm_study.signals import DataSet, Scale


@dataclass(frozen=True, kw_only=True)
class Recurrent(Simulator, names=("gru", "lstm")):
    """Identified GRU or LSTM model as explicit numbers. It has one layer with a linear output,
    computed by torch's documented equations."""

    kind: str  # type: ignore[misc] # of either cell
    weight_ih: Float[np.ndarray, "g m"]
    weight_hh: Float[np.ndarray, "g h"]
    bias_ih: Float[np.ndarray, "g"]
    bias_hh: Float[np.ndarray, "g"]
    read: Float[np.ndarray, "p h"]
    offset: Float[np.ndarray, "p"]
    scale: Scale

    def simulate(self, u: Inputs) -> Outputs:
        scaled = self.scale.scaled_input(u)
        hidden = self.weight_hh.shape[1]
        h = np.zeros((*u.shape[:-2], hidden))
        c = np.zeros((*u.shape[:-2], hidden))
        y = np.empty((*u.shape[:-1], len(self.offset)))
        for k in range(u.shape[-2]):
            gates = scaled[..., k, :] @ self.weight_ih.T + self.bias_ih
            fed_back = h @ self.weight_hh.T + self.bias_hh
            if self.kind == "gru":
                r, z, n = np.split(gates, 3, axis=-1)
                hr, hz, hn = np.split(fed_back, 3, axis=-1)
                update = expit(z + hz)  # share of the old state that stays
                h = (1 - update) * np.tanh(n + expit(r + hr) * hn) + update * h
            else:
                i, f, g, o = np.split(gates + fed_back, 4, axis=-1)
                c = expit(f) * c + expit(i) * np.tanh(g)
                h = expit(o) * np.tanh(c)
            y[..., k, :] = h @ self.read.T + self.offset
        return self.scale.physical_output(y)


class TorchRecurrent(TorchModel):
    """Trainable GRU or LSTM model in torch. `y = W h + b` of torch's cell in float64; its state is
    h, with c for the LSTM."""

    def __init__(self, kind: str, hidden: int, scale: Scale) -> None:
        super().__init__()
        self.kind = kind
        cell = nn.GRU if kind == "gru" else nn.LSTM
        self.cell = cell(scale.inputs, hidden, batch_first=True, dtype=torch.float64)
        self.read = nn.Linear(hidden, scale.outputs, dtype=torch.float64)
        self.states = hidden if kind == "gru" else 2 * hidden  # the LSTM's h, then its c

    def advance(self, u: Signals, x0: States) -> tuple[Signals, States]:
        start = [part.contiguous() for part in x0[None].split(self.cell.hidden_size, dim=-1)]
        if self.kind == "gru":
            y, h = self.cell(u, start[0])
            return self.read(y), h[0]
        y, both = self.cell(u, tuple(start))
        return self.read(y), torch.cat(both, -1)[0]

    def freeze(self, data: DataSet) -> Recurrent:
        """Freeze the trained recurrent model to explicit numbers, with its scales."""
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        weights = {name: tensor_to_numpy(getattr(self.cell, f"{name}_l0")) for name in names}
        weights["read"] = tensor_to_numpy(self.read.weight)
        weights["offset"] = tensor_to_numpy(self.read.bias)
        return Recurrent(kind=self.kind, **weights, scale=data.scale)


@dataclass(frozen=True, kw_only=True)
class RecurrentSpec(ModelSpec):
    """Settings of a GRU or LSTM model, for identification only. `cell` is gru or lstm, `hidden` the
    number of its states."""

    cell: str
    hidden: int

    def __post_init__(self) -> None:
        require_one_of(("gru", "lstm"), "model.cell", self.cell)
        require_at_least(1, "model.hidden", self.hidden, "use 16 or so")

    def build(self, data: DataSet, seed: int) -> TorchRecurrent:
        """Build the trainable GRU or LSTM model with random initial weights."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return TorchRecurrent(self.cell, self.hidden, data.scale)
