"""Where the controller's model rests, as the device finds it: by matrices, and with neurons between
stored points.

With neurons `x = A x + B v + E w(x, v)` has no closed form. It has one solution for each v, since
the model contracts;
of one input and one output they are a curve, of which the device holds some points, joined by
straight lines.
"""

from dataclasses import dataclass

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ssm_study.export.portable import PortableController, PortableNeurons, Vector, times
from ssm_study.models.structured import phi
from ssm_study.systems import StructuredSystem

# On each side of rest: where the input's range is ten times that of a bend, a thousandth is missed.
PIECES = 32
FOUND = 1e-9  # scaled states: what is left of x+ - x
Rows = Float[np.ndarray, "h r"]


@dataclass(frozen=True, kw_only=True)
class Joined:
    """`out = slopes[j] w + offsets[j]`, j the count of `points <= w`; beyond the ends the last line
    goes on."""

    points: Vector
    slopes: Rows
    offsets: Rows

    @classmethod
    def through(cls, w: Vector, out: Rows) -> "Joined":
        """The points `w`, in any order, with `out` a row each."""
        order = np.argsort(w)
        w, out = w[order], out[order]
        rising = np.diff(out, axis=0) / np.diff(w)[:, None]
        return cls(points=w[1:-1].copy(), slopes=rising, offsets=out[:-1] - rising * w[:-1, None])

    def __call__(self, w: Vector) -> Vector:
        j = int((self.points <= w[0]).sum())
        return self.slopes[j] * w[0] + self.offsets[j]


def reached(by: "Joined | Float[np.ndarray, 'r c']", w: Vector) -> Vector:
    """A product, in the order of the C code, or between stored points."""
    return by(w) if isinstance(by, Joined) else times(by, w)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Rest points for `lifted (h,)`, rising: states `x (h, n)` and what S_y reads, `read (h,)`,
    rising or falling."""

    lifted: Vector
    x: Rows
    read: Vector


def curve(controller: PortableController, low: float, high: float) -> Curve | None:
    """Those from `low` to `high`, and half way between; None where two of them share an output, or
    none is found."""
    model, inner = controller.recurrence(), controller.neurons
    if (
        not isinstance(model, StructuredSystem)
        or inner is None
        or (len(model.d), len(model.d.T)) != (1, 1)
    ):
        return None
    # Each begins at rest.
    sides = [np.linspace(0.0, end, 2 * PIECES + 1) for end in (low, high) if end != 0.0]
    found: dict[float, Vector] = {}
    for side in sides:
        near = np.zeros(model.order)
        for v in side:
            x = _rest(model, inner, v, near)
            if x is None:
                return None
            found[float(v)] = near = x
    lifted = np.array(sorted(found))
    x = np.array([found[v] for v in lifted])
    w = phi(inner.kinds, x @ model.f.T + lifted[:, None] * model.g.T + inner.bias) - inner.phi_bias
    read = x @ model.c[0] + lifted * model.d[0, 0] + w @ model.h[0]
    apart = np.diff(read)
    return Curve(lifted=lifted, x=x, read=read) if (apart > 0).all() or (apart < 0).all() else None


def _rest(model: StructuredSystem, inner: PortableNeurons, v: float, near: Vector) -> Vector | None:
    """The state that one lifted input holds, searched from a neighbour's."""

    def missing(x: Vector) -> tuple[Vector, Float[np.ndarray, "n n"]]:
        z = model.f @ x + model.g[:, 0] * v + inner.bias
        w, at = phi(inner.kinds, z) - inner.phi_bias, model.at_slopes(phi(inner.kinds, z, "slope"))
        return model.a @ x + model.b[:, 0] * v + model.e @ w - x, at.a - np.eye(len(x))

    solved = scipy.optimize.root(missing, near, jac=True, tol=1e-12)
    # at a kink it ends without success, and exactly there
    return solved.x if np.abs(solved.fun).max(initial=0.0) <= FOUND else None
