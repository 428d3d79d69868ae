"""The controller as the device computes it: rounded to its floats, within its limits, in the order
of its C code.

For a set point r the law aims at the rest point of the model nearest to it: `v* = S_u^{-1}(G^+
S_y^{-1}(w_r))`, clamped
to the limits, `x* = (I - A)^{-1} B S_u(v*)`, `G = C (I - A)^{-1} B + D`, and applies
`u = clamp(u_eq + s_u (v* + K (x - x*)))`; with neurons rest points are read from a curve
(`rest_points`). The observer
is told the input that was applied, so a limit does not disturb the estimate, and no error enters an
internal model
while it acts: nothing winds up. `Device` is also its own oracle: `replay` runs the law in NumPy,
one rounding for one
rounding of the C code compiled with `-ffp-contract=off`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Inverse, PortableMap, inverse_of
from ssm_study.export.portable import PortableController, Vector, as_floats, times
from ssm_study.export.rest_points import Curve, Joined, curve, reached
from ssm_study.refusal import one_of
from ssm_study.systems import StateSpace

REALS: dict[str, Any] = {"double": np.float64, "float": np.float32}
WIDEST = 5.0  # scaled inputs: as far as a curve of rest points goes where there is no limit
IDLE = 1e-9  # relative: a direction of inputs below it moves no output at rest


@dataclass(frozen=True, kw_only=True)
class SetPoints:
    """`to_lifted (k, q)` is `G^+`, `at_rest (n, k)` is `(I - A)^{-1} B` over zeros, `seen (q, k)`
    is G.

    With neurons each is a line through stored points, which misses what S_y reads by at most
    `missed`.
    """

    to_lifted: Float[np.ndarray, "k q"] | Joined  # the least input where inputs outnumber outputs
    at_rest: Float[np.ndarray, "n k"] | Joined
    seen: Float[np.ndarray, "q k"] | Joined
    inward: Inverse
    outward: Inverse
    missed: float = 0.0

    @property
    def maps(self) -> dict[str, Any]:
        """The first three by name."""
        return {name: getattr(self, name) for name in ("to_lifted", "at_rest", "seen")}


@dataclass(frozen=True, kw_only=True)
class Device:
    """A controller rounded to `real`, with input limits `lower, upper (m,)`, physical; infinite
    where there is none.

    `set_points` is None where they cannot be computed on a device: S_u or S_y couples its channels,
    the model
    integrates, no constant input reaches every output, or neurons stand between several inputs or
    outputs. Raises
    `BadRequest` for another `real`.
    """

    controller: PortableController
    real: str
    lower: Vector
    upper: Vector

    @classmethod
    def of(
        cls, controller: PortableController, real: str, lower: Vector, upper: Vector
    ) -> "Device":
        """Every number rounded once, to the nearest `real`; missing limits become the largest
        `real`."""
        one_of(REALS, "real", real)
        kind, most = REALS[real], float(np.finfo(REALS[real]).max)
        limits = (np.broadcast_to(limit, controller.scale.inputs) for limit in (lower, upper))
        low, high = (np.clip(limit, -most, most).astype(kind) for limit in limits)
        return cls(controller=as_floats(controller, kind), real=real, lower=low, upper=high)

    @cached_property
    def set_points(self) -> SetPoints | None:
        """From the rounded numbers, computed in float64 and rounded once more."""
        c = as_floats(self.controller, np.float64)
        model, inward, outward = c.recurrence(), inverse_of(c.s_in), inverse_of(c.s_out)
        if inward is None or outward is None:
            return None
        if not isinstance(model, StateSpace):
            return self._along_curve(c, inward, outward)
        rest, _, gain = model.held()
        if model.integrates or np.linalg.matrix_rank(gain, tol=IDLE * np.linalg.norm(gain)) < len(
            gain
        ):
            return None
        at_rest = np.pad(rest, ((0, len(c.a) - model.order), (0, 0)))
        exact = SetPoints(
            to_lifted=np.linalg.pinv(gain),
            at_rest=at_rest,
            seen=gain,
            inward=inward,
            outward=outward,
        )
        return as_floats(exact, REALS[self.real])

    def _along_curve(
        self, c: PortableController, inward: Inverse, outward: Inverse
    ) -> SetPoints | None:
        """Every other point is stored; those between tell what is missed."""
        if len(self.lower) > 1:
            return None
        ends = [c.scale.scaled_input(end.astype(float)) for end in (self.lower, self.upper)]
        low, high = (float(_mapped(c.s_in, np.clip(end, -WIDEST, WIDEST))[0]) for end in ends)
        full = curve(c, low, high)
        if full is None:
            return None
        kept = Curve(lifted=full.lifted[::2], x=full.x[::2], read=full.read[::2])
        seen = Joined.through(kept.lifted, kept.read[:, None])
        at_rest = Joined.through(
            kept.lifted, np.pad(kept.x, ((0, 0), (0, len(c.a) - kept.x.shape[1])))
        )
        missed = max(
            abs(float(seen(v[None])[0]) - y) for v, y in zip(full.lifted, full.read, strict=True)
        )
        told: Any = {"inward": inward, "outward": outward, "missed": missed}
        to_lifted = Joined.through(kept.read, kept.lifted[:, None])
        return as_floats(
            SetPoints(to_lifted=to_lifted, at_rest=at_rest, seen=seen, **told), REALS[self.real]
        )

    def tables(self) -> dict[str, Float[np.ndarray, "..."]]:
        """Every constant of the C code by name, in its order, but those of its maps."""
        return self.controller.arrays() | {"lower": self.lower, "upper": self.upper}

    @property
    def multiplications(self) -> int:
        """Of two floats in one `track` (in one `step` where there are no set points), at most;
        without those of phi."""
        c, points, m = self.controller, self.set_points, len(self.controller.k)
        layers = (
            (s.linear, *(s.network.weights + s.network.biases if s.network else ()))
            for s in (c.s_in, c.s_out)
        )
        maps = sum(part.size for one in layers for part in one)  # a slope for each bias
        products = maps + sum(table.size for table in self.tables().values() if table.ndim == 2)
        # Computed twice: for the output, then with its error.
        if (inner := c.neurons) and inner.h.any():
            products += inner.f.size + inner.g.size + inner.l_z.size
        if points is None:  # the input is computed twice, and compared
            return products + c.k.size + 3 * m
        undone = sum(
            len(s.channels) if s.matrix is None else s.matrix.size
            for s in (points.inward, points.outward)
        )
        reach = (
            p.slopes.shape[1] if isinstance(p, Joined) else p.size for p in points.maps.values()
        )
        return products + sum(reach) + undone + maps + 2 * m

    def start(self, y0: Vector) -> Vector:
        """The state in which the model rests at `y0`; the equilibrium where there are no set
        points."""
        c, points = self.controller, self.set_points
        if points is None:
            return np.zeros(len(c.a), dtype=REALS[self.real])
        return reached(
            points.at_rest,
            reached(points.to_lifted, _undone(points.outward, c.scale.scaled_output(y0))),
        )

    def track(self, x: Vector, y: Vector, r: Vector) -> tuple[Vector, Vector]:
        """The input for this sample, clamped, and the next state; without set points towards the
        equilibrium."""
        c, rest = self.controller, self.aim(r)
        asked = c.scale.physical_input(times(c.k, x - rest["x"], rest["v"]))
        u = np.clip(asked, self.lower, self.upper)
        lifted = _mapped(c.s_in, c.scale.scaled_input(u))  # the observer is told what was applied
        measured = c.scale.scaled_output(y)
        read = times(c.d, lifted, times(c.c, x))
        if c.neurons and c.neurons.h.any():
            read = times(c.neurons.h, c.neurons(x, lifted), read)
        error = _mapped(c.s_out, read) - measured
        following = times(c.l, error, times(c.b, lifted, times(c.a, x)))
        if c.neurons:
            following = times(c.neurons.into, c.neurons(x, lifted, error), following)
        if np.array_equal(u, asked):  # no error enters the internal model while a limit acts
            following = times(c.e, measured - rest["w"], following)
        else:
            following[c.resting] = x[c.resting]
        return u, following

    def aim(self, r: Vector) -> dict[str, Vector]:
        """The rest point nearest to `r` within the limits: state `x`, scaled input `v` and output
        `w`."""
        c, points, real = self.controller, self.set_points, REALS[self.real]
        if points is None:
            return {
                "x": np.zeros(len(c.a), real),
                "v": np.zeros(len(c.k), real),
                "w": np.zeros(c.l.shape[1], real),
            }
        wanted = reached(points.to_lifted, _undone(points.outward, c.scale.scaled_output(r)))
        u = np.clip(c.scale.physical_input(_undone(points.inward, wanted)), self.lower, self.upper)
        v = c.scale.scaled_input(u)
        lifted = _mapped(c.s_in, v)
        return {
            "x": reached(points.at_rest, lifted),
            "v": v,
            "w": _mapped(c.s_out, reached(points.seen, lifted)),
        }

    def replay(
        self, y: Float[np.ndarray, "T p"], r: Float[np.ndarray, "T p"]
    ) -> Float[np.ndarray, "T m"]:
        """What the device applies to these measurements and set points, started at the first
        measurement."""
        y, r = (values.astype(REALS[self.real]) for values in (y, r))
        x, applied = self.start(y[0]), []
        for seen, wanted in zip(y, r, strict=True):
            u, x = self.track(x, seen, wanted)
            applied.append(u)
        return np.stack(applied)


def _mapped(portable: PortableMap, v: Vector) -> Vector:
    out, d = times(portable.linear, v), v
    if portable.network is None:
        return out
    for w, b, low, high in portable.network.hidden():
        z = times(w, d, b)
        d = np.where(z >= 0, high * z, low * z) - np.where(b >= 0, high, low) * b
    return times(portable.network.weights[-1], d, out)


def _undone(inverse: Inverse, w: Vector) -> Vector:
    """Channel by channel the order is that of the C code already; of a product `@` promises
    none."""
    return inverse(w) if inverse.matrix is None else times(inverse.matrix, w)
