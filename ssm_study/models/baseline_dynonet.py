"""dynoNet baseline: two blocks of transfer functions around a static network, by its authors' package (MIT)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter
from torch import Tensor

from ssm_study.models.baseline_solved import library
from ssm_study.models.identified import Simulator
from ssm_study.models.scaffold import array_from_json
from ssm_study.models.spec import ModelSpec
from ssm_study.models.torch_scaffold import numbers
from ssm_study.models.torch_ssm import TorchModel
from ssm_study.refusal import require
from ssm_study.signals import DataSet

WEIGHTS = {"first_b": 3, "first_a": 3, "hidden": 2, "bias": 1, "read": 2, "offset": 1, "second_b": 3, "second_a": 3}
SCALES = ("input_scale", "output_scale", "input_equilibrium", "output_equilibrium")


@dataclass(frozen=True, kw_only=True)
class DynoNet(Simulator):
    """`y = G2 (W2 tanh(W1 G1 u + b1) + b2)`; each entry of G1 and G2 is `B(q) / A(q)` of its own, `A` monic.

    Shapes: `*_b (outputs, inputs, terms)` and `*_a` in powers of the backward shift, delays included.
    Source: Forgione & Piga (2021), dynoNet, figure 3.
    """

    weights: dict[str, Float[np.ndarray, "..."]]
    scales: dict[str, Float[np.ndarray, "..."]]

    def simulate(self, u: Float[np.ndarray, "*batch T m"]) -> Float[np.ndarray, "*batch T p"]:
        w, s = self.weights, self.scales
        v = filtered(w["first_b"], w["first_a"], (u - s["input_equilibrium"]) / s["input_scale"])
        bent = np.tanh(v @ w["hidden"].T + w["bias"]) @ w["read"].T + w["offset"]
        return s["output_equilibrium"] + s["output_scale"] * filtered(w["second_b"], w["second_a"], bent)

    def to_json(self) -> dict[str, Any]:
        return {"kind": "dynonet", **{n: v.tolist() for n, v in {**self.weights, **self.scales}.items()}}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "DynoNet":
        weights = {name: array_from_json(data, name, axes) for name, axes in WEIGHTS.items()}
        return cls(weights=weights, scales={name: array_from_json(data, name, 1) for name in SCALES})


def filtered(
    b: Float[np.ndarray, "o i nb"], a: Float[np.ndarray, "o i na"], u: Float[np.ndarray, "*batch T i"]
) -> Float[np.ndarray, "*batch T o"]:
    """`y_o = sum_i B_oi(q) / A_oi(q) u_i`, from rest."""
    outputs, inputs = b.shape[:2]
    rows = [sum(lfilter(b[o, i], a[o, i], u[..., i], axis=-1) for i in range(inputs)) for o in range(outputs)]
    return np.stack(rows, axis=-1)


class TorchDynoNet(TorchModel):
    """Starts at rest always: the package's filter takes no initial state. It differentiates backward only."""

    states = 0
    differentiates_forward = False

    def __init__(
        self, channels: tuple[int, int], wires: int, terms: tuple[int, int], hidden: int, integral_s: float | None
    ) -> None:
        super().__init__()
        self.integral_s = integral_s
        lti, static = library("dynonet.lti"), library("dynonet.static")
        (enter, leave), (nb, na) = channels, terms
        self.first = lti.MimoLinearDynamicalOperator(enter, wires, n_b=nb, n_a=na, n_k=1).double()
        self.bend = static.MimoStaticNonLinearity(wires, wires, n_hidden=hidden, activation="tanh").double()
        self.second = lti.MimoLinearDynamicalOperator(wires, leave, n_b=nb, n_a=na).double()

    def forward(self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "e T p"]:
        del x0  # there is none
        y = self.second(self.bend(self.first(u)))
        return y if self.integral_s is None else self.integral_s * y.cumsum(-2)

    def advance(
        self, u: Float[Tensor, "e T m"], x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        return self.forward(u), x0

    def freeze(self, data: DataSet) -> DynoNet:
        (b1, a1), (b2, a2) = self.first.get_filtdata(), self.second.get_filtdata()
        if self.integral_s is not None:  # the running sum is one more pole of every last filter
            b2, a2 = self.integral_s * b2, np.apply_along_axis(np.convolve, -1, a2, [1.0, -1.0])
        weights = {"first_b": b1, "first_a": a1, "second_b": b2, "second_a": a2}
        layers = {"hidden": self.bend.net[0].weight, "bias": self.bend.net[0].bias}
        layers |= {"read": self.bend.net[2].weight, "offset": self.bend.net[2].bias}
        weights |= {name: numbers(values) for name, values in layers.items()}
        return DynoNet(weights=weights, scales={name: getattr(data, name) for name in SCALES})


@dataclass(frozen=True, kw_only=True)
class DynoNetSpec(ModelSpec):
    """`wires` signals between the blocks, each filter with `numerator` and `denominator` coefficients.

    `integrated`: the last block gives a rate, whose running sum is the output, as its authors model a position.
    """

    wires: int
    numerator: int
    denominator: int
    hidden: int
    integrated: bool = False

    def __post_init__(self) -> None:
        for name in ("wires", "numerator", "denominator", "hidden"):
            value = getattr(self, name)
            require(value >= 1, f"model.{name}", value, "must be at least one", "use a positive whole number")

    def build(self, data: DataSet, seed: int) -> TorchDynoNet:
        channels = (len(data.input_scale), len(data.output_scale))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            terms, integral_s = (self.numerator, self.denominator), data.step_s if self.integrated else None
            return TorchDynoNet(channels, self.wires, terms, self.hidden, integral_s)
