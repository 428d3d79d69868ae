"""Leaky-ReLU networks whose value at zero is exactly zero, with their slopes and inverses.

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
    z: Float[np.ndarray, "*batch h"],
    negative: Float[np.ndarray, "h"],
    positive: Float[np.ndarray, "h"],
) -> Float[np.ndarray, "*batch h"]:
    """Leaky ReLU with one slope for positive and one for negative arguments. `phi(z) = positive
    z` for `z >= 0`, `negative z` below."""
    return np.where(z >= 0, positive, negative) * z


@dataclass(frozen=True, kw_only=True)
class Network:
    """Leaky-ReLU network whose value at zero is exactly zero. `N(v) = W_{L+1} d_L,  d_l = phi_l(W_l
    d_{l-1} + b_l) - phi_l(b_l),  d_0 = v`.

    Any multilayer perceptron minus its value at zero has this form, with `b_l` the pre-activations
    at zero; here the subtraction happens before rounding can enter, so `N(0) = 0` exactly. `L =
    len(biases)` layers of `leaky_relu`, each neuron with its own slopes. Shapes: `weights[l]
    (h_{l+1}, h_l)`, one more of them than of `biases[l]`, `negative_slopes[l]` and
    `positive_slopes[l] (h_{l+1},)`.
    """

    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, "_"], ...]
    negative_slopes: tuple[Float[np.ndarray, "_"], ...]
    positive_slopes: tuple[Float[np.ndarray, "_"], ...]

    def __post_init__(self) -> None:
        widths = [w.shape[0] for w in self.weights[:-1]]
        fits = len(self.weights) >= 2 and all(
            w.shape[1] == h for w, h in zip(self.weights[1:], widths, strict=True)
        )
        for layers in (self.biases, self.negative_slopes, self.positive_slopes):
            fits = fits and [layer.shape for layer in layers] == [(h,) for h in widths]
        shapes = [w.shape for w in self.weights]
        require(
            fits, "weights", shapes, "the layers do not fit each other", "write model.json again"
        )

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.weights[0].shape[1]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.weights[-1].shape[0]

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        d = v
        for w, b, low, high in self.hidden_layers():
            d = leaky_relu(d @ w.T + b, low, high) - leaky_relu(b, low, high)
        return d @ self.weights[-1].T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """Jacobian matrix of the network at a point. `W_{L+1} Phi_L W_L ... Phi_1 W_1` with the
        slopes active at `v`."""
        d = v
        product = np.eye(self.inputs)
        for w, b, low, high in self.hidden_layers():
            z = w @ d + b
            product = np.where(z >= 0, high, low)[:, None] * (
                w @ product
            )  # chain rule, slopes as they are active
            d = leaky_relu(z, low, high) - leaky_relu(b, low, high)
        return self.weights[-1] @ product

    def hidden_layers(self) -> list[tuple[Float[np.ndarray, "..."], ...]]:
        """Weight, bias, negative and positive slopes of each hidden layer."""
        return list(
            zip(
                self.weights[:-1],
                self.biases,
                self.negative_slopes,
                self.positive_slopes,
                strict=True,
            )
        )

    def to_json(self) -> dict[str, Any]:
        """Weights, biases and slopes as nested lists for JSON."""
        return {name: [layer.tolist() for layer in layers] for name, layers in vars(self).items()}


@dataclass(frozen=True, kw_only=True)
class PortableMap:
    """Static map as plain matrices, for evaluation without a deep-learning framework. `S(v) =
    linear v + N(v)`, N a leaky-ReLU network around its value at zero, or None. `linear (k, m)`."""

    linear: Float[np.ndarray, "k m"]
    network: Network | None

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        straight = v @ self.linear.T
        return straight if self.network is None else straight + self.network(v)

    def as_network(self) -> Network:
        """Rewrite the whole map as one network, with its linear part as neurons of slope one."""
        inputs = self.linear.shape[1]
        through = np.eye(self.linear.shape[1])
        zero = np.zeros(inputs)
        one = np.ones(inputs)
        if self.network is None:
            slopes = {"negative_slopes": (one,), "positive_slopes": (one,)}
            return Network(weights=(through, self.linear), biases=(zero,), **slopes)
        net = self.network
        first = np.vstack([net.weights[0], through])
        inner = [scipy.linalg.block_diag(weight, through) for weight in net.weights[1:-1]]
        last = np.hstack([net.weights[-1], self.linear])
        biases = [np.append(bias, zero) for bias in net.biases]
        negative_slopes = [np.append(slopes, one) for slopes in net.negative_slopes]
        positive_slopes = [np.append(slopes, one) for slopes in net.positive_slopes]
        return Network(
            weights=(first, *inner, last),
            biases=tuple(biases),
            negative_slopes=tuple(negative_slopes),
            positive_slopes=tuple(positive_slopes),
        )

    def to_json(self) -> dict[str, Any]:
        """Linear part and network as nested lists for JSON."""
        columns = {"linear": self.linear.tolist()}
        network = {} if self.network is None else self.network.to_json()
        return columns | network


Exact = tuple[np.ndarray, int]  # integers and bits: the value is integers / 2^bits
End = Fraction | float  # of an interval; a float only where it is infinite
Row = Float[np.ndarray, "_"]


@dataclass(frozen=True)
class _Piece:
    """Affine piece of a piecewise-linear scalar network, in exact integer arithmetic. On `(low,
    high)` the layer's output is `(slope t + offset) / 2^bits`, vectors of integers."""

    low: End
    high: End
    slope: np.ndarray
    offset: np.ndarray
    bits: int


def slope_interval(network: Network) -> tuple[Fraction, Fraction]:
    """Exact smallest and largest slope of a network with one input and one output. Raises
    `BadRequest` for more than one channel.

    Between break points the network is affine; sorting them and listing the pieces gives all
    slopes. Weights are floats, hence dyadic rationals: slopes and offsets are integers over one
    power of two per layer, and only the break points are fractions. Nothing is rounded. It corrects
    the lower bound of [Z26] (docs/theory.md).
    """
    last, bits = _as_scaled_integers(network.weights[-1])
    values = []
    for piece in _affine_pieces(network):
        slope = (last @ piece.slope).item()
        power_of_two = 1 << (bits + piece.bits)
        values.append(Fraction(slope, power_of_two))
    return min(values), max(values)


def break_points(network: Network) -> list[Fraction]:
    """Points, in ascending order, at which the slope of a scalar network may change. Raises
    `BadRequest` for more than one channel."""
    return [piece.low for piece in _affine_pieces(network) if isinstance(piece.low, Fraction)]


def _affine_pieces(network: Network) -> list[_Piece]:
    """Affine pieces of a scalar network, found layer by layer. Refuses a network with several
    inputs or outputs."""
    shape = (network.inputs, network.outputs)
    require(
        shape == (1, 1),
        "scaffold",
        shape,
        "break points order scalar maps only",
        "use method=interval or lipsdp",
    )
    one = np.array([1], dtype=object)
    pieces = [_Piece(-inf, inf, one, 0 * one, 0)]
    for weights, biases, *slopes in network.hidden_layers():
        layer = (
            _as_scaled_integers(weights),
            _as_scaled_integers(biases),
            _as_scaled_integers(np.stack(slopes)),
        )
        pieces = [part for piece in pieces for part in _split_at_layer(piece, *layer)]
    return pieces


def _as_scaled_integers(
    matrix: Float[np.ndarray, "..."],
) -> Exact:  # matrix = integers / 2^bits, exactly
    """Write a matrix of floats exactly as integers divided by a power of two. `matrix = integers /
    2^bits`."""
    ratios = [float(value).as_integer_ratio() for value in matrix.ravel()]
    bits = max(denominator.bit_length() - 1 for _, denominator in ratios)
    scaled = [
        numerator << (bits - denominator.bit_length() + 1) for numerator, denominator in ratios
    ]
    return np.array(scaled, dtype=object).reshape(matrix.shape), bits


def _split_at_layer(piece: _Piece, weights: Exact, biases: Exact, slopes: Exact) -> list[_Piece]:
    """Split an affine piece where a neuron of the next layer changes sign, and apply the neurons'
    slopes."""
    affine = weights[1] + piece.bits
    one = 1 << biases[1]
    bits = affine + biases[1]  # of the pre-activations, in which the biases are integers too
    at_zero = biases[0] * (1 << affine)
    slope = weights[0] @ piece.slope * one
    offset = weights[0] @ piece.offset * one + at_zero
    zeros = {Fraction(-o, s) for s, o in zip(slope, offset, strict=True) if s != 0}
    edges = [piece.low, *sorted(t for t in zeros if piece.low < t < piece.high), piece.high]
    negative, positive = slopes[0]
    start = np.where(at_zero >= 0, positive, negative) * at_zero
    parts = []
    for low, high in pairwise(edges):
        active = np.where(slope * _number_between(low, high) + offset >= 0, positive, negative)
        parts.append(_Piece(low, high, active * slope, active * offset - start, bits + slopes[1]))
    return parts


def _number_between(low: End, high: End) -> Fraction:
    """Number inside an interval that may be unbounded."""
    if isinstance(low, Fraction):
        return low + 1 if high == inf else (low + Fraction(high)) / 2
    return Fraction(high) - 1 if high != inf else Fraction(0)


@dataclass(frozen=True, kw_only=True)
class Inverse:
    """Inverse of a static map that is linear, or piecewise linear in each channel. `v = matrix w`,
    or per channel, with its points, slopes and offsets, `v = slopes[j] w + offsets[j]`.

    j is the count of `points <= w`.
    """

    matrix: Float[np.ndarray, "m k"] | None = None
    channels: tuple[tuple[Row, Row, Row], ...] = ()

    def __call__(self, w: Float[np.ndarray, "*batch k"]) -> Float[np.ndarray, "*batch m"]:
        if self.matrix is not None:
            return w @ self.matrix.T
        v = np.empty_like(w)
        for c, (points, slopes, offsets) in enumerate(self.channels):
            piece = np.searchsorted(points, w[..., c], side="right")
            v[..., c] = slopes[piece] * w[..., c] + offsets[piece]
        return v


def invert_map(portable: PortableMap) -> Inverse | None:
    """Exact inverse of a static map; None for a map that couples its channels or is not strictly
    monotone.

    A piecewise-linear map from `t_j` to `w_j` has the inverse from `w_j` to `t_j`, piece by piece.
    Source: docs/theory.md, "With neurons".
    """
    gain = portable.linear
    if portable.network is None:
        regular = len(set(gain.shape)) == 1 and np.linalg.matrix_rank(gain) == len(gain)
        return Inverse(matrix=np.linalg.inv(gain)) if regular else None
    inverses = [_invert_scalar_map(channel) for channel in _split_into_scalar_maps(portable)]
    channels = tuple(channel for channel in inverses if channel is not None)
    return Inverse(channels=channels) if inverses and len(channels) == len(inverses) else None


def _split_into_scalar_maps(portable: PortableMap) -> list[PortableMap]:
    """Split a static map into one scalar map for each channel; empty if a neuron couples two
    channels."""
    net = portable.network
    gains = np.diagonal(portable.linear)
    if portable.linear.shape == (1, 1):
        return [portable]
    assert net is not None
    if len(net.biases) > 1:
        return []
    inner = net.weights[0]
    outer = net.weights[-1]
    diagonal = np.array_equal(portable.linear, np.diag(gains))
    has_one_input = (inner != 0).sum(axis=1) <= 1
    leads_elsewhere = (outer.T != 0) & (inner == 0)
    apart = has_one_input.all() and not np.any(leads_elsewhere)
    if not diagonal or not apart:
        return []
    scalar_maps = []
    for c, gain in enumerate(gains):
        own = inner[:, c] != 0
        channel = slice(c, c + 1)
        network = Network(
            weights=(inner[own, channel], outer[channel, own]),
            biases=(net.biases[0][own],),
            negative_slopes=(net.negative_slopes[0][own],),
            positive_slopes=(net.positive_slopes[0][own],),
        )
        linear = np.array([[gain]])
        scalar_maps.append(PortableMap(linear=linear, network=network))
    return scalar_maps


def _invert_scalar_map(portable: PortableMap) -> tuple[Row, Row, Row] | None:
    """Break points, slopes and offsets of the inverse of a scalar piecewise-linear map. None where
    the map is not strictly monotone."""
    points = [float(t) for t in break_points(portable.as_network())]
    knots = np.unique(points)  # pieces of one slope share a point
    t = np.array([-1.0, 1.0])
    if len(knots):
        t = np.concatenate([[knots[0] - 1], knots, [knots[-1] + 1]])
    w = portable(t[:, None])[:, 0]
    if w[-1] < w[0]:  # a falling map, from its other end
        t = t[::-1]
        w = w[::-1]
    if not (np.diff(w) > 0).all():
        return None
    slopes = np.diff(t) / np.diff(w)  # of the inverse
    offsets = t[:-1] - slopes * w[:-1]
    return w[1:-1].copy(), slopes, offsets
