"""A scaffolding written by its slopes: piecewise linear in each channel, so the slope interval can
be read off."""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, bound_from_interval
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds import scaffold
from ssm_study.models.scaffolds.scaffold import (
    Frame,
    Free,
    Pieces,
    Scaffold,
    Square,
    Trainable,
    numbers,
)
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class MonotoneScaffold(Scaffold, names=("monotone",)):
    """`S_c(v) = int_0^v s_c(t) dt` in each channel c, `s_c = slopes[c, j]` between `breakpoints[c,
    j-1]` and `[c, j]`.

    Shapes: `breakpoints (m, h)` not decreasing along h, `slopes (m, h + 1)`. The exact slope
    interval is the smallest and the largest of `slopes`; the Jacobian is diagonal, so the interval
    is also the ball. Source: docs/theory.md ("construction"); any piecewise-linear monotone map
    with h break points has this form.
    """

    breakpoints: Float[np.ndarray, "m h"]
    slopes: Float[np.ndarray, "m h1"]

    def __post_init__(self) -> None:
        shapes = (self.breakpoints.shape, self.slopes.shape)
        fits = self.slopes.shape == (self.breakpoints.shape[0], self.breakpoints.shape[1] + 1)
        require(
            fits,
            "breakpoints, slopes",
            shapes,
            "need one slope more than break points",
            "write model.json again",
        )
        ordered = bool((np.diff(self.breakpoints, axis=1) >= 0).all())
        require(
            ordered, "breakpoints", shapes[0], "the break points must not decrease", "sort them"
        )

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        out = np.empty_like(v)
        for c, (t, s) in enumerate(zip(self.breakpoints, self.slopes, strict=True)):
            # pieces s_j v + o_j: o_j is zero for the piece that holds v = 0, and continuous from
            # there
            home = int(np.searchsorted(t, 0.0, side="right"))
            jumps = (s[:-1] - s[1:]) * t
            left = -np.cumsum(jumps[:home][::-1])[::-1]
            right = np.cumsum(jumps[home:])
            piece = np.searchsorted(t, v[..., c], side="right")
            out[..., c] = s[piece] * v[..., c] + np.concatenate([left, [0.0], right])[piece]
        return out

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Square:
        channels = zip(self.breakpoints, self.slopes, v, strict=True)
        return np.diag([s[np.searchsorted(t, x, side="right")] for t, s, x in channels])

    def bound(self) -> SlopeBound:
        values = [Fraction(float(s)) for s in self.slopes.ravel()]
        return bound_from_interval(min(values), max(values), "construction")

    def centre(self) -> Square:
        return np.diag((self.slopes.max(axis=1) + self.slopes.min(axis=1)) / 2)

    def after(self, m: Square) -> "MonotoneScaffold":
        return replace(self, slopes=np.diagonal(m)[:, None] * self.slopes)

    def before(self, m: Square) -> "MonotoneScaffold":
        gains = np.diagonal(m)[:, None]
        breakpoints = self.breakpoints / gains
        slopes = gains * self.slopes
        turned = gains < 0  # a negative gain runs through the pieces from the other end
        return MonotoneScaffold(
            breakpoints=np.where(turned, breakpoints[:, ::-1], breakpoints),
            slopes=np.where(turned, slopes[:, ::-1], slopes),
        )

    def portable(self) -> PortableMap:
        """`S_c(v) = s_0 v + sum_j (s_{j+1} - s_j) (relu(v - t_j) - relu(-t_j))`: one neuron per
        break point."""
        channels, breaks = self.breakpoints.shape
        if not breaks:
            return PortableMap(linear=np.diag(self.slopes[:, 0]), network=None)
        neurons = np.repeat(np.eye(channels), breaks, axis=0)
        network = Network(
            weights=(neurons, neurons.T * np.diff(self.slopes, axis=1).ravel()),
            biases=(-self.breakpoints.ravel(),),
            negative_slopes=(np.zeros(channels * breaks),),
            positive_slopes=(np.ones(channels * breaks),),
        )
        return PortableMap(linear=np.diag(self.slopes[:, 0]), network=network)


@dataclass(frozen=True, kw_only=True)
class Monotone(Trainable):
    """Slopes `lower + (upper - lower) sigmoid(free)` between sorted break points, `hidden_width` of
    them per channel.

    The Jacobian is diagonal, so the sector is the ball. The break points move with training: when
    two cross, the piece between them has zero width and the map stays continuous in its parameters.
    """

    def start(self, frame: Frame, rng: np.random.Generator) -> dict[str, Float[np.ndarray, "..."]]:  # noqa: ARG002
        ranks = (np.arange(frame.width) + 0.5) / frame.width
        points = np.quantile(frame.samples, ranks, axis=0).T
        return {"points": points, "free": np.zeros((len(points), frame.width + 1))}

    def explicit(self, free: Free, slopes: tuple[float, float]) -> Pieces:
        points, (lower, upper) = free["points"].sort(dim=-1).values, slopes
        inside = lower + (upper - lower) * torch.sigmoid(free["free"])
        return points, inside, scaffold.home_offsets(points, inside)

    def evaluate(self, explicit: Pieces, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        return scaffold.evaluate(explicit, v)

    def pieces(self, explicit: Pieces) -> Pieces | None:
        return None if len(explicit[0]) > 1 else (explicit[0][0], explicit[1][0], explicit[2][0])

    def roughness(self, explicit: Pieces) -> Float[Tensor, ""]:
        return scaffold.roughness(explicit[1]).sum(-1)

    def frozen(self, explicit: Pieces, slopes: tuple[float, float]) -> MonotoneScaffold:  # noqa: ARG002
        return MonotoneScaffold(breakpoints=numbers(explicit[0]), slopes=numbers(explicit[1]))
