"""Python model of the exported controller, which computes exactly as the exported C code does.

For a set point r the law aims at the equilibrium of the model nearest to it: `v* = S_u^{-1}(G^+
S_y^{-1}(w_r))`, clamped to the limits, `x* = (I - A)^{-1} B S_u(v*)`, `G = C (I - A)^{-1} B + D`,
and applies `u = clamp(u_eq + s_u (v* + K (x - x*)))`; with neurons equilibria are read from a curve
(`equilibrium_curve`). The observer uses the input that was applied, so a limit does not disturb the
estimate, and no error enters an internal model while it acts: nothing winds up. `DeviceController`
is also its own oracle: `recomputed_inputs` runs the law in NumPy, one rounding for one rounding of
the C code compiled with `-ffp-contract=off`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import InverseMap, PortableMap, invert_map
from ssm_study.export.equilibrium_curve import (
    EquilibriumCurve,
    PiecewiseLinear,
    compute_equilibrium_curve,
    evaluate_equilibrium_map,
)
from ssm_study.export.portable import PortableController, Vector, convert_floats, multiply_in_order
from ssm_study.refusal import require_one_of
from ssm_study.systems import StateSpace

REALS: dict[str, Any] = {"double": np.float64, "float": np.float32}
WIDEST = 5.0  # scaled inputs: as far as a curve of equilibria goes where there is no limit
IDLE = 1e-9  # relative: a direction of inputs below it moves no output at rest


@dataclass(frozen=True, kw_only=True)
class SetPoints:
    """Maps from set points to equilibria of the controller's model, and from equilibria to set
    points. `to_lifted (k, q)` is `G^+`, `at_rest (n, k)` is `(I - A)^{-1} B` over zeros, `seen (q,
    k)` is G. With neurons each is a line through stored points, which misses what S_y reads by at
    most `missed`."""

    to_lifted: (
        Float[np.ndarray, "k q"] | PiecewiseLinear
    )  # the least input where inputs outnumber outputs
    at_rest: Float[np.ndarray, "n k"] | PiecewiseLinear
    seen: Float[np.ndarray, "q k"] | PiecewiseLinear
    inward: InverseMap
    outward: InverseMap
    missed: float = 0.0

    @property
    def equilibrium_maps(self) -> dict[str, Any]:
        """Three maps between set points and equilibria of the controller's model, keyed by name."""
        names = ("to_lifted", "at_rest", "seen")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class DeviceController:
    """Controller as it runs on a device: rounded numbers, input limits, and operations in the order
    of the C code.

    Limits are infinite where there is none. `set_point_maps` is None where they cannot be computed
    on a device: S_u or S_y couples its channels, the model integrates, no constant input reaches
    every output, or neurons stand between several inputs or outputs. Raises `BadRequest` for
    another `real`.
    """

    controller: PortableController
    real: str
    lower: Vector
    upper: Vector

    @classmethod
    def from_controller(
        cls, controller: PortableController, c_type: str, lower: Vector, upper: Vector
    ) -> "DeviceController":
        """Round all numbers of a controller to the float type of a device.

        Missing limits become the largest `c_type`.
        """
        require_one_of(REALS, "real", c_type)
        kind = REALS[c_type]
        largest = float(np.finfo(kind).max)

        def round_limit(limit: Vector) -> Vector:
            """Input limit rounded to the number type of the C code."""
            inputs = controller.scale.inputs
            each = np.broadcast_to(limit, inputs)
            finite = np.clip(each, -largest, largest)
            return finite.astype(kind)

        return cls(
            controller=convert_floats(controller, kind),
            real=c_type,
            lower=round_limit(lower),
            upper=round_limit(upper),
        )

    @cached_property
    def set_point_maps(self) -> SetPoints | None:
        """Maps between set points and equilibria of the controller's rounded model; None where a
        device cannot compute them.

        None where a device cannot compute them.
        """
        controller = convert_floats(self.controller, np.float64)
        inward = invert_map(controller.s_in)
        outward = invert_map(controller.s_out)
        if inward is None or outward is None:
            return None
        model = controller.recurrence()
        if isinstance(model, StateSpace):
            return self._linear_set_point_maps(model, inward, outward)
        return self._interpolated_set_point_maps(controller, inward, outward)

    @property
    def no_set_points_reason(self) -> str:
        """Clause that says why the controller cannot compute equilibria for set points; empty if it
        can."""
        if self.set_point_maps is not None:
            return ""
        controller = convert_floats(self.controller, np.float64)
        maps = (controller.s_in, controller.s_out)
        if any(invert_map(part) is None for part in maps):
            return "a map couples channels"
        model = controller.recurrence()
        if isinstance(model, StateSpace):
            integrates = "the model integrates"
            return integrates if model.integrates else "no constant input reaches every output"
        if len(self.lower) > 1 or len(model.c) > 1:
            return "neurons stand between several inputs or outputs"
        return "two equilibria of the model have one output, or one was not found"

    def _linear_set_point_maps(
        self, model: StateSpace, inverse_input_map: InverseMap, inverse_output_map: InverseMap
    ) -> SetPoints | None:
        """Maps between set points and equilibria of a linear model, as matrices; None for a model
        that integrates or cannot reach every output."""
        states, _, gain = model.equilibrium_basis()
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
            to_lifted=to_lifted,
            at_rest=at_rest,
            seen=gain,
            inward=inverse_input_map,
            outward=inverse_output_map,
        )
        kind = REALS[self.real]
        return convert_floats(exact, kind)

    def _interpolated_set_point_maps(
        self,
        controller: PortableController,
        inverse_input_map: InverseMap,
        inverse_output_map: InverseMap,
    ) -> SetPoints | None:
        """Maps between set points and equilibria of a model with neurons, by interpolation between
        tabulated equilibria; None where they are not unique. Points between the interpolated ones
        show the error."""
        if len(self.lower) > 1:
            return None
        low = self._mapped_limit(controller, self.lower)
        high = self._mapped_limit(controller, self.upper)
        full = compute_equilibrium_curve(controller, low, high)
        if full is None:
            return None
        lifted = full.lifted[::2]
        equilibrium_curve_read = full.read[::2]
        stored = EquilibriumCurve(lifted=lifted, x=full.x[::2], read=equilibrium_curve_read)
        below = len(controller.a) - stored.x.shape[1]
        states = np.pad(stored.x, ((0, 0), (0, below)))
        output_map = PiecewiseLinear.from_points(stored.lifted, stored.read[:, None])
        errors = []
        for v, read in zip(full.lifted, full.read, strict=True):
            on_line = float(output_map(v[None])[0])
            errors.append(abs(on_line - read))
        to_lifted = PiecewiseLinear.from_points(stored.read, stored.lifted[:, None])
        at_rest = PiecewiseLinear.from_points(stored.lifted, states)
        joined = SetPoints(
            to_lifted=to_lifted,
            at_rest=at_rest,
            seen=output_map,
            inward=inverse_input_map,
            outward=inverse_output_map,
            missed=max(errors),
        )
        kind = REALS[self.real]
        return convert_floats(joined, kind)

    @staticmethod
    def _mapped_limit(controller: PortableController, limit: Vector) -> float:
        """Value of the controller's static input map at an input limit."""
        u = limit.astype(float)
        scaled = controller.scale.scaled_input(u)
        return float(_evaluate_static_map(controller.s_in, np.clip(scaled, -WIDEST, WIDEST))[0])

    def constant_tables(self) -> dict[str, Float[np.ndarray, "..."]]:
        """Constant matrices and vectors of the exported C code, by name."""
        return self.controller.arrays() | {"lower": self.lower, "upper": self.upper}

    @property
    def multiplication_count(self) -> int:
        """Largest number of multiplications in one sample of the controller, without those of
        activation functions.

        In one `step` where there are no set points.
        """
        controller = self.controller
        points = self.set_point_maps
        inputs = len(controller.k)
        maps = _count_map_multiplications(controller.s_in) + _count_map_multiplications(
            controller.s_out
        )
        tables = self.constant_tables().values()
        matrices = sum(table.size for table in tables if table.ndim == 2)
        products = maps + matrices
        neurons = controller.neurons
        # Computed twice: for the output, then with its error.
        if neurons and neurons.h.any():
            products += neurons.f.size + neurons.g.size + neurons.l_z.size
        if points is None:  # the input is computed twice, and compared
            return products + controller.k.size + 3 * inputs
        inverses = _count_inverse_multiplications(points.inward) + _count_inverse_multiplications(
            points.outward
        )
        parts = points.equilibrium_maps.values()
        reaching = sum(_count_equilibrium_multiplications(part) for part in parts)
        return products + reaching + inverses + maps + 2 * inputs

    def equilibrium_state(self, output: Vector) -> Vector:
        """Equilibrium state of the controller's model at which the output has a given value.
        Without set points it is the plant's equilibrium."""
        points = self.set_point_maps
        if points is None:
            controller_a = self.controller.a
            return np.zeros(len(controller_a), dtype=REALS[self.real])
        scale = self.controller.scale
        read = _evaluate_inverse_map(points.outward, scale.scaled_output(output))
        return evaluate_equilibrium_map(
            points.at_rest, evaluate_equilibrium_map(points.to_lifted, read)
        )

    def compute_step(
        self,
        state: Vector,
        measured_output: Vector,
        set_point: Vector,
        disturbance_or_none: Vector | None = None,
    ) -> tuple[Vector, Vector]:
        """Input of the controller for one sample, clipped to the input limits, and the controller's
        next state.

        Without set points the law steers towards the equilibrium. Measured disturbances that are
        not given are at theirs.
        """
        controller = self.controller
        neurons = controller.neurons
        rest = self.nearest_equilibrium(set_point)
        scaled_request = multiply_in_order(controller.k, state - rest["x"], rest["v"])
        requested = controller.scale.physical_input(scaled_request)
        u = np.clip(requested, self.lower, self.upper)
        # The observer uses the input that was applied.
        applied = controller.scale.scaled_input(u)
        lifted = _evaluate_static_map(controller.s_in, applied)
        measured = controller.scale.scaled_output(measured_output)
        start = multiply_in_order(controller.c, state)
        read = multiply_in_order(controller.d, lifted, start)
        if neurons and neurons.h.any():
            read = multiply_in_order(neurons.h, neurons(state, lifted), read)
        error = _evaluate_static_map(controller.s_out, read) - measured
        following = multiply_in_order(controller.a, state)
        following = multiply_in_order(controller.b, lifted, following)
        following = multiply_in_order(controller.l, error, following)
        if disturbance_or_none is not None:
            disturbance = controller.scale.scaled_disturbance(disturbance_or_none)
            following = multiply_in_order(controller.b_d, disturbance, following)
        if neurons:
            corrected_outputs = neurons(state, lifted, error)
            following = multiply_in_order(neurons.into, corrected_outputs, following)
        # No error enters the internal model while a limit acts.
        if np.array_equal(u, requested):
            control_error = measured - rest["w"]
            following = multiply_in_order(controller.e, control_error, following)
        else:
            frozen = controller.frozen_state_range
            following[frozen] = state[frozen]
        return u, following

    def nearest_equilibrium(self, set_point: Vector) -> dict[str, Vector]:
        """Equilibrium of the controller's model for a set point, with the input clipped to the
        input limits.

        State `x`, scaled input `v` and output `w`.
        """
        controller = self.controller
        scale = controller.scale
        points = self.set_point_maps
        real = REALS[self.real]
        if points is None:
            states, outputs = controller.l.shape
            inputs = len(controller.k)
            return {
                "x": np.zeros(states, real),
                "v": np.zeros(inputs, real),
                "w": np.zeros(outputs, real),
            }
        wanted_output = _evaluate_inverse_map(points.outward, scale.scaled_output(set_point))
        wanted_mapped = evaluate_equilibrium_map(points.to_lifted, wanted_output)
        wanted_input = _evaluate_inverse_map(points.inward, wanted_mapped)
        requested = scale.physical_input(wanted_input)
        u = np.clip(requested, self.lower, self.upper)
        v = scale.scaled_input(u)
        lifted = _evaluate_static_map(controller.s_in, v)
        x = evaluate_equilibrium_map(points.at_rest, lifted)
        mapped_output = evaluate_equilibrium_map(points.seen, lifted)
        w = _evaluate_static_map(controller.s_out, mapped_output)
        return {"x": x, "v": v, "w": w}

    def recomputed_inputs(
        self,
        measured_outputs: Float[np.ndarray, "T p"],
        reference: Float[np.ndarray, "T p"],
        disturbances: Float[np.ndarray, "T k"] | None = None,
    ) -> Float[np.ndarray, "T m"]:
        """Inputs that the controller computes from recorded measurements and set points. Measured
        disturbances are an argument where the controller uses them.

        It starts at rest at the first measurement.
        """
        kind = REALS[self.real]
        measurements = measured_outputs.astype(kind)
        set_points = reference.astype(kind)
        x = self.equilibrium_state(measurements[0])
        applied = []
        for k in range(len(measurements)):
            load = None if disturbances is None else disturbances[k].astype(kind)
            u, x = self.compute_step(x, measurements[k], set_points[k], load)
            applied.append(u)
        return np.stack(applied)


def _count_map_multiplications(static_map: PortableMap) -> int:
    """Number of scalar multiplications in one evaluation of a static map."""
    network = static_map.network
    products = static_map.linear.size
    if network is not None:
        products += sum(layer.size for layer in (*network.weights, *network.biases))
    return products


def _count_inverse_multiplications(inverse_map: InverseMap) -> int:
    """Number of scalar multiplications in one evaluation of the inverse of a static map."""
    if inverse_map.matrix is None:
        return len(inverse_map.channels)
    return inverse_map.matrix.size


def _count_equilibrium_multiplications(equilibrium_map: Any) -> int:
    """Number of scalar multiplications in one evaluation of a map from set points to equilibria."""
    if isinstance(equilibrium_map, PiecewiseLinear):
        return equilibrium_map.slopes.shape[1]
    return equilibrium_map.size


def _evaluate_static_map(static_map: PortableMap, v: Vector) -> Vector:
    """Value of a static map, computed in the same order of operations as in the C code."""
    out = multiply_in_order(static_map.linear, v)
    if static_map.network is None:
        return out
    d = v
    for w, b, low, high in static_map.network.hidden_layers():
        z = multiply_in_order(w, d, b)
        slopes_at_zero = np.where(b >= 0, high, low)
        at_zero = slopes_at_zero * b
        activated = np.where(z >= 0, high * z, low * z)
        d = activated - at_zero
    last_weight = static_map.network.weights[-1]
    return multiply_in_order(last_weight, d, out)


def _evaluate_inverse_map(inverse_map: InverseMap, w: Vector) -> Vector:
    """Value of the inverse of a static map, computed in the same order of operations as in the C
    code.

    Channel by channel the order is that already; for a product `@` promises none.
    """
    if inverse_map.matrix is None:
        return inverse_map(w)
    return multiply_in_order(inverse_map.matrix, w)
