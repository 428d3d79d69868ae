"""A scaffolding written by its slopes: piecewise linear in each channel, so the slope interval can be read off."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.scaffold import Scaffold, array_from_json
from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class MonotoneScaffold(Scaffold):
    """`S_c(v) = int_0^v s_c(t) dt` in each channel c, `s_c = slopes[c, j]` between `breakpoints[c, j-1]` and `[c, j]`.

    Shapes: `breakpoints (m, h)` not decreasing along h, `slopes (m, h + 1)`. The exact slope interval is the smallest
    and the largest of `slopes`; the Jacobian is diagonal, so the interval is also the ball.
    Source: THEORY section 3 (i); any piecewise-linear monotone map with h break points has this form.
    """

    kind: ClassVar[str] = "monotone"
    breakpoints: Float[np.ndarray, "m h"]
    slopes: Float[np.ndarray, "m h1"]

    def __post_init__(self) -> None:
        shapes = (self.breakpoints.shape, self.slopes.shape)
        fits = self.slopes.shape == (self.breakpoints.shape[0], self.breakpoints.shape[1] + 1)
        require(fits, "breakpoints, slopes", shapes, "need one slope more than break points", "write model.json again")
        ordered = bool((np.diff(self.breakpoints, axis=1) >= 0).all())
        require(ordered, "breakpoints", shapes[0], "the break points must not decrease", "sort them")

    @property
    def inputs(self) -> int:
        return self.breakpoints.shape[0]

    @property
    def outputs(self) -> int:
        return self.breakpoints.shape[0]

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        out = np.empty_like(v)
        for c in range(self.inputs):
            piece = np.searchsorted(self.breakpoints[c], v[..., c], side="right")
            out[..., c] = self.slopes[c][piece] * v[..., c] + self.offsets(c)[piece]
        return out

    def offsets(self, channel: int) -> Float[np.ndarray, "h1"]:
        """Intercepts `o_j` of the pieces `s_j v + o_j`: zero for the piece that holds v = 0, continuous from there."""
        t, s = self.breakpoints[channel], self.slopes[channel]
        home = int(np.searchsorted(t, 0.0, side="right"))
        jumps = (s[:-1] - s[1:]) * t
        right = np.cumsum(jumps[home:])
        left = -np.cumsum(jumps[:home][::-1])[::-1]
        return np.concatenate([left, [0.0], right])

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m m"]:
        pieces = [int(np.searchsorted(t, x, side="right")) for t, x in zip(self.breakpoints, v, strict=True)]
        return np.diag([s[j] for s, j in zip(self.slopes, pieces, strict=True)])

    def to_json(self) -> dict[str, Any]:
        return {"kind": self.kind, "breakpoints": self.breakpoints.tolist(), "slopes": self.slopes.tolist()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "MonotoneScaffold":
        return cls(breakpoints=array_from_json(data, "breakpoints", 2), slopes=array_from_json(data, "slopes", 2))
