"""Static map, in any dimension, whose Jacobians lie in a ball by construction."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.lipschitz import is_proved_nonexpansive
from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, bound_from_ball, network_bound
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds.scaffold import Free, Scaffold, Square, tensor_to_numpy
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require, require_at_least
from ssm_study.systems import JacobianBall


@dataclass(frozen=True, kw_only=True)
class ResidualScaffold(Scaffold, names=("residual",)):
    """Static map, in any dimension, whose Jacobians lie in a ball by construction. `S(v) = alpha v
    + beta (G(v) - G(0))` with `|G(v) - G(w)| <= |v - w|` gives exactly the ball `alpha I + beta
    Delta`.

    `multipliers[l] (h_l,) > 0` are the diagonal multipliers of the Lipschitz certificate of G. It
    is decided exactly whenever the ball is asked for (`bounds.lipschitz`). Where they prove nothing
    the map is bounded from its numbers like any other network. Source: Wang & Manchester (2023).
    """

    alpha: float
    beta: float
    multipliers: tuple[Float[np.ndarray, "_"], ...]
    network: Network

    def __post_init__(self) -> None:
        outputs = self.network.outputs
        problem = "as many outputs as inputs are needed"
        require(self.network.inputs == outputs, "weights", outputs, problem, "use kind mlp")
        remedy = "write model.json again"
        require_at_least(0, "beta", self.beta, remedy)
        shapes = [t.shape for t in self.multipliers]
        needed = [b.shape for b in self.network.biases]
        fits = shapes == needed and all(bool((t > 0).all()) for t in self.multipliers)
        require(fits, "multipliers", len(shapes), "need one per neuron, positive", remedy)

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        return self.alpha * v + self.beta * self.network(v)

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Square:
        return self.alpha * np.eye(self.network.inputs) + self.beta * self.network.jacobian(v)

    def bound(self) -> SlopeBound:
        if not is_proved_nonexpansive(self.network, self.multipliers):
            return network_bound(self.as_portable().as_network())
        return bound_from_ball(JacobianBall(alpha=self.alpha, beta=self.beta), "construction")

    def jacobian_centre(self) -> None:
        """No centre matrix is needed: the Jacobians lie around a multiple of the identity."""
        return

    def as_portable(self) -> PortableMap:
        *inner, last = self.network.weights
        network = replace(self.network, weights=(*inner, self.beta * last))
        return PortableMap(linear=self.alpha * np.eye(network.inputs), network=network)


@dataclass(frozen=True, kw_only=True)
class Residual(Trainable):
    """Trainable static map made of layers that are 1-Lipschitz by construction. G is a stack of
    `depth` sandwich layers `h -> sqrt2 A^T Psi relu(sqrt2 Psi^-1 B h + b)`, followed by a linear
    one.

    With `A A^T + B B^T = I` from a Cayley map every value of the free parameters is 1-Lipschitz;
    written out, G is a perceptron with Lipschitz multipliers `Psi^2`. It couples the channels.
    Source: Wang & Manchester (2023), eqs. (8)-(11).
    """

    depth: int

    def __post_init__(self) -> None:
        require_at_least(1, "scaffold.depth", self.depth, "use 1 or 2")

    def initial_values(
        self, frame: MapContext, rng: np.random.Generator
    ) -> dict[str, Float[np.ndarray, "..."]]:
        m = frame.samples.shape[1]
        h = frame.width
        layers = range(self.depth)
        shrink = np.sqrt(h)
        free = {f"skew_{i}": rng.normal(size=(h, h)) / shrink for i in layers}
        for i in layers:
            widths = (h if i else m, h)
            free[f"tail_{i}"] = rng.normal(size=widths) / shrink
        last = rng.normal(size=(m, h)) / shrink
        free |= {f"scale_{i}": np.zeros(h) for i in layers}
        free |= {f"bias_{i}": rng.normal(size=h) for i in layers}
        free["last_skew"] = rng.normal(size=(m, m)) * 0.1
        return free | {"last_tail": last.T}

    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> "Sandwich":
        weights: list[Tensor] = []
        left: Any = None
        psis = [torch.exp(free[f"scale_{i}"]) for i in range(self.depth)]
        for i, psi in enumerate(psis):
            a, b = cayley_transform(free[f"skew_{i}"], free[f"tail_{i}"])
            enter = math.sqrt(2.0) * b / psi[:, None]
            weights.append(enter if left is None else enter @ left)
            left = math.sqrt(2.0) * a.T * psi  # sqrt2 A^T Psi, into the next layer
        _, b = cayley_transform(free["last_skew"], free["last_tail"])
        ball = (slopes[1] + slopes[0]) / 2, (slopes[1] - slopes[0]) / 2
        return ball, [*weights, b @ left], [free[f"bias_{i}"] for i in range(self.depth)], psis

    def evaluate(
        self, explicit: "Sandwich", v: Float[Tensor, "*batch m"]
    ) -> Float[Tensor, "*batch m"]:
        (alpha, beta), weights, biases, _ = explicit
        d = v
        for w, b in zip(weights[:-1], biases, strict=True):
            d = torch.relu(d @ w.T + b) - torch.relu(b)
        return alpha * v + beta * (d @ weights[-1].T)

    def freeze(self, explicit: "Sandwich", slopes: tuple[float, float]) -> ResidualScaffold:  # noqa: ARG002
        (alpha, beta), weights, biases, psis = explicit
        network = Network(
            weights=tuple(tensor_to_numpy(w) for w in weights),
            biases=tuple(tensor_to_numpy(b) for b in biases),
            negative_slopes=tuple(np.zeros(len(b)) for b in biases),
            positive_slopes=tuple(np.ones(len(b)) for b in biases),
        )
        multipliers = tuple(tensor_to_numpy(psi) ** 2 for psi in psis)
        return ResidualScaffold(alpha=alpha, beta=beta, network=network, multipliers=multipliers)


# `(alpha, beta)`, plain weights and biases of G, and `psi` of each hidden layer.
Sandwich = tuple[tuple[float, float], list[Tensor], list[Tensor], list[Tensor]]


def cayley_transform(
    skew: Float[Tensor, "h h"], tail: Float[Tensor, "m h"]
) -> tuple[Float[Tensor, "h h"], Float[Tensor, "h m"]]:
    """Orthonormal rows `(A, B)` from unconstrained matrices, by the Cayley transform. `(A, B)` with
    `A A^T + B B^T = I` for any real `skew, tail`.

    `Z = X - X^T + Y^T Y`, `A^T = (I + Z)^-1 (I - Z)`, `B^T = -2 Y (I + Z)^-1`.
    """
    eye = torch.eye(len(skew), dtype=skew.dtype, device=skew.device)
    z = skew - skew.T + tail.T @ tail  # skew plus Y^T Y: I + Z is always regular
    inverse = torch.linalg.inv(eye + z)
    return ((eye - z) @ inverse).T, (-2 * tail @ inverse).T
