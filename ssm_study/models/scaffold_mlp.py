"""The paper's scaffolding: a multilayer perceptron with leaky ReLU, minus its value at zero."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.network import Network
from ssm_study.models.scaffold import Scaffold


@dataclass(frozen=True, kw_only=True)
class MlpScaffold(Scaffold):
    """`S(v) = N(v) - N(0)`, N a perceptron of any depth and width with leaky ReLU.

    For one input and one hidden layer the slope is constant between the break points `-b_i / w_i`.
    Source: [Z26] section IV.
    """

    kind: ClassVar[str] = "mlp"
    network: Network

    @property
    def inputs(self) -> int:
        return self.network.inputs

    @property
    def outputs(self) -> int:
        return self.network.outputs

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        return self.network(v)

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        return self.network.jacobian(v)

    def to_json(self) -> dict[str, Any]:
        return {"kind": self.kind, **self.network.to_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "MlpScaffold":
        return cls(network=Network.from_json(data))
