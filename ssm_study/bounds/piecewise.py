"""The exact slope interval of a scalar leaky-ReLU network, from its break points, in rational arithmetic.

Between break points the network is affine, so its slope takes finitely many values; sorting the break points and
listing the pieces gives them all. Weights are floats, hence dyadic rationals: slopes and offsets are kept as integers
over one power of two per layer, and only the break points are fractions. Nothing is rounded anywhere. It corrects the
lower bound of [Z26] (docs/theory.md).
"""

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ssm_study.models.network import Network
from ssm_study.refusal import require


@dataclass(frozen=True)
class _Layer:
    """One hidden layer in integers: real value = integer / 2^bits."""

    weights: np.ndarray
    biases: np.ndarray
    negative: np.ndarray
    positive: np.ndarray
    weight_bits: int
    slope_bits: int


@dataclass(frozen=True)
class _Piece:
    """On `(low, high)` the layer's output is `(slope t + offset) / 2^bits`, vectors of integers; None: unbounded."""

    low: Fraction | None
    high: Fraction | None
    slope: np.ndarray
    offset: np.ndarray
    bits: int


def slope_values(network: Network) -> list[Fraction]:
    """Every slope the network takes, from left to right. Raises `BadRequest` for more than one channel."""
    shape = (network.inputs, network.outputs)
    require(shape == (1, 1), "scaffold", shape, "break points order scalar maps only", "use method=interval or lipsdp")
    one = np.array([1], dtype=object)
    pieces = [_Piece(None, None, one, 0 * one, 0)]
    for depth in range(len(network.biases)):
        layer = _integer_layer(network, depth)
        pieces = [part for piece in pieces for part in _through(layer, piece)]
    last, bits = _integers(network.weights[-1])
    return [Fraction((last @ piece.slope).item(), 1 << (bits + piece.bits)) for piece in pieces]


def slope_interval(network: Network) -> tuple[Fraction, Fraction]:
    """The exact `[mu, nu]`: the least and the greatest slope over all pieces."""
    values = slope_values(network)
    return min(values), max(values)


def _integer_layer(network: Network, depth: int) -> _Layer:
    weights, weight_bits = _integers(network.weights[depth])
    both, slope_bits = _integers(np.stack([network.negative_slopes[depth], network.positive_slopes[depth]]))
    biases = np.array([Fraction(float(value)) for value in network.biases[depth]], dtype=object)
    return _Layer(weights, biases, both[0], both[1], weight_bits, slope_bits)


def _integers(matrix: Float[np.ndarray, "..."]) -> tuple[np.ndarray, int]:
    """`matrix = integers / 2^bits`, exactly."""
    ratios = [float(value).as_integer_ratio() for value in matrix.ravel()]
    bits = max(denominator.bit_length() - 1 for _, denominator in ratios)
    scaled = [numerator << (bits - denominator.bit_length() + 1) for numerator, denominator in ratios]
    return np.array(scaled, dtype=object).reshape(matrix.shape), bits


def _through(layer: _Layer, piece: _Piece) -> list[_Piece]:
    """Split one affine piece at the zeros of the layer's pre-activations, and apply the active slopes on each part."""
    bits = layer.weight_bits + piece.bits
    slope = layer.weights @ piece.slope
    offset = layer.weights @ piece.offset
    extra = max((b.denominator.bit_length() - 1 for b in layer.biases), default=0)
    bits, slope, offset = bits + extra, slope * (1 << extra), offset * (1 << extra)
    biases = np.array([int(b * (1 << bits)) for b in layer.biases], dtype=object)
    offset = offset + biases
    zeros = {Fraction(-o, s) for s, o in zip(slope, offset, strict=True) if s != 0}
    inside = sorted(t for t in zeros if _above(piece.low, t) and _below(piece.high, t))
    edges = [piece.low, *inside, piece.high]
    at_zero = np.where(biases >= 0, layer.positive, layer.negative) * biases
    parts = []
    for low, high in pairwise(edges):
        t = _between(low, high)
        active = np.where(slope * t + offset >= 0, layer.positive, layer.negative)
        parts.append(_Piece(low, high, active * slope, active * offset - at_zero, bits + layer.slope_bits))
    return parts


def _above(low: Fraction | None, t: Fraction) -> bool:
    return low is None or t > low


def _below(high: Fraction | None, t: Fraction) -> bool:
    return high is None or t < high


def _between(low: Fraction | None, high: Fraction | None) -> Fraction:
    if low is None:
        return Fraction(0) if high is None else high - 1
    return low + 1 if high is None else (low + high) / 2
