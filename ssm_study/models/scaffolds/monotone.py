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
        breakpoint_shape = self.breakpoints.shape
        slope_shape = self.slopes.shape
        shapes = (breakpoint_shape, slope_shape)
        needed_shape = (channels, breaks + 1)
        fits = self.slopes.shape == needed_shape
        problem = "need one slope more than break points"
        require(fits, "breakpoints, slopes", shapes, problem, "write model.json again")
        distances = np.diff(self.breakpoints, axis=1)
        is_sorted = bool((distances >= 0).all())
        problem = "the break points must not decrease"
        require(is_sorted, "breakpoints", shapes[0], problem, "sort them")

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        out = np.empty_like(v)
        for c in range(len(self.breakpoints)):
            breakpoints = self.breakpoints[c]
            slopes = self.slopes[c]
            offsets = offsets_for_continuity(breakpoints, slopes)
            channel_values = v[..., c]
            piece = np.searchsorted(breakpoints, channel_values, side="right")
            linear_part = slopes[piece] * v[..., c]
            out[..., c] = linear_part + offsets[piece]
        return out

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Square:
        slopes_at = []
        for breakpoints, slopes, value in zip(self.breakpoints, self.slopes, v, strict=True):
            piece = np.searchsorted(breakpoints, value, side="right")
            slopes_at.append(slopes[piece])
        return np.diag(slopes_at)

    def slope_bound(self) -> SlopeBound:
        all_slopes = self.slopes.ravel()
        values = [Fraction(float(slope)) for slope in all_slopes]
        lowest = min(values)
        highest = max(values)
        return bound_from_interval(lowest, highest, "construction")

    def jacobian_centre(self) -> Square:
        largest_slopes = self.slopes.max(axis=1)
        smallest_slopes = self.slopes.min(axis=1)
        return np.diag((largest_slopes + smallest_slopes) / 2)

    def compose_with_output_matrix(self, m: Square) -> "MonotoneScaffold":
        diagonal = np.diagonal(m)[:, None]
        slopes = diagonal * self.slopes
        return replace(self, slopes=slopes)

    def compose_with_input_matrix(self, m: Square) -> "MonotoneScaffold":
        diagonal_gains = np.diagonal(m)
        gains = diagonal_gains[:, None]
        breakpoints = self.breakpoints / gains
        slopes = gains * self.slopes
        turned = gains < 0  # a negative gain runs through the pieces from the other end
        reversed_breakpoints = breakpoints[:, ::-1]
        breakpoints = np.where(turned, reversed_breakpoints, breakpoints)
        reversed_slopes = slopes[:, ::-1]
        slopes = np.where(turned, reversed_slopes, slopes)
        return MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)

    def as_portable(self) -> PortableMap:
        """Network with one neuron per break point that computes the same map. `S_c(v) = s_0 v +
        sum_j (s_{j+1} - s_j) (relu(v - t_j) - relu(-t_j))`."""
        channels, breaks = self.breakpoints.shape
        first_slopes = self.slopes[:, 0]
        linear = np.diag(first_slopes)
        if not breaks:
            return PortableMap(linear=linear, network=None)
        channel_rows = np.eye(channels)
        neurons = np.repeat(channel_rows, breaks, axis=0)
        slope_changes = np.diff(self.slopes, axis=1)
        bends = slope_changes.ravel()
        count = channels * breaks
        outward = neurons.T * bends
        flat_breakpoints = self.breakpoints.ravel()
        zeros = np.zeros(count)
        ones = np.ones(count)
        network = Network(
            weights=(neurons, outward),
            biases=(-flat_breakpoints,),
            negative_slopes=(zeros,),
            positive_slopes=(ones,),
        )
        return PortableMap(linear=linear, network=network)


def offsets_for_continuity(
    breakpoints: Float[np.ndarray, "h"], slopes: Float[np.ndarray, "h1"]
) -> Float[np.ndarray, "h1"]:
    """Offsets with which the affine pieces of a piecewise-linear map join continuously. The piece
    `slope v + offset` that contains v = 0 has offset zero."""
    pieces_below_zero = np.searchsorted(breakpoints, 0.0, side="right")
    home = int(pieces_below_zero)
    slopes_before = slopes[:-1]
    slopes_after = slopes[1:]
    jumps = (slopes_before - slopes_after) * breakpoints
    jumps_below = jumps[:home][::-1]
    left = -np.cumsum(jumps_below)[::-1]
    right = np.cumsum(jumps[home:])
    return np.concatenate([left, [0.0], right])


@dataclass(frozen=True, kw_only=True)
class Monotone(Trainable):
    """Trainable static map that is piecewise linear and monotone in each channel. Slopes `lower +
    (upper - lower) sigmoid(free)` between sorted break points, `hidden_width` of them per channel.

    The Jacobian is diagonal, so the sector is the ball. The break points move with training: when
    two cross, the piece between them has zero width and the map stays continuous in its parameters.
    """

    def initial_values(
        self,
        frame: MapContext,
        rng: np.random.Generator,  # noqa: ARG002
    ) -> dict[str, Float[np.ndarray, "..."]]:
        rank_numbers = np.arange(frame.width)
        ranks = (rank_numbers + 0.5) / frame.width
        quantiles = np.quantile(frame.samples, ranks, axis=0)
        points = quantiles.T
        break_count = len(points)
        slope_count = frame.width + 1
        free = np.zeros((break_count, slope_count))
        return {"points": points, "free": free}

    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> Pieces:
        lower, upper = slopes
        sorted_points = free["points"].sort(dim=-1)
        points = sorted_points.values
        share = torch.sigmoid(free["free"])
        above_lower = (upper - lower) * share
        inside = lower + above_lower
        offsets = scaffold.zero_preserving_offsets(points, inside)
        return points, inside, offsets

    def evaluate(self, explicit: Pieces, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        return scaffold.evaluate_piecewise_linear_map(explicit, v)

    def affine_pieces(self, explicit: Pieces) -> Pieces | None:
        points, inside, offsets = explicit
        if len(points) > 1:
            return None
        return points[0], inside[0], offsets[0]

    def roughness(self, explicit: Pieces) -> Float[Tensor, ""]:
        roughness = scaffold.relative_roughness(explicit[1])
        return roughness.sum(-1)

    def to_numpy(self, explicit: Pieces, slopes: tuple[float, float]) -> MonotoneScaffold:  # noqa: ARG002
        points, inside, _ = explicit
        breakpoints = tensor_to_numpy(points)
        slope_values = tensor_to_numpy(inside)
        return MonotoneScaffold(breakpoints=breakpoints, slopes=slope_values)
