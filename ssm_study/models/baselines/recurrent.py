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
    """Identified GRU or LSTM model with one layer and a linear output, with NumPy arrays as
    parameters, without torch. It has one layer with a linear output, computed by torch's documented
    equations."""

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
        batch_shape = u.shape[:-2]
        h = np.zeros((*batch_shape, hidden))
        c = np.zeros((*u.shape[:-2], hidden))
        run_shape = u.shape[:-1]
        y = np.empty((*run_shape, len(self.offset)))
        samples = u.shape[-2]
        for k in range(samples):
            driven = scaled[..., k, :] @ self.weight_ih.T
            gates = driven + self.bias_ih
            fed_in = h @ self.weight_hh.T
            fed_back = fed_in + self.bias_hh
            if self.kind == "gru":
                r, z, n = np.split(gates, 3, axis=-1)
                hr, hz, hn = np.split(fed_back, 3, axis=-1)
                update = expit(z + hz)  # share of the old state that stays
                reset = expit(r + hr)
                candidate = np.tanh(n + reset * hn)
                h = (1 - update) * candidate + update * h
            else:
                i, f, g, o = np.split(gates + fed_back, 4, axis=-1)
                kept_memory = expit(f) * c
                new_memory = expit(i) * np.tanh(g)
                c = kept_memory + new_memory
                output_gate = expit(o)
                bounded_memory = np.tanh(c)
                h = output_gate * bounded_memory
            read_out = h @ self.read.T
            y[..., k, :] = read_out + self.offset
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

    def simulate_with_final_state(self, u: Signals, x0: States) -> tuple[Signals, States]:
        state_parts = x0[None].split(self.cell.hidden_size, dim=-1)
        start = [part.contiguous() for part in state_parts]
        if self.kind == "gru":
            y, h = self.cell(u, start[0])
            return self.read(y), h[0]
        start_state = tuple(start)
        y, both = self.cell(u, start_state)
        outputs = self.read(y)
        end_state = torch.cat(both, -1)
        return outputs, end_state[0]

    def to_numpy(self, data: DataSet) -> Recurrent:
        """Copy of the trained GRU or LSTM model with NumPy arrays as parameters, independent of
        torch."""
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        weights = {name: tensor_to_numpy(getattr(self.cell, f"{name}_l0")) for name in names}
        read_weight = self.read.weight
        weights["read"] = tensor_to_numpy(read_weight)
        read_bias = self.read.bias
        weights["offset"] = tensor_to_numpy(read_bias)
        return Recurrent(kind=self.kind, **weights, scale=data.scale)


@dataclass(frozen=True, kw_only=True)
class RecurrentSpec(ModelSpec):
    """Settings of a GRU or LSTM model, which can be identified but not certified. `cell` is gru or
    lstm, `hidden` the number of its states."""

    cell: str
    hidden: int

    def __post_init__(self) -> None:
        cells = ("gru", "lstm")
        require_one_of(cells, "model.cell", self.cell)
        require_at_least(1, "model.hidden", self.hidden, "use 16 or so")

    def build(self, data: DataSet, seed: int) -> TorchRecurrent:
        """Build the trainable GRU or LSTM model with random initial weights."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return TorchRecurrent(self.cell, self.hidden, data.scale)
