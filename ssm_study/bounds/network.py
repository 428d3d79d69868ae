"""A leaky-ReLU network written around its value at zero, so that `N(0) = 0` holds to the last bit.

The scaffolding of [Z26] section IV.
"""

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

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
    subtraction happens before rounding can enter, so `N(0) = 0` exactly. `L = len(biases)` layers of `leaky_relu`,
    each neuron with its own slopes. Shapes: `weights[l] (h_{l+1}, h_l)`, one more of them than of `biases[l]`,
    `negative_slopes[l]` and `positive_slopes[l] (h_{l+1},)`.
    """

    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, "_"], ...]
    negative_slopes: tuple[Float[np.ndarray, "_"], ...]
    positive_slopes: tuple[Float[np.ndarray, "_"], ...]

    def __post_init__(self) -> None:
        widths = [w.shape[0] for w in self.weights[:-1]]
        fits = len(self.weights) >= 2 and all(w.shape[1] == h for w, h in zip(self.weights[1:], widths, strict=True))
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
        for w, b, low, high in self.hidden():
            d = leaky_relu(d @ w.T + b, low, high) - leaky_relu(b, low, high)
        return d @ self.weights[-1].T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """`W_{L+1} Phi_L W_L ... Phi_1 W_1` with the slopes active at `v`."""
        d, product = v, np.eye(self.inputs)
        for w, b, low, high in self.hidden():
            z = w @ d + b
            product = np.where(z >= 0, high, low)[:, None] * (w @ product)  # chain rule, slopes as they are active
            d = leaky_relu(z, low, high) - leaky_relu(b, low, high)
        return self.weights[-1] @ product

    def hidden(self) -> list[tuple[Float[np.ndarray, "..."], ...]]:
        """Weight, bias, negative and positive slopes of each hidden layer."""
        return list(zip(self.weights[:-1], self.biases, self.negative_slopes, self.positive_slopes, strict=True))

    def to_json(self) -> dict[str, Any]:
        return {name: [layer.tolist() for layer in layers] for name, layers in vars(self).items()}


@dataclass(frozen=True, kw_only=True)
class PortableMap:
    """`S(v) = linear v + N(v)`, N a leaky-ReLU network around its value at zero, or None. `linear (k, m)`."""

    linear: Float[np.ndarray, "k m"]
    network: Network | None

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        straight = v @ self.linear.T
        return straight if self.network is None else straight + self.network(v)

    def as_network(self) -> Network:
        """The same map as one network: `linear v` passes through neurons of slope one."""
        inputs, through = self.linear.shape[1], np.eye(self.linear.shape[1])
        zero, one = np.zeros(inputs), np.ones(inputs)
        if self.network is None:
            slopes = {"negative_slopes": (one,), "positive_slopes": (one,)}
            return Network(weights=(through, self.linear), biases=(zero,), **slopes)
        net, added = self.network, [through] * len(self.network.biases)
        inner = (scipy.linalg.block_diag(w, i) for w, i in zip(net.weights[1:-1], added[1:], strict=True))
        return Network(
            weights=(np.vstack([net.weights[0], through]), *inner, np.hstack([net.weights[-1], self.linear])),
            biases=tuple(np.append(b, zero) for b in net.biases),
            negative_slopes=tuple(np.append(s, one) for s in net.negative_slopes),
            positive_slopes=tuple(np.append(s, one) for s in net.positive_slopes),
        )

    def to_json(self) -> dict[str, Any]:
        return {"linear": self.linear.tolist()} | ({} if self.network is None else self.network.to_json())


Exact = tuple[np.ndarray, int]  # integers and bits: the value is integers / 2^bits
End = Fraction | float  # of an interval; a float only where it is infinite


@dataclass(frozen=True)
class _Piece:
    """On `(low, high)` the layer's output is `(slope t + offset) / 2^bits`, vectors of integers."""

    low: End
    high: End
    slope: np.ndarray
    offset: np.ndarray
    bits: int


def slope_values(network: Network) -> list[Fraction]:
    """Every slope the network takes, from left to right. Raises `BadRequest` for more than one channel.

    Between break points the network is affine; sorting them and listing the pieces gives all slopes. Weights are
    floats, hence dyadic rationals: slopes and offsets are integers over one power of two per layer, and only the break
    points are fractions. Nothing is rounded. It corrects the lower bound of [Z26] (docs/theory.md).
    """
    last, bits = _integers(network.weights[-1])
    return [Fraction((last @ piece.slope).item(), 1 << (bits + piece.bits)) for piece in _pieces(network)]


def slope_interval(network: Network) -> tuple[Fraction, Fraction]:
    """The exact `[mu, nu]`: the least and the greatest slope over all pieces."""
    values = slope_values(network)
    return min(values), max(values)


def break_points(network: Network) -> list[Fraction]:
    """Where the slope changes, in order; points between pieces of one slope may be among them. Refuses as above."""
    return [piece.low for piece in _pieces(network) if isinstance(piece.low, Fraction)]


def _pieces(network: Network) -> list[_Piece]:
    shape = (network.inputs, network.outputs)
    require(shape == (1, 1), "scaffold", shape, "break points order scalar maps only", "use method=interval or lipsdp")
    one = np.array([1], dtype=object)
    pieces = [_Piece(-inf, inf, one, 0 * one, 0)]
    for weights, biases, *slopes in network.hidden():
        layer = _integers(weights), _integers(biases), _integers(np.stack(slopes))
        pieces = [part for piece in pieces for part in _through(piece, *layer)]
    return pieces


def _integers(matrix: Float[np.ndarray, "..."]) -> Exact:  # matrix = integers / 2^bits, exactly
    ratios = [float(value).as_integer_ratio() for value in matrix.ravel()]
    bits = max(denominator.bit_length() - 1 for _, denominator in ratios)
    scaled = [numerator << (bits - denominator.bit_length() + 1) for numerator, denominator in ratios]
    return np.array(scaled, dtype=object).reshape(matrix.shape), bits


def _through(piece: _Piece, weights: Exact, biases: Exact, slopes: Exact) -> list[_Piece]:
    """Split one affine piece at the zeros of the layer's pre-activations, and apply the active slopes on each part."""
    affine, one = weights[1] + piece.bits, 1 << biases[1]
    bits = affine + biases[1]  # of the pre-activations, in which the biases are integers too
    at_zero = biases[0] * (1 << affine)
    slope, offset = weights[0] @ piece.slope * one, weights[0] @ piece.offset * one + at_zero
    zeros = {Fraction(-o, s) for s, o in zip(slope, offset, strict=True) if s != 0}
    edges = [piece.low, *sorted(t for t in zeros if piece.low < t < piece.high), piece.high]
    negative, positive = slopes[0]
    start = np.where(at_zero >= 0, positive, negative) * at_zero
    parts = []
    for low, high in pairwise(edges):
        active = np.where(slope * _between(low, high) + offset >= 0, positive, negative)
        parts.append(_Piece(low, high, active * slope, active * offset - start, bits + slopes[1]))
    return parts


def _between(low: End, high: End) -> Fraction:
    if isinstance(low, Fraction):
        return low + 1 if high == inf else (low + Fraction(high)) / 2
    return Fraction(high) - 1 if high != inf else Fraction(0)
