"""Trajectories of a model's states and inputs whose output follows a reference as closely as
possible.

A contracting loop converges to any trajectory of its own model: `v = S_u(u*)` by linear-quadratic
tracking, then `u* = S_u^{-1}(v)`, dead zone included (docs/closed_loop.md). Source: [Z26] Theorem 3
for the law; Anderson & Moore (1990), Optimal Control: Linear Quadratic Methods, chapter 4, for
tracking with a known reference.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.refusal import require
from ssm_study.systems import StateSpace

Vector = Float[np.ndarray, "_"]
Matrix = Float[np.ndarray, "_ _"]
Reference = Float[np.ndarray, "T p"]
Plan = Float[np.ndarray, "T t"]  # what is followed at each sample
# Weight on the squared change of `v` per sample against the squared scaled tracking error: a step
# is taken in a few samples and not in one violent one.
SMOOTHNESS = 1.0
IDLE_SHARE = 1e-9  # of the largest static gain: a direction of inputs below this moves no output
NEWTON_STEPS = 100
# residual of `S(v) = w` in scaled units, where one unit is the spread of the signal
INVERSION_TOLERANCE = 1e-10
# residual of an equilibrium, which also has a linear system solved
EQUILIBRIUM_TOLERANCE = 1e-8


def scaled_equilibrium(model: Model, output: Vector) -> tuple[Vector, Vector]:
    """State and input, in scaled units, of the equilibrium at which a model has a given physical
    output.

    `x* = f(x*, S_u(u*)),  y = h(x*, S_u(u*))` for the recurrence f. With more inputs than outputs
    the smallest `S_u(u*)` is taken. Raises `BadRequest` when no input holds that output.
    """
    scaled_output = model.scale.scaled_output(output)
    matrix = find_map_arguments(model.scaffold_out, scaled_output[None])
    y_bar = matrix[0]
    n = model.order
    output_sizes = np.abs(y_bar)
    size = max(1.0, float(output_sizes.max()))
    equilibrium_residual = partial(_equilibrium_residual, model, y_bar)
    residual_jacobian = partial(_residual_jacobian, model)
    if isinstance(model, StructuredSSM):
        input_count = model.b.shape[1]
        start = np.zeros(n + input_count)
        tolerance = INVERSION_TOLERANCE * size
        point = _solve_newton(equilibrium_residual, residual_jacobian, start, tolerance)
    else:
        states, inputs, outputs = model.linear.equilibrium_basis()
        share, *_ = np.linalg.lstsq(outputs, y_bar, rcond=None)
        state_and_input = [states @ share, inputs @ share]
        point = np.concatenate(state_and_input)
    residuals = np.abs(equilibrium_residual(point))
    is_reached = residuals.max() <= EQUILIBRIUM_TOLERANCE * size
    problem = "no constant input of the model holds this scaled output"
    _require_solved(is_reached, y_bar, problem, "")
    equilibrium_input = point[None, n:]
    scaled_input = find_map_arguments(model.scaffold_in, equilibrium_input)[0]
    return point[:n], scaled_input


def _equilibrium_residual(model: Model, scaled_output: Vector, state_and_input: Vector) -> Vector:
    """Residual of a model's equilibrium equations for a state, an input and a scaled output."""
    x, v = np.split(state_and_input, [model.order])
    motion = model.next_state(x, v) - x
    through_neurons: Vector | float = 0.0
    if isinstance(model, StructuredSSM):
        neuron_outputs = model.neuron_outputs(x, v)
        through_neurons = model.h @ neuron_outputs
    linear = model.linear
    linear_output = linear.c @ x + linear.d @ v
    output = linear_output + through_neurons
    residual = [motion, output - scaled_output]
    return np.concatenate(residual)


def _residual_jacobian(model: Model, state_and_input: Vector) -> Matrix:
    """Jacobian of a model's equilibrium equations with respect to state and input."""
    n = model.order
    x, v = np.split(state_and_input, [n])
    linear = model.linearise_at(x, v) if isinstance(model, StructuredSSM) else model.linear
    motion_row = [linear.a - np.eye(n), linear.b]
    output_row = [linear.c, linear.d]
    return np.block([motion_row, output_row])


def reference_tracking_trajectory(model: SSM, reference: Reference) -> Plan:
    """Trajectory of a linear model's states and inputs whose output is as close as possible to a
    reference.

    One row `(x*[k], u*[k])` per sample, in scaled units. Minimises `sum |y_bar[k] - y_bar*[k]|^2 +
    SMOOTHNESS |v[k] - v[k-1]|^2` from the model's equilibrium; the whole reference (output's unit)
    is known in advance, so the input moves before a step does. At rest it gives zeros.

    Preview tracking on `z = (x, v[k-1])` driven by `w = v[k] - v[k-1]`: `P` solves the Riccati
    equation of that cost; the reference enters through the backward sum `g[k] = (F - G K)^T g[k+1]
    - (H - D K)^T target[k]`, started where a reference held for ever would keep it.
    """
    system = model.linear
    n, m = system.b.shape
    _, inputs, outputs = system.equilibrium_basis()
    # Directions of inputs that move no output: at no cost of their own these would drift.
    null_space = scipy.linalg.null_space(outputs, rcond=IDLE_SHARE)
    idle = (inputs @ null_space).T
    scaled_reference = model.scale.scaled_output(reference)
    output_target = find_map_arguments(model.scaffold_out, scaled_reference)
    target = np.pad(output_target, ((0, 0), (0, len(idle))))
    driven_by_changes = _system_of_input_changes(system, idle)
    f = driven_by_changes.a
    g = driven_by_changes.b
    h = driven_by_changes.c
    d = driven_by_changes.d
    weight = SMOOTHNESS * np.eye(m) + d.T @ d
    cross = h.T @ d  # the cross term of a feedthrough
    output_cost = h.T @ h
    p = scipy.linalg.solve_discrete_are(f, g, output_cost, weight, s=cross)
    curvature = weight + g.T @ p @ g
    gradient = g.T @ p @ f + d.T @ h
    k = np.linalg.solve(curvature, gradient)
    closed = f - g @ k
    output_map = h - d @ k
    forced = output_map.T @ target[-1]
    return_difference = np.eye(n + m) - closed.T
    last = -np.linalg.solve(return_difference, forced)  # a reference held for ever
    c = -np.linalg.solve(curvature, g.T)
    through = np.linalg.solve(curvature, d.T)
    backward = StateSpace(a=closed.T, b=-output_map.T, c=c, d=through)
    backward_response, _ = backward.simulate(target[::-1], last)
    preview = backward_response[::-1]
    state_alone = np.eye(n, n + m)
    no_feedthrough = np.zeros((n, m))
    state_and_input = np.vstack([state_alone, closed[n:]])
    feedthrough = np.vstack([no_feedthrough, g[n:]])
    tracking_loop = StateSpace(a=closed, b=g, c=state_and_input, d=feedthrough)
    plan, _ = tracking_loop.simulate(preview)
    states = plan[:, :n]
    scaled_inputs = find_map_arguments(model.scaffold_in, plan[:, n:])
    return np.concatenate([states, scaled_inputs], axis=1)


def _system_of_input_changes(system: StateSpace, idle_directions: Matrix) -> StateSpace:
    """Linear system driven by changes of the input, with the previous input as an additional state.
    Its outputs are the model's and the input's part in the `idle_directions` directions."""
    n, m = system.b.shape
    input_identity = np.eye(m)
    state_row = [system.a, system.b]
    no_states = (m, n)
    held_input_row = [np.zeros(no_states), input_identity]
    output_row = [system.c, system.d]
    idle_shape = (len(idle_directions), n)
    idle_row = [np.zeros(idle_shape), idle_directions]
    a = np.block([state_row, held_input_row])
    input_columns = [system.b, input_identity]
    b = np.vstack(input_columns)
    c = np.block([output_row, idle_row])
    feedthrough_rows = [system.d, idle_directions]
    d = np.vstack(feedthrough_rows)
    return StateSpace(a=a, b=b, c=c, d=d)


def feedback_trajectory(
    model: StructuredSSM, gain: Float[np.ndarray, "m n"], reference: Reference
) -> Plan:
    """Trajectory of a model with neurons on which a state feedback reaches each set point of the
    reference.

    One row `(x*[k], u*[k])` per sample: `u* = us + K (x* - xs)` from the model's equilibrium, `(xs,
    us)` the equilibrium of the reference's value: it gets there at the certified rate. A reference
    at rest gives zeros.
    """
    points = set_point_equilibria(model, reference)
    n = model.order
    x = np.zeros(n)
    plan = np.empty_like(points)
    for i, point in enumerate(points):
        rest_state = point[:n]
        rest_input = point[n:]
        correction = gain @ (x - rest_state)
        u = rest_input + correction
        state_and_input = [x, u]
        plan[i] = np.concatenate(state_and_input)
        mapped_row = model.scaffold_in(u[None])
        mapped_input = mapped_row[0]
        x = model.next_state(x, mapped_input)
    return plan


def set_point_equilibria(model: Model, reference: Reference) -> Plan:
    """Equilibrium state and input of a model for each value of a piecewise constant reference.

    For references that are constant but for steps.
    """
    values, index = np.unique(reference, axis=0, return_inverse=True)
    points = []
    for value in values:
        state, scaled_input = scaled_equilibrium(model, value)
        equilibrium = [state, scaled_input]
        points.append(np.concatenate(equilibrium))
    equilibria = np.stack(points)
    value_numbers = index.reshape(-1)
    return equilibria[value_numbers]


def find_map_arguments(static_map: Scaffold, values: Matrix) -> Matrix:
    """Find the arguments at which a static map has given values, one for each row. Solves `S(v) =
    w` for `v`.

    Scalar maps, which are monotone, are inverted in a bracket; others by damped Newton steps.
    Raises `BadRequest` when the map does not reach `values`.
    """
    if values.shape[1] == 1:
        channel_values = values[:, 0]
        roots = _find_scalar_arguments(static_map, channel_values)[:, None]
    else:
        roots = _find_vector_arguments(static_map, values)
    is_zero = (values == 0).all(axis=1, keepdims=True)
    v = np.where(is_zero, 0.0, roots)  # S(0) = 0 holds exactly
    mapped = static_map(v)
    deviations = np.abs(mapped - values)
    residuals = deviations.max(axis=1)
    value_sizes = np.abs(values)
    size = max(1.0, float(value_sizes.max()))
    tolerance = INVERSION_TOLERANCE * size
    is_reached = residuals.max() <= tolerance
    worst = values[residuals.argmax()]
    problem = "the identified nonlinearity does not reach this scaled value"
    _require_solved(is_reached, worst, problem, ", or raise model.slope_lower")
    return v


def _find_scalar_arguments(static_map: Scaffold, w: Vector) -> Vector:
    """Arguments at which a static map of one channel has given values, by Chandrupatla's
    root-finding method. Solves `S(v) = w`.

    Not a number where no bracket is found.
    """
    from scipy.optimize import elementwise  # slow to load

    def map_residual(v: Vector, w: Vector) -> Vector:
        """Difference between the values of the static map and the required values."""
        argument_column = v[:, None]
        values = static_map(argument_column)[:, 0]
        return values - w

    # SciPy takes a square root of rounding where it does not need it.
    with np.errstate(invalid="ignore"):
        around = elementwise.bracket_root(map_residual, -1.0, 1.0, args=(w,), maxiter=60)
        root = elementwise.find_root(map_residual, around.bracket, args=(w,))
    return np.asarray(root.x)


def _find_vector_arguments(static_map: Scaffold, w: Matrix) -> Matrix:
    """Arguments at which a static map of several channels has given values, by Newton's method.
    Solves `S(v) = w`."""
    values, index = np.unique(w, axis=0, return_inverse=True)
    start = np.zeros(static_map.inputs)
    tolerance = 1e-2 * INVERSION_TOLERANCE

    def map_residual(v: Vector, w: Vector) -> Vector:
        """Difference between the value of the static map and the required value."""
        mapped_value = static_map(v[None])[0]
        return mapped_value - w

    rows = []
    for row in values:
        of_row = partial(map_residual, w=row)
        solved_row = _solve_newton(of_row, static_map.jacobian, start, tolerance)
        rows.append(solved_row)
    solved_rows = np.stack(rows)
    row_numbers = index.reshape(-1)
    return solved_rows[row_numbers]


def _require_solved(
    is_reached: np.bool_, value: Vector, problem_text: str, remedy_suffix: str
) -> None:
    """Raise `BadRequest` for a reference that the model cannot hold, because no equilibrium or
    input was found."""
    remedy = f"choose a reference within the reach of the inputs{remedy_suffix}"
    rounded_value = np.round(value, 4)
    rounded = rounded_value.tolist()
    require(bool(is_reached), "loop.reference", rounded, problem_text, remedy)


def _solve_newton(
    residual: Callable[[Vector], Vector],
    jacobian: Callable[[Vector], np.ndarray],
    start: Vector,
    tolerance: float,
) -> Vector:
    """Root of a vector function, found by Newton's method with damped steps.

    Returns the last point if no step improves it.
    """
    value = residual(start)
    for _ in range(NEWTON_STEPS):
        if np.linalg.norm(value) <= tolerance:
            break
        slopes = jacobian(start)
        step, *_ = np.linalg.lstsq(slopes, -value, rcond=None)
        for share in 0.5 ** np.arange(40):
            trial = start + share * step
            trial_value = residual(trial)
            trial_size = np.linalg.norm(trial_value)
            current_size = np.linalg.norm(value)
            if trial_size < current_size:
                break
        else:
            return start
        start = trial
        value = trial_value
    return start
