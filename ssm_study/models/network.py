"""A leaky-ReLU network written around its value at zero, so that `N(0) = 0` holds to the last bit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.scaffold import arrays_from_json
from ssm_study.refusal import require


def leaky_relu(
    z: Float[np.ndarray, "*batch h"], negative: Float[np.ndarray, "h"], positive: Float[np.ndarray, "h"]
) -> Float[np.ndarray, "*batch h"]:
    """`phi(z) = positive z` for `z >= 0`, `negative z` below."""
    return np.where(z >= 0, positive, negative) * z


@dataclass(frozen=True, kw_only=True)
class Network:
    """`N(v) = W_{L+1} d_L,  d_l = phi_l(W_l d_{l-1} + b_l) - phi_l(b_l),  d_0 = v`.

    Any multilayer perceptron minus its value at zero has this form, with `b_l` the pre-activations at zero; here the
    subtraction happens before rounding can enter, so `N(0) = 0` exactly. `L = len(biases)` hidden layers; each neuron
    has its own slopes: `phi(z) = positive z` for `z >= 0`, `negative z` below.
    Shapes: `weights[l] (h_{l+1}, h_l)`, one more of them than of `biases[l]`, `negative_slopes[l]` and
    `positive_slopes[l] (h_{l+1},)`.
    """

    weights: tuple[Float[np.ndarray, "..."], ...]
    biases: tuple[Float[np.ndarray, "..."], ...]
    negative_slopes: tuple[Float[np.ndarray, "..."], ...]
    positive_slopes: tuple[Float[np.ndarray, "..."], ...]

    def __post_init__(self) -> None:
        widths = [w.shape[0] for w in self.weights[:-1]]
        fits = all(w.ndim == 2 for w in self.weights) and len(self.weights) >= 2
        fits = fits and all(w.shape[1] == h for w, h in zip(self.weights[1:], widths, strict=True))
        for layers in (self.biases, self.negative_slopes, self.positive_slopes):
            fits = fits and [layer.shape for layer in layers] == [(h,) for h in widths]
        shapes = [w.shape for w in self.weights]
        require(fits, "weights", shapes, "the layers do not fit each other", "write model.json again")

    @property
    def inputs(self) -> int:
        return self.weights[0].shape[1]

    @property
    def outputs(self) -> int:
        return self.weights[-1].shape[0]

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        d = v
        for w, b, low, high in self._hidden():
            d = leaky_relu(d @ w.T + b, low, high) - leaky_relu(b, low, high)
        return d @ self.weights[-1].T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """`W_{L+1} Phi_L W_L ... Phi_1 W_1` with the slopes active at `v`."""
        d, product = v, np.eye(self.inputs)
        for w, b, low, high in self._hidden():
            z = w @ d + b
            product = np.where(z >= 0, high, low)[:, None] * (w @ product)
            d = leaky_relu(z, low, high) - leaky_relu(b, low, high)
        return self.weights[-1] @ product

    def _hidden(self) -> list[tuple[Float[np.ndarray, "..."], ...]]:
        layers = (self.weights[:-1], self.biases, self.negative_slopes, self.positive_slopes)
        return list(zip(*layers, strict=True))

    def to_json(self) -> dict[str, Any]:
        names = ("weights", "biases", "negative_slopes", "positive_slopes")
        return {name: [layer.tolist() for layer in getattr(self, name)] for name in names}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Network":
        return cls(
            weights=arrays_from_json(data, "weights", 2),
            biases=arrays_from_json(data, "biases", 1),
            negative_slopes=arrays_from_json(data, "negative_slopes", 1),
            positive_slopes=arrays_from_json(data, "positive_slopes", 1),
        )
