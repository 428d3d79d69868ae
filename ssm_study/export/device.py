"""Model of the controller on a device, with rounded numbers, limited inputs and operations in the
order of the C code.

For a set point r the law aims at the equilibrium of the model nearest to it:
`v* = S_u^{-1}(G^+ S_y^{-1}(w_r))`, clamped to the limits, `x* = (I - A)^{-1} B S_u(v*)`,
`G = C (I - A)^{-1} B + D`, and applies `u = clamp(u_eq + s_u (v* + K (x - x*)))`; with neurons
equilibria are read from a curve (`rest_points`). The observer uses the input that was applied, so a
limit does not disturb the estimate, and no error enters an internal model while it acts: nothing
winds up. `Device` is also its own oracle: `replay` runs the law in NumPy, one rounding for one
rounding of the C code compiled with `-ffp-contract=off`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Inverse, PortableMap, inverse_of
from ssm_study.export.portable import PortableController, Vector, as_floats, times
from ssm_study.export.rest_points import Curve, Joined, equilibrium_curve, reached
from ssm_study.refusal import require_one_of
from ssm_study.systems import StateSpace

REALS: dict[str, Any] = {"double": np.float64, "float": np.float32}
WIDEST = 5.0  # scaled inputs: as far as a curve of equilibria goes where there is no limit
IDLE = 1e-9  # relative: a direction of inputs below it moves no output at rest


@dataclass(frozen=True, kw_only=True)
class SetPoints:
    """Maps between set points and equilibria of the model.

    `to_lifted (k, q)` is `G^+`, `at_rest (n, k)` is `(I - A)^{-1} B` over zeros, `seen (q, k)`
    is G. With neurons each is a line through stored points, which misses what S_y reads by at most
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
        """Maps `to_lifted`, `at_rest` and `seen` by name."""
        names = ("to_lifted", "at_rest", "seen")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class Device:
    """Controller with its numbers rounded to `real`, and with physical input limits `lower, upper
    (m,)`.

    Limits are infinite where there is none. `set_points` is None where they cannot be computed on
    a device: S_u or S_y couples its channels, the model integrates, no constant input reaches every
    output, or neurons stand between several inputs or outputs. Raises `BadRequest` for another
    `real`.
    """

    controller: PortableController
    real: str
    lower: Vector
    upper: Vector

    @classmethod
    def of(
        cls, controller: PortableController, real: str, lower: Vector, upper: Vector
    ) -> "Device":
        """Device whose numbers are rounded once, to the nearest `real`.

        Missing limits become the largest `real`.
        """
        require_one_of(REALS, "real", real)
        kind = REALS[real]
        largest = float(np.finfo(kind).max)

        def rounded(limit: Vector) -> Vector:
            """Input limit rounded to `real`."""
            inputs = controller.scale.inputs
            each = np.broadcast_to(limit, inputs)
            return np.clip(each, -largest, largest).astype(kind)

        return cls(
            controller=as_floats(controller, kind),
            real=real,
            lower=rounded(lower),
            upper=rounded(upper),
        )

    @cached_property
    def set_points(self) -> SetPoints | None:
        """Maps to equilibria, computed in float64 from the rounded numbers and rounded once more.

        None where a device cannot compute them.
        """
        controller = as_floats(self.controller, np.float64)
        inward = inverse_of(controller.s_in)
        outward = inverse_of(controller.s_out)
        if inward is None or outward is None:
            return None
        model = controller.recurrence()
        if isinstance(model, StateSpace):
            return self._by_matrices(model, inward, outward)
        return self._along_curve(controller, inward, outward)

    def _by_matrices(
        self, model: StateSpace, inward: Inverse, outward: Inverse
    ) -> SetPoints | None:
        """Maps to equilibria of a linear model, as matrices. None where it integrates or cannot
        hold every output."""
        states, _, gain = model.steady_states()
        if model.integrates:
            return None
        tol = IDLE * np.linalg.norm(gain)
        reached_outputs = np.linalg.matrix_rank(gain, tol=tol)
        if reached_outputs < len(gain):
            return None
        controller_a = self.controller.a
        below = len(controller_a) - model.order
        to_lifted = np.linalg.pinv(gain)
        at_rest = np.pad(states, ((0, below), (0, 0)))
        exact = SetPoints(
            to_lifted=to_lifted, at_rest=at_rest, seen=gain, inward=inward, outward=outward
        )
        return as_floats(exact, REALS[self.real])

    def _along_curve(
        self, controller: PortableController, inward: Inverse, outward: Inverse
    ) -> SetPoints | None:
        """Maps to equilibria by interpolation between every other point of the curve. The points
        between show the error."""
        if len(self.lower) > 1:
            return None
        low = self._lifted_limit(controller, self.lower)
        high = self._lifted_limit(controller, self.upper)
        full = equilibrium_curve(controller, low, high)
        if full is None:
            return None
        lifted = full.lifted[::2]
        curve_read = full.read[::2]
        stored = Curve(lifted=lifted, x=full.x[::2], read=curve_read)
        below = len(controller.a) - stored.x.shape[1]
        states = np.pad(stored.x, ((0, 0), (0, below)))
        seen = Joined.through(stored.lifted, stored.read[:, None])
        errors = []
        for v, read in zip(full.lifted, full.read, strict=True):
            on_line = float(seen(v[None])[0])
            errors.append(abs(on_line - read))
        to_lifted = Joined.through(stored.read, stored.lifted[:, None])
        at_rest = Joined.through(stored.lifted, states)
        joined = SetPoints(
            to_lifted=to_lifted,
            at_rest=at_rest,
            seen=seen,
            inward=inward,
            outward=outward,
            missed=max(errors),
        )
        return as_floats(joined, REALS[self.real])

    @staticmethod
    def _lifted_limit(controller: PortableController, limit: Vector) -> float:
        """Value of the input map S_u at an input limit, which is first clipped to `WIDEST` scaled
        inputs."""
        u = limit.astype(float)
        scaled = controller.scale.scaled_input(u)
        return float(_evaluate_map(controller.s_in, np.clip(scaled, -WIDEST, WIDEST))[0])

    def tables(self) -> dict[str, Float[np.ndarray, "..."]]:
        """Constants of the C code by name, in its order, except those of its maps."""
        return self.controller.arrays() | {"lower": self.lower, "upper": self.upper}

    @property
    def multiplications(self) -> int:
        """Largest number of multiplications of floats in one `track`. Those of the activation
        function do not count.

        In one `step` where there are no set points.
        """
        controller = self.controller
        points = self.set_points
        inputs = len(controller.k)
        maps = _map_products(controller.s_in) + _map_products(controller.s_out)
        tables = self.tables().values()
        matrices = sum(table.size for table in tables if table.ndim == 2)
        products = maps + matrices
        neurons = controller.neurons
        # Computed twice: for the output, then with its error.
        if neurons and neurons.h.any():
            products += neurons.f.size + neurons.g.size + neurons.l_z.size
        if points is None:  # the input is computed twice, and compared
            return products + controller.k.size + 3 * inputs
        inverses = _inverse_products(points.inward) + _inverse_products(points.outward)
        parts = points.maps.values()
        reaching = sum(_reaching_products(part) for part in parts)
        return products + reaching + inverses + maps + 2 * inputs

    def start(self, y0: Vector) -> Vector:
        """Equilibrium state of the model at output `y0`. It is the equilibrium of the plant where
        there are no set points."""
        points = self.set_points
        if points is None:
            controller_a = self.controller.a
            return np.zeros(len(controller_a), dtype=REALS[self.real])
        scale = self.controller.scale
        read = _undone(points.outward, scale.scaled_output(y0))
        return reached(points.at_rest, reached(points.to_lifted, read))

    def track(
        self, x: Vector, y: Vector, r: Vector, d: Vector | None = None
    ) -> tuple[Vector, Vector]:
        """Compute the input for this sample, limited, and the next state.

        Without set points the law steers towards the equilibrium. Measured disturbances that are
        not given are at theirs.
        """
        controller = self.controller
        neurons = controller.neurons
        rest = self.nearest_equilibrium(r)
        requested = controller.scale.physical_input(times(controller.k, x - rest["x"], rest["v"]))
        u = np.clip(requested, self.lower, self.upper)
        # The observer uses the input that was applied.
        lifted = _evaluate_map(controller.s_in, controller.scale.scaled_input(u))
        measured = controller.scale.scaled_output(y)
        read = times(controller.d, lifted, times(controller.c, x))
        if neurons and neurons.h.any():
            read = times(neurons.h, neurons(x, lifted), read)
        error = _evaluate_map(controller.s_out, read) - measured
        following = times(controller.b, lifted, times(controller.a, x))
        following = times(controller.l, error, following)
        if d is not None:
            following = times(controller.b_d, controller.scale.scaled_disturbance(d), following)
        if neurons:
            following = times(neurons.into, neurons(x, lifted, error), following)
        # No error enters the internal model while a limit acts.
        if np.array_equal(u, requested):
            following = times(controller.e, measured - rest["w"], following)
        else:
            following[controller.held_states] = x[controller.held_states]
        return u, following

    def nearest_equilibrium(self, r: Vector) -> dict[str, Vector]:
        """Equilibrium nearest to the set point `r` within the limits.

        State `x`, scaled input `v` and output `w`.
        """
        controller = self.controller
        scale = controller.scale
        points = self.set_points
        real = REALS[self.real]
        if points is None:
            return {
                "x": np.zeros(len(controller.a), real),
                "v": np.zeros(len(controller.k), real),
                "w": np.zeros(controller.l.shape[1], real),
            }
        wanted = reached(points.to_lifted, _undone(points.outward, scale.scaled_output(r)))
        requested = scale.physical_input(_undone(points.inward, wanted))
        u = np.clip(requested, self.lower, self.upper)
        v = scale.scaled_input(u)
        lifted = _evaluate_map(controller.s_in, v)
        return {
            "x": reached(points.at_rest, lifted),
            "v": v,
            "w": _evaluate_map(controller.s_out, reached(points.seen, lifted)),
        }

    def replay(
        self,
        y: Float[np.ndarray, "T p"],
        r: Float[np.ndarray, "T p"],
        d: Float[np.ndarray, "T k"] | None = None,
    ) -> Float[np.ndarray, "T m"]:
        """Inputs that the device applies to recorded measurements and set points. It takes measured
        disturbances, too, where it uses some.

        It starts at rest at the first measurement.
        """
        kind = REALS[self.real]
        measurements = y.astype(kind)
        set_points = r.astype(kind)
        x = self.start(measurements[0])
        applied = []
        for k in range(len(measurements)):
            load = None if d is None else d[k].astype(kind)
            u, x = self.track(x, measurements[k], set_points[k], load)
            applied.append(u)
        return np.stack(applied)


def _map_products(portable: PortableMap) -> int:
    """Number of products in one evaluation of S; a slope for each bias."""
    network = portable.network
    layers = () if network is None else (*network.weights, *network.biases)
    return portable.linear.size + sum(part.size for part in layers)


def _inverse_products(inverse: Inverse) -> int:
    """Number of products in one evaluation of the inverse map."""
    return len(inverse.channels) if inverse.matrix is None else inverse.matrix.size


def _reaching_products(part: Any) -> int:
    """Number of products in one evaluation of a map to equilibria."""
    return part.slopes.shape[1] if isinstance(part, Joined) else part.size


def _evaluate_map(portable: PortableMap, v: Vector) -> Vector:
    """Value of a map at `v`, computed in the order of the C code."""
    out = times(portable.linear, v)
    if portable.network is None:
        return out
    d = v
    for w, b, low, high in portable.network.hidden():
        z = times(w, d, b)
        at_zero = np.where(b >= 0, high, low) * b
        d = np.where(z >= 0, high * z, low * z) - at_zero
    weights = portable.network.weights
    return times(weights[-1], d, out)


def _undone(inverse: Inverse, w: Vector) -> Vector:
    """Value of the inverse map `S^{-1}(w)`, computed in the order of the C code.

    Channel by channel the order is that already; for a product `@` promises none.
    """
    return inverse(w) if inverse.matrix is None else times(inverse.matrix, w)
