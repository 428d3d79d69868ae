"""Equilibria of a controller's model at which its outputs have given values, as an exported
controller computes them.

Without integrators `x* = (I - A)^{-1} B S_u(v*)`, `v* = S_u^{-1}(G^+ S_y^{-1}(w_r))`, `G = C (I -
A)^{-1} B + D`; with neurons equilibria are read from a curve (`equilibrium_curve`). A model with an
integrator for each output rests at every output with `v* = 0`, and `x*` is what its integrators
hold.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import InverseMap, invert_map
from ssm_study.export.equilibrium_curve import (
    EquilibriumCurve,
    PiecewiseLinear,
    compute_equilibrium_curve,
)
from ssm_study.export.portable import (
    PortableController,
    Vector,
    convert_floats,
    evaluate_static_map,
)
from ssm_study.systems import StateSpace, StructuredSystem

REALS: dict[str, Any] = {"double": np.float64, "float": np.float32}
WIDEST = 5.0  # scaled inputs: as far as a curve of equilibria goes where there is no limit
IDLE = 1e-9  # relative: a direction of inputs below it moves no output at rest
# Smallest singular value of I - A, relative to the largest, below which a direction of states may
# be an integrator's; it is one if no larger input than that below holds a scaled output of one.
INTEGRATES = {"double": 1e-9, "float": 1e-6}
LARGEST_HOLDING_INPUT = 1e-4


@dataclass(frozen=True, kw_only=True)
class SetPoints:
    """Maps from set points to equilibria of the controller's model, and from equilibria to set
    points. `to_lifted (k, q)` is `G^+`, `at_rest (n, k)` is `(I - A)^{-1} B` over zeros, `seen (q,
    k)` is G. With neurons each is piecewise linear through stored points, and misses the argument
    of S_y by at most `missed`.

    A model whose outputs all integrate rests at any of them with its input at equilibrium, so
    `inward` is None: k counts its integrators, `at_rest` has the states that a unit of each holds.
    """

    to_lifted: (
        Float[np.ndarray, "k q"] | PiecewiseLinear
    )  # the least input where inputs outnumber outputs
    at_rest: Float[np.ndarray, "n k"] | PiecewiseLinear
    seen: Float[np.ndarray, "q k"] | PiecewiseLinear
    inward: InverseMap | None
    outward: InverseMap
    missed: float = 0.0

    @property
    def coordinates(self) -> int:
        """Number of coordinates of an equilibrium: lifted inputs, or integrators."""
        if isinstance(self.to_lifted, PiecewiseLinear):
            return 1
        return len(self.to_lifted)

    @property
    def equilibrium_maps(self) -> dict[str, Any]:
        """Three maps between set points and equilibria of the controller's model, keyed by name."""
        names = ("to_lifted", "at_rest", "seen")
        return {name: getattr(self, name) for name in names}


def derive_set_points(
    controller: PortableController, real: str, lower: Vector, upper: Vector
) -> SetPoints | None:
    """Maps between set points and equilibria of a controller's model, rounded to a device's
    numbers; None where a device cannot compute them."""
    controller = convert_floats(controller, np.float64)
    inward = invert_map(controller.s_in)
    outward = invert_map(controller.s_out)
    if inward is None or outward is None:
        return None
    model = controller.recurrence()
    internal_states = len(controller.a) - model.order
    points = _integrating_set_points(model, internal_states, outward, INTEGRATES[real])
    if points is None and isinstance(model, StateSpace):
        points = _linear_set_points(model, internal_states, inward, outward)
    elif points is None and len(lower) == 1:
        low = _mapped_limit(controller, lower)
        high = _mapped_limit(controller, upper)
        curve = compute_equilibrium_curve(controller, low, high)
        if curve is not None:
            points = _interpolated_set_points(curve, len(controller.a), inward, outward)
    return None if points is None else convert_floats(points, REALS[real])


def explain_missing_set_points(controller: PortableController, inputs: int) -> str:
    """Clause that says why a controller cannot convert set points to equilibria."""
    controller = convert_floats(controller, np.float64)
    maps = (controller.s_in, controller.s_out)
    if any(invert_map(part) is None for part in maps):
        return "a map couples channels"
    model = controller.recurrence()
    if isinstance(model, StateSpace):
        integrates = "the model integrates, but not from one integrator to each output"
        return integrates if model.integrates else "no constant input reaches every output"
    if inputs > 1 or len(model.c) > 1:
        return "neurons stand between several inputs or outputs"
    return "two equilibria of the model have one output, or one was not found"


def _integrating_set_points(
    model: StateSpace | StructuredSystem,
    internal_states: int,
    inverse_output_map: InverseMap,
    tolerance: float,
) -> SetPoints | None:
    """Maps between set points and equilibria of a model with one integrator for each output; None
    for any other model.

    States X with `A X = X` that no neuron reads (`F X = 0`) hold the outputs `C X = I` with the
    input at equilibrium.
    """
    from scipy.linalg import null_space  # slow to load

    change_per_sample = np.eye(model.order) - model.a
    to_zero = change_per_sample
    if isinstance(model, StructuredSystem):
        to_zero = np.vstack([change_per_sample, model.f])
    directions = null_space(to_zero, rcond=tolerance)
    gain = model.c @ directions
    outputs, integrators = gain.shape
    if integrators != outputs:
        return None
    tol = IDLE * np.linalg.norm(model.c)
    visible_integrators = np.linalg.matrix_rank(gain, tol=tol)
    if visible_integrators < outputs:
        return None
    inverse_gain = np.linalg.inv(gain)
    states = directions @ inverse_gain
    holding_input = np.linalg.lstsq(model.b, change_per_sample @ states, rcond=None)[0]
    largest_input = np.abs(holding_input).max()
    if largest_input > LARGEST_HOLDING_INPUT:  # slow modes
        return None
    at_rest = _pad_internal_states(states, internal_states)
    unit = np.eye(outputs)
    return SetPoints(
        to_lifted=unit, at_rest=at_rest, seen=unit, inward=None, outward=inverse_output_map
    )


def _pad_internal_states(
    states: Float[np.ndarray, "n k"], internal_states: int
) -> Float[np.ndarray, "N k"]:
    """States of a model at rest, with zeros below for a controller's internal model."""
    below = (0, internal_states)
    return np.pad(states, (below, (0, 0)))


def _linear_set_points(
    model: StateSpace,
    internal_states: int,
    inverse_input_map: InverseMap,
    inverse_output_map: InverseMap,
) -> SetPoints | None:
    """Maps between set points and equilibria of a linear model, as matrices; None for a model that
    integrates or cannot reach every output."""
    states, _, gain = model.equilibrium_basis()
    if model.integrates:
        return None
    tol = IDLE * np.linalg.norm(gain)
    reached_outputs = np.linalg.matrix_rank(gain, tol=tol)
    if reached_outputs < len(gain):
        return None
    to_lifted = np.linalg.pinv(gain)
    at_rest = _pad_internal_states(states, internal_states)
    return SetPoints(
        to_lifted=to_lifted,
        at_rest=at_rest,
        seen=gain,
        inward=inverse_input_map,
        outward=inverse_output_map,
    )


def _interpolated_set_points(
    full: EquilibriumCurve,
    states_of_controller: int,
    inverse_input_map: InverseMap,
    inverse_output_map: InverseMap,
) -> SetPoints:
    """Maps between set points and equilibria of a model with neurons, by interpolation between
    every second of the tabulated equilibria. The points between show the error of the
    interpolation."""
    lifted = full.lifted[::2]
    read = full.read[::2]
    x = full.x[::2]
    below = states_of_controller - x.shape[1]
    states = np.pad(x, ((0, 0), (0, below)))
    output_map = PiecewiseLinear.from_points(lifted, read[:, None])
    errors = []
    for v, exact in zip(full.lifted, full.read, strict=True):
        on_line = output_map(v[None])
        error = float(on_line[0]) - exact
        errors.append(abs(error))
    to_lifted = PiecewiseLinear.from_points(read, lifted[:, None])
    at_rest = PiecewiseLinear.from_points(lifted, states)
    return SetPoints(
        to_lifted=to_lifted,
        at_rest=at_rest,
        seen=output_map,
        inward=inverse_input_map,
        outward=inverse_output_map,
        missed=max(errors),
    )


def _mapped_limit(controller: PortableController, limit: Vector) -> float:
    """Value of the controller's static input map at an input limit."""
    u = limit.astype(float)
    scaled = controller.scale.scaled_input(u)
    within = np.clip(scaled, -WIDEST, WIDEST)
    lifted = evaluate_static_map(controller.s_in, within)
    return float(lifted[0])
