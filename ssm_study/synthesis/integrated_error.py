"""Area under the simulated response of a design, and its settling time, for hundreds of designs at
once.

Used to choose among certified designs (docs/closed_loop.md); the separation it leans on is in
docs/theory.md.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.signals import Ends, Trajectories
from ssm_study.systems import Gains, StateSpace, error_input_matrix, stopped_integrator_matrix

InitialStates = Float[np.ndarray, "N n"]
Loads = Float[np.ndarray, "N k"]
RelativeAreas = Float[np.ndarray, "P"]

CASES = 12  # states the model is released from, evenly spaced along the validation record
LEVELS = (-0.5, -0.25, 0.25, 0.5)  # constant loads, in those that hold one output scale
TIME_CONSTANTS = 4.0  # horizon, in time constants of the model's slowest mode
# Shortest and longest horizon: a mode slower than that is not what a loop is judged by.
SAMPLES = (50, 150)
SETTLED = 0.05  # output scales within which a response has settled
# states whose uncontrolled response is below this share of the largest are not counted: they rest
# already
FAINT = 0.1
# Scaled signals are cut here, so that a design that diverges on the model gets a huge area and not
# an overflow.
LARGEST = 1e6
AT_ONCE = 256  # designs simulated together: as many as stay in the processor's cache


def comparison_scenario(
    model: Model, validation: Trajectories, has_loads: bool
) -> tuple[InitialStates, Loads, int]:
    """Initial states, loads and horizon of the simulations by which candidate designs are compared.

    `CASES` states that the model passes through in the validation record; if `has_loads`, also rest
    under loads. Not states in which a constant input would hold the model: a model may have a mode
    so slow that no record ever filled it, and a design that looks fast from there leaves the
    estimate of that mode behind on the plant.
    """
    linear = linearise_at_equilibrium(model)
    visited = []
    for record in validation:
        x = np.zeros(model.order)
        record_samples = len(record)
        pushes = np.zeros((record_samples, 1))
        if record.d is not None:
            pushes = model.disturbance_contribution(record.d)
        mapped_inputs = model.map_input(record.u)
        for mapped_input, push in zip(mapped_inputs, pushes, strict=True):
            visited.append(x)
            x = model.next_state(x, mapped_input) + push
    visited_count = len(visited)
    evenly_spaced = np.linspace(0, visited_count - 1, CASES + 2)
    rounded_places = evenly_spaced.astype(int)
    places = rounded_places[1:-1]
    x0 = np.array(visited)[places]
    positive_radius = max(linear.spectral_radius, 1e-6)
    radius = min(positive_radius, 1 - 1e-6)
    decay = -np.log(radius)  # per sample, of the slowest mode
    samples = np.ceil(TIME_CONSTANTS / decay)
    limited_samples = np.clip(samples, *SAMPLES)
    horizon = int(limited_samples)
    channels = linear.b.shape[1]
    loads = np.zeros((0, channels))
    if has_loads:
        loads = _constant_loads(model, linear, horizon)
    load_count = len(loads)
    at_origin = np.zeros((load_count, model.order))
    start_count = len(x0)
    no_load = np.zeros((start_count, channels))
    all_states = np.concatenate([x0, at_origin])
    all_loads = np.concatenate([no_load, loads])
    return all_states, all_loads, horizon


def _constant_loads(model: Model, linear: StateSpace, horizon: int) -> Float[np.ndarray, "L k"]:
    """Constant load disturbances at several levels for each input of a model, scaled by their
    effect on the output. Inputs without effect are left out."""
    if linear.integrates:  # a unit of each channel holds no state: the one that it reaches
        input_count = linear.b.shape[1]
        unit_rows = np.eye(input_count)
        unit_inputs = unit_rows[:, None]
        constant_inputs = unit_inputs.repeat(horizon, axis=1)
        _, held_states = linear.simulate(constant_inputs)
    else:
        states_by_channel, *_ = linear.equilibrium_basis()
        held_states = states_by_channel.T
    load_count = len(held_states)
    no_input = np.zeros((load_count, linear.b.shape[1]))
    scaled = model.scaled_output_at(held_states, no_input)
    reach = np.linalg.norm(scaled, axis=1)
    least_reach = 1e-6 * reach.max()
    has_effect = reach > least_reach
    unit_loads = np.eye(len(held_states))
    channels = unit_loads[has_effect]
    effects = reach[has_effect, None]
    loads = [level * channels / effects for level in LEVELS]
    return np.concatenate(loads)


def _load_over_time(
    internal_model: Float[np.ndarray, "z z"], outputs: int, horizon: int
) -> Float[np.ndarray, "T"]:
    """Time course of a load disturbance that an internal model can generate, such as a constant, a
    ramp or a sine."""
    own_modes = internal_model[::outputs, ::outputs]  # of one output
    if not len(own_modes):
        return np.ones(horizon)
    powers = [np.linalg.matrix_power(own_modes, k) for k in range(horizon)]
    sums_of_rows = [power.sum(axis=1) for power in powers]
    signals = np.stack(sums_of_rows)
    magnitudes = np.abs(signals)
    largest = magnitudes.max(axis=0)
    shapes = signals / largest
    mean_shape = shapes.mean(axis=1)
    return np.asarray(mean_shape)


def relative_response_areas(
    model: Model, gains: Gains, validation: Trajectories, limits: Ends | None = None
) -> RelativeAreas:
    """Area under the simulated closed-loop response of each design relative to the open loop,
    averaged over initial states.

    `J = sum_k (||y[k]|| + [not settled at k])`, settled when `||y||` stays below `SETTLED`: the
    area hardly sees a faint tail, on which the time to settle turns; the time does not see what
    lies beyond the horizon. Observers start from zero. Gains with an internal model are also judged
    by how soon they remove loads that it makes, constant ones with integrators. No noise, scaled
    units, inputs within `limits`, where it is `equilibrium_basis`. Below one the loop is faster
    than without control.
    """
    loaded = len(gains.modes) > 0
    x0, load, horizon = comparison_scenario(model, validation, has_loads=loaded)
    input_limits = limits or (-LARGEST, LARGEST)
    no_gain = 0 * gains.k[:1]
    no_injection = 0 * gains.l[:1]
    no_control = replace(gains, k=no_gain, l=no_injection, l_z=None)
    open_loop_areas = _response_areas(model, no_control, x0, load, horizon, input_limits)
    alone = open_loop_areas[0]
    counts = alone > FAINT * alone.max()
    pairs = len(gains.k)
    batch_count = -(-pairs // AT_ONCE)
    areas = []
    pair_numbers = np.arange(pairs)
    for batch in np.array_split(pair_numbers, batch_count):
        some_gains = gains.select_pairs(batch)
        areas_of_batch = _response_areas(model, some_gains, x0, load, horizon, input_limits)
        areas.append(areas_of_batch)
    all_areas = np.concatenate(areas)
    counted = all_areas[:, counts]
    relative = counted / alone[counts]
    return relative.mean(axis=1)


def _response_areas(
    model: Model,
    gains: Gains,
    x0: InitialStates,
    load: Loads,
    horizon: int,
    input_limits: Ends | tuple[float, float],
) -> Float[np.ndarray, "P N"]:
    """Area under the response plus settling time, for each design and each initial state."""
    n = model.order
    k = gains.k.transpose(0, 2, 1)
    l_ = gains.l.transpose(0, 2, 1)
    l_z = None if gains.l_z is None else gains.l_z.transpose(0, 2, 1)
    modes = gains.modes
    outputs = l_.shape[1]
    into_modes = error_input_matrix(modes, outputs)
    shape = _load_over_time(modes, outputs, horizon)
    state_gain = k[:, :n]
    internal_gain = k[:, n:]
    pairs = len(k)
    repeated_starts = np.broadcast_to(x0, (pairs, *x0.shape))
    x = repeated_starts.copy()
    x_hat = np.zeros_like(x)
    cases = x.shape[:2]
    z = np.zeros((*cases, k.shape[1] - n))
    area = np.zeros(cases)
    settled_at = np.zeros(cases)
    for sample in range(horizon):
        requested = x_hat @ state_gain + z @ internal_gain
        u = np.clip(requested, *input_limits)
        mapped_input = model.scaffold_in(u)
        loaded = mapped_input + load * shape[sample]
        y = model.scaled_output_at(x, loaded)
        innovation = model.scaled_output_at(x_hat, mapped_input) - y
        size = np.linalg.norm(y, axis=2)
        area = area + size
        settled_at = np.where(size > SETTLED, sample + 1.0, settled_at)
        is_free = (u == requested).all(axis=2, keepdims=True)
        free_modes = z @ modes.T
        moved = free_modes + y @ into_modes.T
        frozen = z @ stopped_integrator_matrix(modes).T
        next_z = np.where(is_free, moved, frozen)
        z = np.clip(next_z, -LARGEST, LARGEST)
        x = model.next_state(x, loaded)
        into_neurons = () if l_z is None else (innovation @ l_z,)
        predicted = model.next_state(x_hat, mapped_input, *into_neurons)
        estimate = predicted + innovation @ l_
        x_hat = np.clip(estimate, -LARGEST, LARGEST)
    return area + settled_at
