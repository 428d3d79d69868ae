"""Python model of the exported controller, which computes exactly as the exported C code does.

For a set point r the law aims at the equilibrium `v*, x*` of the model nearest to it
(`set_point_maps`), with `v*` clamped to the limits, and applies `u = clamp(u_eq + s_u (v* + K (x -
x*)))`. The observer uses the input that was applied, so a limit does not disturb the estimate, and
no error enters an internal model while it acts: nothing winds up. `DeviceController` is also its
own oracle: `recomputed_inputs` runs the law in NumPy, one rounding for one rounding of the C code
compiled with `-ffp-contract=off`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import InverseMap, PortableMap
from ssm_study.export.equilibrium_curve import PiecewiseLinear, evaluate_equilibrium_map
from ssm_study.export.portable import (
    PortableController,
    Vector,
    convert_floats,
    evaluate_inverse_map,
    evaluate_static_map,
    multiply_in_order,
)
from ssm_study.export.set_point_maps import (
    REALS,
    SetPoints,
    derive_set_points,
    explain_missing_set_points,
)
from ssm_study.refusal import require_one_of


@dataclass(frozen=True, kw_only=True)
class DeviceController:
    """Controller as it runs on a device: rounded numbers, input limits, and operations in the order
    of the C code.

    Limits are infinite where there is none. `set_point_maps` is None where they cannot be computed
    on a device: S_u or S_y couples its channels, some outputs integrate and others do not, no
    constant input reaches every output, or neurons stand between several inputs or outputs. Raises
    `BadRequest` for another `real`.
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
        device cannot compute them."""
        return derive_set_points(self.controller, self.real, self.lower, self.upper)

    @property
    def no_set_points_reason(self) -> str:
        """Clause that says why the controller cannot compute equilibria for set points; empty if it
        can."""
        if self.set_point_maps is not None:
            return ""
        return explain_missing_set_points(self.controller, len(self.lower))

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
        inverted = [part for part in (points.inward, points.outward) if part is not None]
        inverses = sum(_count_inverse_multiplications(part) for part in inverted)
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
        read = evaluate_inverse_map(points.outward, scale.scaled_output(output))
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
        lifted = evaluate_static_map(controller.s_in, applied)
        measured = controller.scale.scaled_output(measured_output)
        start = multiply_in_order(controller.c, state)
        read = multiply_in_order(controller.d, lifted, start)
        if neurons and neurons.h.any():
            read = multiply_in_order(neurons.h, neurons(state, lifted), read)
        error = evaluate_static_map(controller.s_out, read) - measured
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
        wanted_output = evaluate_inverse_map(points.outward, scale.scaled_output(set_point))
        wanted_mapped = evaluate_equilibrium_map(points.to_lifted, wanted_output)
        v = np.zeros(len(controller.k), real)
        lifted = wanted_mapped
        if points.inward is not None:
            wanted_input = evaluate_inverse_map(points.inward, wanted_mapped)
            requested = scale.physical_input(wanted_input)
            u = np.clip(requested, self.lower, self.upper)
            v = scale.scaled_input(u)
            lifted = evaluate_static_map(controller.s_in, v)
        x = evaluate_equilibrium_map(points.at_rest, lifted)
        mapped_output = evaluate_equilibrium_map(points.seen, lifted)
        w = evaluate_static_map(controller.s_out, mapped_output)
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
