"""Static map that is piecewise linear and monotone, defined by its slopes. It is piecewise linear
in each channel, so the slope interval can be read off."""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, bound_from_interval
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds import scaffold
from ssm_study.models.scaffolds.scaffold import Free, Pieces, Scaffold, Square, tensor_to_numpy
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class MonotoneScaffold(Scaffold, names=("monotone",)):
    """Static map that is piecewise linear and monotone in each channel. `S_c(v) = int_0^v s_c(t)
    dt` in each channel c, `s_c = slopes[c, j]` between `breakpoints[c, j-1]` and `[c, j]`.

    Shapes: `breakpoints (m, h)` not decreasing along h, `slopes (m, h + 1)`. The exact slope
    interval is the smallest and the largest of `slopes`; the Jacobian is diagonal, so the interval
    is also the ball. Source: docs/theory.md ("construction"); any piecewise-linear monotone map
    with h break points has this form.
    """

    breakpoints: Float[np.ndarray, "m h"]
    slopes: Float[np.ndarray, "m h1"]

    def __post_init__(self) -> None:
        channels, breaks = self.breakpoints.shape
        shapes = (self.breakpoints.shape, self.slopes.shape)
        fits = self.slopes.shape == (channels, breaks + 1)
        problem = "need one slope more than break points"
        require(fits, "breakpoints, slopes", shapes, problem, "write model.json again")
        is_sorted = bool((np.diff(self.breakpoints, axis=1) >= 0).all())
        problem = "the break points must not decrease"
        require(is_sorted, "breakpoints", shapes[0], problem, "sort them")

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        out = np.empty_like(v)
        for c in range(len(self.breakpoints)):
            breakpoints = self.breakpoints[c]
            slopes = self.slopes[c]
            offsets = continuous_offsets(breakpoints, slopes)
            piece = np.searchsorted(breakpoints, v[..., c], side="right")
            out[..., c] = slopes[piece] * v[..., c] + offsets[piece]
        return out

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Square:
        slopes_at = []
        for breakpoints, slopes, value in zip(self.breakpoints, self.slopes, v, strict=True):
            piece = np.searchsorted(breakpoints, value, side="right")
            slopes_at.append(slopes[piece])
        return np.diag(slopes_at)

    def bound(self) -> SlopeBound:
        values = [Fraction(float(slope)) for slope in self.slopes.ravel()]
        return bound_from_interval(min(values), max(values), "construction")

    def jacobian_centre(self) -> Square:
        return np.diag((self.slopes.max(axis=1) + self.slopes.min(axis=1)) / 2)

    def compose_with_output_matrix(self, m: Square) -> "MonotoneScaffold":
        return replace(self, slopes=np.diagonal(m)[:, None] * self.slopes)

    def compose_with_input_matrix(self, m: Square) -> "MonotoneScaffold":
        gains = np.diagonal(m)[:, None]
        breakpoints = self.breakpoints / gains
        slopes = gains * self.slopes
        turned = gains < 0  # a negative gain runs through the pieces from the other end
        breakpoints = np.where(turned, breakpoints[:, ::-1], breakpoints)
        slopes = np.where(turned, slopes[:, ::-1], slopes)
        return MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)

    def as_portable(self) -> PortableMap:
        """Network with one neuron per break point that computes the same map. `S_c(v) = s_0 v +
        sum_j (s_{j+1} - s_j) (relu(v - t_j) - relu(-t_j))`."""
        channels, breaks = self.breakpoints.shape
        linear = np.diag(self.slopes[:, 0])
        if not breaks:
            return PortableMap(linear=linear, network=None)
        neurons = np.repeat(np.eye(channels), breaks, axis=0)
        bends = np.diff(self.slopes, axis=1).ravel()
        count = channels * breaks
        network = Network(
            weights=(neurons, neurons.T * bends),
            biases=(-self.breakpoints.ravel(),),
            negative_slopes=(np.zeros(count),),
            positive_slopes=(np.ones(count),),
        )
        return PortableMap(linear=linear, network=network)


def continuous_offsets(
    breakpoints: Float[np.ndarray, "h"], slopes: Float[np.ndarray, "h1"]
) -> Float[np.ndarray, "h1"]:
    """Offsets with which affine pieces join continuously. The piece `slope v + offset` that
    contains v = 0 has offset zero."""
    home = int(np.searchsorted(breakpoints, 0.0, side="right"))
    jumps = (slopes[:-1] - slopes[1:]) * breakpoints
    left = -np.cumsum(jumps[:home][::-1])[::-1]
    right = np.cumsum(jumps[home:])
    return np.concatenate([left, [0.0], right])


@dataclass(frozen=True, kw_only=True)
class Monotone(Trainable):
    """Trainable piecewise-linear monotone map. Slopes `lower + (upper - lower) sigmoid(free)`
    between sorted break points, `hidden_width` of them per channel.

    The Jacobian is diagonal, so the sector is the ball. The break points move with training: when
    two cross, the piece between them has zero width and the map stays continuous in its parameters.
    """

    def initial_values(
        self,
        frame: MapContext,
        rng: np.random.Generator,  # noqa: ARG002
    ) -> dict[str, Float[np.ndarray, "..."]]:
        ranks = (np.arange(frame.width) + 0.5) / frame.width
        points = np.quantile(frame.samples, ranks, axis=0).T
        free = np.zeros((len(points), frame.width + 1))
        return {"points": points, "free": free}

    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> Pieces:
        lower, upper = slopes
        points = free["points"].sort(dim=-1).values
        inside = lower + (upper - lower) * torch.sigmoid(free["free"])
        return points, inside, scaffold.zero_preserving_offsets(points, inside)

    def evaluate(self, explicit: Pieces, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        return scaffold.evaluate_pieces(explicit, v)

    def pieces(self, explicit: Pieces) -> Pieces | None:
        points, inside, offsets = explicit
        if len(points) > 1:
            return None
        return points[0], inside[0], offsets[0]

    def roughness(self, explicit: Pieces) -> Float[Tensor, ""]:
        return scaffold.relative_roughness(explicit[1]).sum(-1)

    def freeze(self, explicit: Pieces, slopes: tuple[float, float]) -> MonotoneScaffold:  # noqa: ARG002
        points, inside, _ = explicit
        return MonotoneScaffold(breakpoints=tensor_to_numpy(points), slopes=tensor_to_numpy(inside))
