"""dynoNet baseline: two blocks of transfer functions around a static network, by its authors'
package (MIT)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter

from ssm_study.models.baselines.solved import library
from ssm_study.models.identified import Inputs, Outputs, Simulator
from ssm_study.models.scaffolds.scaffold import numbers
from ssm_study.models.spec import ModelSpec
from ssm_study.models.torch_ssm import Signals, States, TorchModel
from ssm_study.signals import DataSet, Scale

Filter = Float[np.ndarray, "_ _ _"]  # (outputs, inputs, terms)


@dataclass(frozen=True, kw_only=True)
class DynoNet(Simulator, names=("dynonet",)):
    """`y = G2 (W2 tanh(W1 G1 u + b1) + b2)`; each entry of G1 and G2 is `B(q) / A(q)` of its own,
    `A` monic.

    Shapes: `*_b (outputs, inputs, terms)` and `*_a` in powers of the backward shift, delays
    included.
    Source: Forgione & Piga (2021), dynoNet, figure 3.
    """

    first_b: Filter
    first_a: Filter
    second_b: Filter
    second_a: Filter
    hidden: Float[np.ndarray, "h w"]
    bias: Float[np.ndarray, "h"]
    read: Float[np.ndarray, "w2 h"]
    offset: Float[np.ndarray, "w2"]
    scale: Scale

    def simulate(self, u: Inputs) -> Outputs:
        v = filtered(self.first_b, self.first_a, self.scale.scaled_input(u))
        bent = np.tanh(v @ self.hidden.T + self.bias) @ self.read.T + self.offset
        return self.scale.physical_output(filtered(self.second_b, self.second_a, bent))


def filtered(b: Filter, a: Filter, u: Inputs) -> Outputs:
    """`y_o = sum_i B_oi(q) / A_oi(q) u_i`, from rest."""
    outputs, inputs = b.shape[:2]
    rows = [
        sum(lfilter(b[o, i], a[o, i], u[..., i], axis=-1) for i in range(inputs))
        for o in range(outputs)
    ]
    return np.stack(rows, axis=-1)


class TorchDynoNet(TorchModel):
    """Starts at rest always: the package's filter takes no initial state. It differentiates
    backward only."""

    states = 0
    differentiates_forward = False

    def __init__(self, spec: "DynoNetSpec", data: DataSet) -> None:
        super().__init__()
        self.integral_s = data.step_s if spec.integrated else None
        lti, static = library("dynonet.lti"), library("dynonet.static")
        wires, terms = spec.wires, {"n_b": spec.numerator, "n_a": spec.denominator}
        self.first = lti.MimoLinearDynamicalOperator(
            data.scale.inputs, wires, **terms, n_k=1
        ).double()
        self.bend = static.MimoStaticNonLinearity(
            wires, wires, n_hidden=spec.hidden, activation="tanh"
        ).double()
        self.second = lti.MimoLinearDynamicalOperator(wires, data.scale.outputs, **terms).double()

    def advance(self, u: Signals, x0: States) -> tuple[Signals, States]:
        y = self.second(self.bend(self.first(u)))
        return (y if self.integral_s is None else self.integral_s * y.cumsum(-2)), x0

    def freeze(self, data: DataSet) -> DynoNet:
        (b1, a1), (b2, a2) = self.first.get_filtdata(), self.second.get_filtdata()
        if self.integral_s is not None:  # the running sum is one more pole of every last filter
            b2, a2 = self.integral_s * b2, np.apply_along_axis(np.convolve, -1, a2, [1.0, -1.0])
        enter, _, leave = self.bend.net
        layers = {
            "hidden": enter.weight,
            "bias": enter.bias,
            "read": leave.weight,
            "offset": leave.bias,
        }
        weights = {name: numbers(values) for name, values in layers.items()}
        return DynoNet(
            first_b=b1, first_a=a1, second_b=b2, second_a=a2, **weights, scale=data.scale
        )


@dataclass(frozen=True, kw_only=True)
class DynoNetSpec(ModelSpec):
    """`wires` signals between the blocks, each filter with `numerator` and `denominator`
    coefficients.

    `integrated`: the last block gives a rate, whose running sum is the output, as its authors model
    a position.
    """

    sizes: ClassVar = ("wires", "numerator", "denominator", "hidden")

    wires: int
    numerator: int
    denominator: int
    hidden: int
    integrated: bool = False

    def build(self, data: DataSet, seed: int) -> TorchDynoNet:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return TorchDynoNet(self, data)
