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

Vector = Float[np.ndarray, "_"]
Matrix = Float[np.ndarray, "_ _"]
Points = Float[np.ndarray, "*batch m"]
Values = Float[np.ndarray, "*batch k"]
Activations = Float[np.ndarray, "*batch h"]
Slopes = Float[np.ndarray, "h"]


def leaky_relu(z: Activations, negative: Slopes, positive: Slopes) -> Activations:
    """Leaky ReLU function with given slopes for positive and for negative arguments. `phi(z) =
    positive z` for `z >= 0`, `negative z` below."""
    slopes = np.where(z >= 0, positive, negative)
    return slopes * z


@dataclass(frozen=True, kw_only=True)
class Network:
    """Neural network with leaky ReLU whose output for zero input is exactly zero. `N(v) = W_{L+1}
    d_L, d_l = phi_l(W_l d_{l-1} + b_l) - phi_l(b_l), d_0 = v`.

    Any multilayer perceptron minus its value at zero has this form, with `b_l` the pre-activations
    at zero; here the subtraction happens before rounding can enter, so `N(0) = 0` exactly. `L =
    len(biases)` layers of `leaky_relu`, each neuron with its own slopes. Shapes: `weights[l]
    (h_{l+1}, h_l)`, one more of them than of `biases[l]`, `negative_slopes[l]` and
    `positive_slopes[l] (h_{l+1},)`.
    """

    weights: tuple[Matrix, ...]
    biases: tuple[Vector, ...]
    negative_slopes: tuple[Vector, ...]
    positive_slopes: tuple[Vector, ...]

    def __post_init__(self) -> None:
        shapes = [weight.shape for weight in self.weights]
        widths = [shape[0] for shape in shapes[:-1]]
        input_widths = [shape[1] for shape in shapes[1:]]
        layer_shapes = [(width,) for width in widths]
        fits = len(shapes) >= 2 and input_widths == widths
        for layers in (self.biases, self.negative_slopes, self.positive_slopes):
            fits = fits and [layer.shape for layer in layers] == layer_shapes
        problem = "the layers do not fit each other"
        require(fits, "weights", shapes, problem, "write model.json again")

    @property
    def input_count(self) -> int:
        """Number of input channels of a neural network."""
        first_weight = self.weights[0]
        return first_weight.shape[1]

    @property
    def output_count(self) -> int:
        """Number of output channels of a neural network."""
        last_weight = self.weights[-1]
        return last_weight.shape[0]

    def __call__(self, v: Points) -> Values:
        d = v
        for w, b, low, high in self.hidden_layers():
            z = d @ w.T + b
            at_zero = leaky_relu(b, low, high)
            d = leaky_relu(z, low, high) - at_zero
        last_weight = self.weights[-1]
        return d @ last_weight.T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """Jacobian matrix of a neural network at a point. `W_{L+1} Phi_L W_L ... Phi_1 W_1` with
        the slopes active at `v`."""
        d = v
        product = np.eye(self.input_count)
        for w, b, low, high in self.hidden_layers():
            z = w @ d + b
            active_slopes = np.where(z >= 0, high, low)
            product = active_slopes[:, None] * (w @ product)  # chain rule
            at_zero = leaky_relu(b, low, high)
            d = leaky_relu(z, low, high) - at_zero
        return self.weights[-1] @ product

    def hidden_layers(self) -> list[tuple[Float[np.ndarray, "..."], ...]]:
        """Weights, biases and leaky-ReLU slopes of each hidden layer of a network."""
        hidden_weights = self.weights[:-1]
        slopes = (self.negative_slopes, self.positive_slopes)
        layers = zip(hidden_weights, self.biases, *slopes, strict=True)
        return list(layers)

    def to_json(self) -> dict[str, Any]:
        """Convert the weights, biases and slopes of a network to nested lists for JSON."""
        lists = {}
        for name, layers in vars(self).items():
            lists[name] = [layer.tolist() for layer in layers]
        return lists


@dataclass(frozen=True, kw_only=True)
class PortableMap:
    """Static map as plain matrices, the sum of a linear map and a leaky-ReLU network. `S(v) =
    linear v + N(v)`, N a leaky-ReLU network around its value at zero, or None. `linear (k, m)`."""

    linear: Float[np.ndarray, "k m"]
    network: Network | None

    def __call__(self, v: Points) -> Values:
        linear_value = v @ self.linear.T
        if self.network is None:
            return linear_value
        return linear_value + self.network(v)

    def as_network(self) -> Network:
        """Rewrite a static map as one network, with the linear part as neurons of slope one."""
        inputs = self.linear.shape[1]
        identity = np.eye(inputs)
        no_bias = np.zeros(inputs)
        unit_slopes = np.ones(inputs)
        if self.network is None:
            return Network(
                weights=(identity, self.linear),
                biases=(no_bias,),
                negative_slopes=(unit_slopes,),
                positive_slopes=(unit_slopes,),
            )
        net = self.network
        first_weight, *inner_weights, last_weight = net.weights
        first = np.vstack([first_weight, identity])
        inner = [scipy.linalg.block_diag(weight, identity) for weight in inner_weights]
        last = np.hstack([last_weight, self.linear])
        return Network(
            weights=(first, *inner, last),
            biases=_append_to_each_layer(net.biases, no_bias),
            negative_slopes=_append_to_each_layer(net.negative_slopes, unit_slopes),
            positive_slopes=_append_to_each_layer(net.positive_slopes, unit_slopes),
        )

    def to_json(self) -> dict[str, Any]:
        """Convert the linear part and the network of a static map to nested lists for JSON."""
        linear_part = {"linear": self.linear.tolist()}
        if self.network is None:
            return linear_part
        return linear_part | self.network.to_json()


def _append_to_each_layer(layers: tuple[Vector, ...], entries: Vector) -> tuple[Vector, ...]:
    """Append the same numbers to one vector, such as the biases, of every layer of a network."""
    return tuple(np.append(layer, entries) for layer in layers)


Exact = tuple[np.ndarray, int]  # integers and bits: the value is integers / 2^bits
End = Fraction | float  # of an interval; a float only where it is infinite


@dataclass(frozen=True)
class _AffinePiece:
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
    """Points at which the slope of a network with one input and one output may change, in ascending
    order. Raises `BadRequest` for more than one channel."""
    lower_ends = [piece.low for piece in _affine_pieces(network)]
    return [end for end in lower_ends if isinstance(end, Fraction)]


def _affine_pieces(network: Network) -> list[_AffinePiece]:
    """Affine pieces of a network with one input and one output, computed layer by layer. Refuses a
    network with several inputs or outputs."""
    shape = (network.input_count, network.output_count)
    problem = "the method break_points takes maps of one input and one output"
    require(shape == (1, 1), "scaffold", shape, problem, "use method=interval or lipsdp")
    one = np.array([1], dtype=object)
    identity = _AffinePiece(-inf, inf, slope=one, offset=0 * one, bits=0)
    pieces = [identity]
    for weights, biases, *slopes in network.hidden_layers():
        exact_weights = _as_scaled_integers(weights)
        exact_biases = _as_scaled_integers(biases)
        exact_slopes = _as_scaled_integers(np.stack(slopes))
        parts = list[_AffinePiece]()
        for piece in pieces:
            parts += _split_at_layer(piece, exact_weights, exact_biases, exact_slopes)
        pieces = parts
    return pieces


def _as_scaled_integers(matrix: Float[np.ndarray, "..."]) -> Exact:
    """Exact representation of a matrix of floats as integers divided by a power of two. `matrix =
    integers / 2^bits`."""
    ratios = [float(value).as_integer_ratio() for value in matrix.ravel()]
    exponents = [denominator.bit_length() - 1 for _, denominator in ratios]
    bits = max(exponents)
    scaled = []
    for (numerator, _), exponent in zip(ratios, exponents, strict=True):
        scaled.append(numerator << (bits - exponent))
    integers = np.array(scaled, dtype=object)
    return integers.reshape(matrix.shape), bits


def _split_at_layer(
    piece: _AffinePiece, weights: Exact, biases: Exact, slopes: Exact
) -> list[_AffinePiece]:
    """Split an affine piece of a network where neurons of the next layer change sign, and apply
    that layer."""
    weight_integers, weight_bits = weights
    bias_integers, bias_bits = biases
    (negative, positive), slope_bits = slopes
    product_bits = weight_bits + piece.bits
    one = 1 << bias_bits
    bits = product_bits + bias_bits  # of the pre-activations, in which the biases are integers too
    at_zero = bias_integers * (1 << product_bits)
    slope = weight_integers @ piece.slope * one
    offset = weight_integers @ piece.offset * one + at_zero
    zeros = {Fraction(-o, s) for s, o in zip(slope, offset, strict=True) if s != 0}
    inner_edges = sorted(t for t in zeros if piece.low < t < piece.high)
    edges = [piece.low, *inner_edges, piece.high]
    slope_at_zero = np.where(at_zero >= 0, positive, negative)
    value_at_zero = slope_at_zero * at_zero
    output_bits = bits + slope_bits
    parts = []
    for low, high in pairwise(edges):
        pre_activation = slope * _number_between(low, high) + offset
        active = np.where(pre_activation >= 0, positive, negative)
        output_slope = active * slope
        output_offset = active * offset - value_at_zero
        parts.append(_AffinePiece(low, high, output_slope, output_offset, output_bits))
    return parts


def _number_between(low: End, high: End) -> Fraction:
    """Some number inside an interval whose ends may be infinite."""
    if not isinstance(low, Fraction):
        return Fraction(0) if high == inf else Fraction(high) - 1
    if high == inf:
        return low + 1
    return (low + Fraction(high)) / 2


# Break points, slopes and offsets of a piecewise-linear function of one variable.
ScalarPieces = tuple[Vector, Vector, Vector]


@dataclass(frozen=True, kw_only=True)
class InverseMap:
    """Inverse of a static map that is linear, or piecewise linear in each channel. `v = matrix w`,
    or per channel, with its points, slopes and offsets, `v = slopes[j] w + offsets[j]`.

    j is the count of `points <= w`.
    """

    matrix: Float[np.ndarray, "m k"] | None = None
    channels: tuple[ScalarPieces, ...] = ()

    def __call__(self, w: Values) -> Points:
        if self.matrix is not None:
            return w @ self.matrix.T
        v = np.empty_like(w)
        for c, (points, slopes, offsets) in enumerate(self.channels):
            values = w[..., c]
            piece = np.searchsorted(points, values, side="right")
            v[..., c] = slopes[piece] * values + offsets[piece]
        return v


def invert_map(portable: PortableMap) -> InverseMap | None:
    """Exact inverse of a static map; None for a map that couples its channels or is not strictly
    monotone.

    A piecewise-linear map from `t_j` to `w_j` has the inverse from `w_j` to `t_j`, piece by piece.
    Source: docs/theory.md, "With neurons".
    """
    gain = portable.linear
    if portable.network is None:
        is_square = len(set(gain.shape)) == 1
        is_regular = is_square and np.linalg.matrix_rank(gain) == len(gain)
        return InverseMap(matrix=np.linalg.inv(gain)) if is_regular else None
    scalar_maps = _split_into_scalar_maps(portable)
    inverses = [_invert_scalar_map(scalar_map) for scalar_map in scalar_maps]
    channels = tuple(channel for channel in inverses if channel is not None)
    if not inverses or len(channels) < len(inverses):
        return None
    return InverseMap(channels=channels)


def _split_into_scalar_maps(portable: PortableMap) -> list[PortableMap]:
    """Split a static map into scalar maps, one for each channel; empty if a neuron couples two
    channels."""
    net = portable.network
    linear = portable.linear
    gains = np.diagonal(linear)
    if linear.shape == (1, 1):
        return [portable]
    assert net is not None
    if len(net.biases) > 1:
        return []
    inner = net.weights[0]
    outer = net.weights[-1]
    is_diagonal = np.array_equal(linear, np.diag(gains))
    has_one_input = (inner != 0).sum(axis=1) <= 1
    leads_elsewhere = (outer.T != 0) & (inner == 0)
    is_decoupled = has_one_input.all() and not np.any(leads_elsewhere)
    if not is_diagonal or not is_decoupled:
        return []
    biases = net.biases[0]
    negative_slopes = net.negative_slopes[0]
    positive_slopes = net.positive_slopes[0]
    scalar_maps = []
    for c, gain in enumerate(gains):
        own = inner[:, c] != 0
        own_inner = inner[own, c : c + 1]
        own_outer = outer[c : c + 1, own]
        network = Network(
            weights=(own_inner, own_outer),
            biases=(biases[own],),
            negative_slopes=(negative_slopes[own],),
            positive_slopes=(positive_slopes[own],),
        )
        own_linear = np.array([[gain]])
        scalar_maps.append(PortableMap(linear=own_linear, network=network))
    return scalar_maps


def _invert_scalar_map(portable: PortableMap) -> ScalarPieces | None:
    """Inverse of a piecewise-linear scalar map, as break points, slopes and offsets; None if it is
    not strictly monotone. None where the map is not strictly monotone."""
    points = [float(t) for t in break_points(portable.as_network())]
    knots = np.unique(points)  # pieces of one slope share a point
    t = np.array([-1.0, 1.0])
    if len(knots):
        below = knots[0] - 1
        above = knots[-1] + 1
        t = np.concatenate([[below], knots, [above]])
    w = portable(t[:, None])[:, 0]
    if w[-1] < w[0]:  # a falling map, from its other end
        t = t[::-1]
        w = w[::-1]
    rises = np.diff(w)
    if not (rises > 0).all():
        return None
    inverse_slopes = np.diff(t) / rises
    inverse_offsets = t[:-1] - inverse_slopes * w[:-1]
    inverse_points = w[1:-1].copy()
    return inverse_points, inverse_slopes, inverse_offsets
