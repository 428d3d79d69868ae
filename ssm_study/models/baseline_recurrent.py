"""GRU and LSTM baselines: torch's own cells for training, their published equations for the stored model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import expit
from torch import Tensor, nn

from ssm_study.models.identified import Simulator
from ssm_study.models.scaffold import array_from_json
from ssm_study.models.spec import ModelSpec
from ssm_study.models.torch_scaffold import numbers
from ssm_study.models.torch_ssm import TorchModel
from ssm_study.refusal import require
from ssm_study.signals import DataSet

WEIGHTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh", "read", "offset")
SCALES = ("input_scale", "output_scale", "input_equilibrium", "output_equilibrium")


@dataclass(frozen=True, kw_only=True)
class Recurrent(Simulator):
    """One layer of GRU or LSTM with a linear output, stepped by torch's documented equations."""

    cell: str
    weights: dict[str, Float[np.ndarray, "..."]]
    scales: dict[str, Float[np.ndarray, "..."]]

    def simulate(self, u: Float[np.ndarray, "*batch T m"]) -> Float[np.ndarray, "*batch T p"]:
        w, s = self.weights, self.scales
        scaled = (u - s["input_equilibrium"]) / s["input_scale"]
        hidden = w["weight_hh"].shape[1]
        h, c = np.zeros((*u.shape[:-2], hidden)), np.zeros((*u.shape[:-2], hidden))
        y = np.empty((*u.shape[:-1], len(w["offset"])))
        for k in range(u.shape[-2]):
            gates = scaled[..., k, :] @ w["weight_ih"].T + w["bias_ih"]
            fed_back = h @ w["weight_hh"].T + w["bias_hh"]
            h, c = _gru(gates, fed_back, h, c) if self.cell == "gru" else _lstm(gates + fed_back, c)
            y[..., k, :] = h @ w["read"].T + w["offset"]
        return s["output_equilibrium"] + s["output_scale"] * y

    def to_json(self) -> dict[str, Any]:
        return {"kind": self.cell, **{n: v.tolist() for n, v in {**self.weights, **self.scales}.items()}}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Recurrent":
        weights = {n: array_from_json(data, n, 2 if n in ("weight_ih", "weight_hh", "read") else 1) for n in WEIGHTS}
        return cls(cell=data["kind"], weights=weights, scales={n: array_from_json(data, n, 1) for n in SCALES})


def _gru(gates: np.ndarray, fed_back: np.ndarray, h: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (r, z, n), (hr, hz, hn) = np.split(gates, 3, axis=-1), np.split(fed_back, 3, axis=-1)
    update = expit(z + hz)
    return (1 - update) * np.tanh(n + expit(r + hr) * hn) + update * h, c


def _lstm(gates: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    i, f, g, o = np.split(gates, 4, axis=-1)
    c = expit(f) * c + expit(i) * np.tanh(g)
    return expit(o) * np.tanh(c), c


class TorchRecurrent(TorchModel):
    """`y = W h + b` of torch's GRU or LSTM cell, float64; its state is h, and c of the LSTM."""

    def __init__(self, cell: str, hidden: int, channels: tuple[int, int]) -> None:
        super().__init__()
        self.kind = cell
        kind = nn.GRU if cell == "gru" else nn.LSTM
        self.cell = kind(channels[0], hidden, batch_first=True, dtype=torch.float64)
        self.read = nn.Linear(hidden, channels[1], dtype=torch.float64)
        self.states = hidden if cell == "gru" else 2 * hidden  # the LSTM's h, then its c

    def forward(self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "e T p"]:
        return self.read(self.cell(u)[0]) if x0 is None else self.advance(u, x0)[0]

    def advance(
        self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        start = [part.contiguous() for part in x0[None].split(self.cell.hidden_size, dim=-1)]
        y, end = self.cell(u, start[0] if self.kind == "gru" else tuple(start))
        return self.read(y), (end if self.kind == "gru" else torch.cat(end, -1))[0]

    def freeze(self, data: DataSet) -> Recurrent:
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        weights = {name: numbers(getattr(self.cell, f"{name}_l0")) for name in names}
        weights |= {"read": numbers(self.read.weight), "offset": numbers(self.read.bias)}
        return Recurrent(cell=self.kind, weights=weights, scales={name: getattr(data, name) for name in SCALES})


@dataclass(frozen=True, kw_only=True)
class RecurrentSpec(ModelSpec):
    """`cell` is gru or lstm, `hidden` its states; identification only."""

    cell: str
    hidden: int

    def __post_init__(self) -> None:
        require(self.cell in ("gru", "lstm"), "model.cell", self.cell, "unknown", "use gru or lstm")
        require(self.hidden >= 1, "model.hidden", self.hidden, "needs at least one state", "use 16 or so")

    def build(self, data: DataSet, seed: int) -> TorchRecurrent:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return TorchRecurrent(self.cell, self.hidden, (len(data.input_scale), len(data.output_scale)))
