"""A scaffolding that is a ball of Jacobians by construction, in any dimension."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.network import Network
from ssm_study.models.scaffold import Scaffold, array_from_json, arrays_from_json
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class ResidualScaffold(Scaffold):
    """`S(v) = alpha v + beta (G(v) - G(0))` with `|G(v) - G(w)| <= |v - w|`: exactly the ball `alpha I + beta Delta`.

    `multipliers[l] (h_l,) > 0` are the diagonal multipliers of the Lipschitz certificate of G: with the network's
    weights they make the matrix of Fazlyab et al. (2019), eq. (10), semidefinite at Lipschitz constant one, so the
    claim can be checked from these numbers alone. Source: THEORY section 3 (ii); Wang & Manchester (2023).
    """

    kind: ClassVar[str] = "residual"
    alpha: float
    beta: float
    network: Network
    multipliers: tuple[Float[np.ndarray, "..."], ...]

    def __post_init__(self) -> None:
        fits = self.network.inputs == self.network.outputs
        require(fits, "weights", self.network.outputs, "as many outputs as inputs are needed", "use kind mlp")
        require(self.beta >= 0, "beta", self.beta, "a ball needs a radius >= 0", "write model.json again")
        fits = [t.shape for t in self.multipliers] == [b.shape for b in self.network.biases]
        fits = fits and all(bool((t > 0).all()) for t in self.multipliers)
        require(fits, "multipliers", len(self.multipliers), "need one per neuron, positive", "write model.json again")

    @property
    def inputs(self) -> int:
        return self.network.inputs

    @property
    def outputs(self) -> int:
        return self.network.outputs

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        return self.alpha * v + self.beta * self.network(v)

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m m"]:
        return self.alpha * np.eye(self.inputs) + self.beta * self.network.jacobian(v)

    def to_json(self) -> dict[str, Any]:
        multipliers = [t.tolist() for t in self.multipliers]
        ball = {"alpha": self.alpha, "beta": self.beta, "multipliers": multipliers}
        return {"kind": self.kind, **ball, **self.network.to_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "ResidualScaffold":
        return cls(
            alpha=float(array_from_json(data, "alpha", 0)),
            beta=float(array_from_json(data, "beta", 0)),
            network=Network.from_json(data),
            multipliers=arrays_from_json(data, "multipliers", 1),
        )
