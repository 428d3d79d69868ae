"""Static map, in any dimension, whose Jacobians lie in a ball by construction."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.lipschitz import is_proved_nonexpansive
from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, bound_from_ball, network_slope_bound
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds.scaffold import Free, Scaffold, Square, tensor_to_numpy
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require, require_at_least
from ssm_study.systems import JacobianBall


@dataclass(frozen=True, kw_only=True)
class ResidualScaffold(Scaffold, names=("residual",)):
    """Static map of any dimension whose Jacobians lie in a known ball by construction. `S(v) =
    alpha v + beta (G(v) - G(0))` with `|G(v) - G(w)| <= |v - w|` gives exactly the ball `alpha I +
    beta Delta`.

    `multipliers[l] (h_l,) > 0` are the diagonal multipliers of the Lipschitz certificate of G. It
    is decided exactly whenever the ball is asked for (`bounds.lipschitz`). Where they prove nothing
    the map is bounded from its numbers like any other network. Source: Wang & Manchester (2023).
    """

    alpha: float
    beta: float
    multipliers: tuple[Float[np.ndarray, "_"], ...]
    network: Network

    def __post_init__(self) -> None:
        outputs = self.network.output_count
        problem = "as many outputs as inputs are needed"
        input_count = self.network.input_count
        require(input_count == outputs, "weights", outputs, problem, "use kind mlp")
        remedy = "write model.json again"
        require_at_least(0, "beta", self.beta, remedy)
        shapes = [t.shape for t in self.multipliers]
        needed = [b.shape for b in self.network.biases]
        fits = shapes == needed and all(bool((t > 0).all()) for t in self.multipliers)
        neuron_count = len(shapes)
        require(fits, "multipliers", neuron_count, "need one per neuron, positive", remedy)

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        linear_part = self.alpha * v
        residual_part = self.beta * self.network(v)
        return linear_part + residual_part

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Square:
        identity = np.eye(self.network.input_count)
        residual_slope = self.network.jacobian(v)
        return self.alpha * identity + self.beta * residual_slope

    def slope_bound(self) -> SlopeBound:
        if not is_proved_nonexpansive(self.network, self.multipliers):
            network = self.as_portable().as_network()
            return network_slope_bound(network)
        ball = JacobianBall(alpha=self.alpha, beta=self.beta)
        return bound_from_ball(ball, "construction")

    def jacobian_centre(self) -> None:
        """Return None, because the Jacobians already lie around a multiple of the identity."""
        return

    def as_portable(self) -> PortableMap:
        *inner, last = self.network.weights
        scaled_last = self.beta * last
        network = replace(self.network, weights=(*inner, scaled_last))
        linear = self.alpha * np.eye(network.input_count)
        return PortableMap(linear=linear, network=network)


@dataclass(frozen=True, kw_only=True)
class Residual(Trainable):
    """Trainable static map of any dimension, made of layers that are 1-Lipschitz by construction. G
    is a stack of `depth` sandwich layers `h -> sqrt2 A^T Psi relu(sqrt2 Psi^-1 B h + b)`, followed
    by a linear one.

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
            random_tail = rng.normal(size=widths)
            free[f"tail_{i}"] = random_tail / shrink
        random_last = rng.normal(size=(m, h))
        last = random_last / shrink
        free |= {f"scale_{i}": np.zeros(h) for i in layers}
        free |= {f"bias_{i}": rng.normal(size=h) for i in layers}
        random_skew = rng.normal(size=(m, m))
        free["last_skew"] = random_skew * 0.1
        return free | {"last_tail": last.T}

    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> "Sandwich":
        weights: list[Tensor] = []
        left: Any = None
        psis = [torch.exp(free[f"scale_{i}"]) for i in range(self.depth)]
        for i, psi in enumerate(psis):
            a, b = cayley_transform(free[f"skew_{i}"], free[f"tail_{i}"])
            scaled_b = math.sqrt(2.0) * b
            enter = scaled_b / psi[:, None]
            joined_weight = enter if left is None else enter @ left
            weights.append(joined_weight)
            scaled_a = math.sqrt(2.0) * a.T
            left = scaled_a * psi  # sqrt2 A^T Psi, into the next layer
        _, b = cayley_transform(free["last_skew"], free["last_tail"])
        alpha = (slopes[1] + slopes[0]) / 2
        beta = (slopes[1] - slopes[0]) / 2
        ball = alpha, beta
        all_weights = [*weights, b @ left]
        biases = [free[f"bias_{i}"] for i in range(self.depth)]
        return ball, all_weights, biases, psis

    def evaluate(
        self, explicit: "Sandwich", v: Float[Tensor, "*batch m"]
    ) -> Float[Tensor, "*batch m"]:
        (alpha, beta), weights, biases, _ = explicit
        d = v
        inner_weights = weights[:-1]
        for w, b in zip(inner_weights, biases, strict=True):
            activated = torch.relu(d @ w.T + b)
            at_zero = torch.relu(b)
            d = activated - at_zero
        network_output = d @ weights[-1].T
        return alpha * v + beta * network_output

    def to_numpy(self, explicit: "Sandwich", slopes: tuple[float, float]) -> ResidualScaffold:  # noqa: ARG002
        (alpha, beta), weights, biases, psis = explicit
        weight_arrays = tuple(tensor_to_numpy(w) for w in weights)
        bias_arrays = tuple(tensor_to_numpy(b) for b in biases)
        negative_slopes = tuple(np.zeros(len(b)) for b in biases)
        positive_slopes = tuple(np.ones(len(b)) for b in biases)
        network = Network(
            weights=weight_arrays,
            biases=bias_arrays,
            negative_slopes=negative_slopes,
            positive_slopes=positive_slopes,
        )
        squared_scales = (tensor_to_numpy(psi) ** 2 for psi in psis)
        multipliers = tuple(squared_scales)
        return ResidualScaffold(alpha=alpha, beta=beta, network=network, multipliers=multipliers)


# `(alpha, beta)`, plain weights and biases of G, and `psi` of each hidden layer.
Sandwich = tuple[tuple[float, float], list[Tensor], list[Tensor], list[Tensor]]


def cayley_transform(
    skew: Float[Tensor, "h h"], tail: Float[Tensor, "m h"]
) -> tuple[Float[Tensor, "h h"], Float[Tensor, "h m"]]:
    """Matrix with orthonormal rows from unconstrained matrices, by the Cayley transform. `(A, B)`
    with `A A^T + B B^T = I` for any real `skew, tail`.

    `Z = X - X^T + Y^T Y`, `A^T = (I + Z)^-1 (I - Z)`, `B^T = -2 Y (I + Z)^-1`.
    """
    width = len(skew)
    eye = torch.eye(width, dtype=skew.dtype, device=skew.device)
    antisymmetric = skew - skew.T
    gram = tail.T @ tail
    z = antisymmetric + gram  # skew plus Y^T Y: I + Z is always regular
    inverse = torch.linalg.inv(eye + z)
    first_rows = (eye - z) @ inverse
    doubled_tail = -2 * tail
    last_rows = doubled_tail @ inverse
    return first_rows.T, last_rows.T
