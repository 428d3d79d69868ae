"""The inverse of a scaffolding that is strictly monotone by channel: piece by piece, as exact as its slopes.

Source: docs/theory.md, "With neurons".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, PortableMap, break_points

Row = Float[np.ndarray, "_"]


@dataclass(frozen=True, kw_only=True)
class Inverse:
    """`v = matrix w`, or per channel, with its points, slopes and offsets, `v = slopes[j] w + offsets[j]`.

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


def inverse_of(portable: PortableMap) -> Inverse | None:
    """The inverse; None for a map that couples its channels or is not strictly monotone.

    A piecewise-linear map from `t_j` to `w_j` has the inverse from `w_j` to `t_j`, piece by piece.
    """
    gain = portable.linear
    if portable.network is None:
        regular = len(set(gain.shape)) == 1 and np.linalg.matrix_rank(gain) == len(gain)
        return Inverse(matrix=np.linalg.inv(gain)) if regular else None
    found = [_scalar(channel) for channel in _channels(portable)]
    channels = tuple(channel for channel in found if channel is not None)
    return Inverse(channels=channels) if found and len(channels) == len(found) else None


def _channels(portable: PortableMap) -> list[PortableMap]:
    """One scalar map per channel; none if a neuron sees or moves two of them."""
    net, gains = portable.network, np.diagonal(portable.linear)
    if portable.linear.shape == (1, 1):
        return [portable]
    assert net is not None
    inner, outer = net.weights[0], net.weights[-1]
    diagonal = np.array_equal(portable.linear, np.diag(gains))
    apart = ((inner != 0).sum(axis=1) <= 1).all() and not np.any((outer.T != 0) & (inner == 0))  # one in, same out
    if len(net.biases) > 1 or not diagonal or not apart:
        return []
    found = []
    for c, gain in enumerate(gains):
        own = inner[:, c] != 0
        layers = {name: (getattr(net, name)[0][own],) for name in ("biases", "negative_slopes", "positive_slopes")}
        network = Network(weights=(inner[own, c : c + 1], outer[c : c + 1, own]), **layers)
        found.append(PortableMap(linear=np.array([[gain]]), network=network))
    return found


def _scalar(portable: PortableMap) -> tuple[Row, Row, Row] | None:
    knots = np.unique([float(t) for t in break_points(portable.as_network())])  # pieces of one slope share a point
    t = np.concatenate([[knots[0] - 1], knots, [knots[-1] + 1]]) if len(knots) else np.array([-1.0, 1.0])
    w = portable(t[:, None])[:, 0]
    t, w = (t[::-1], w[::-1]) if w[-1] < w[0] else (t, w)  # a falling map, from its other end
    if not (np.diff(w) > 0).all():
        return None
    slopes = np.diff(t) / np.diff(w)  # of the inverse
    return w[1:-1].copy(), slopes, t[:-1] - slopes * w[:-1]
