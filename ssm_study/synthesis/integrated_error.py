"""Area under a design's response on the model, and its settling time, for hundreds of designs at
once.

Used to choose among certified designs (docs/closed_loop.md); the separation it leans on is in
docs/theory.md.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.signals import Ends, Trajectories
from ssm_study.systems import Gains, StateSpace, error_input_matrix, frozen_modes

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
    model: Model, validation: Trajectories, loaded: bool
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N k"], int]:
    """Initial states, loads and horizon of the simulations in which designs are compared.

    `CASES` states that the model passes through in the validation record; if `loaded`, also rest
    under loads. Not states in which a constant input would hold the model: a model may have a mode
    so slow that no record ever filled it, and a design that looks fast from there leaves the
    estimate of that mode behind on the plant.
    """
    linear = linearise_at_equilibrium(model)
    visited = []
    for record in validation:
        x = np.zeros(model.order)
        pushes = (
            np.zeros((len(record), 1))
            if record.d is None
            else model.disturbance_contribution(record.d)
        )
        for ubar, push in zip(model.map_input(record.u), pushes, strict=True):
            visited.append(x)
            x = model.advance(x, ubar) + push
    spaced = np.linspace(0, len(visited) - 1, CASES + 2).astype(int)
    x0 = np.array(visited)[spaced[1:-1]]
    radius = min(max(linear.spectral_radius, 1e-6), 1 - 1e-6)
    decay = -np.log(radius)  # per sample, of the slowest mode
    samples = np.ceil(TIME_CONSTANTS / decay)
    horizon = int(np.clip(samples, *SAMPLES))
    channels = linear.b.shape[1]
    load = _constant_loads(model, linear, horizon) if loaded else np.zeros((0, channels))
    at_origin = np.zeros((len(load), model.order))
    no_load = np.zeros((len(x0), channels))
    return np.concatenate([x0, at_origin]), np.concatenate([no_load, load]), horizon


def _constant_loads(model: Model, linear: StateSpace, horizon: int) -> Float[np.ndarray, "L k"]:
    """Constant loads at several levels for each input, scaled by their effect on the output. Inputs
    without effect are left out."""
    if linear.integrates:  # a unit of each channel holds no state: the one that it reaches
        response = linear.simulate(np.eye(linear.b.shape[1])[:, None].repeat(horizon, axis=1))
        held_states = response[1]
    else:
        held_states = linear.steady_states()[0].T
    no_input = np.zeros((len(held_states), linear.b.shape[1]))
    scaled = model.scaled_output_at(held_states, no_input)
    reach = np.linalg.norm(scaled, axis=1)
    counts = reach > 1e-6 * reach.max()
    channels = np.eye(len(held_states))[counts]
    loads = [level * channels / reach[counts, None] for level in LEVELS]
    return np.concatenate(loads)


def _load_time_course(
    modes: Float[np.ndarray, "z z"], outputs: int, horizon: int
) -> Float[np.ndarray, "T"]:
    """Time course of a load that the internal model can generate, such as a constant, a ramp or a
    sine."""
    own_modes = modes[::outputs, ::outputs]  # of one output
    if not len(own_modes):
        return np.ones(horizon)
    powers = [np.linalg.matrix_power(own_modes, k).sum(axis=1) for k in range(horizon)]
    signals = np.stack(powers)
    shapes = signals / np.abs(signals).max(axis=0)
    return np.asarray(shapes.mean(axis=1))


def relative_areas(
    model: Model, gains: Gains, validation: Trajectories, limits: Ends | None = None
) -> Float[np.ndarray, "P"]:
    """Response area of each design relative to the open loop, averaged over the initial states.

    `J = sum_k (||y[k]|| + [not settled at k])`, settled when `||y||` stays below `SETTLED`: the
    area hardly sees a faint tail, on which the time to settle turns; the time does not see what
    lies beyond the horizon. Observers start from zero. Gains with an internal model are also judged
    by how soon they remove loads that it makes, constant ones with integrators. No noise, scaled
    units, inputs within `limits`, where it is `steady_states`. Below one is faster than none.
    """
    loaded = len(gains.modes) > 0
    x0, load, horizon = comparison_scenario(model, validation, loaded=loaded)
    cut = limits or (-LARGEST, LARGEST)
    k = 0 * gains.k[:1]
    no_control = replace(gains, k=k, l=0 * gains.l[:1], l_z=None)
    alone = _response_areas(model, no_control, x0, load, horizon, cut)[0]
    counts = alone > FAINT * alone.max()
    batches = np.array_split(np.arange(len(gains.k)), -(-len(gains.k) // AT_ONCE))
    areas = [
        _response_areas(model, gains.select_pairs(batch), x0, load, horizon, cut)
        for batch in batches
    ]
    counted = np.concatenate(areas)[:, counts]
    return (counted / alone[counts]).mean(axis=1)


def _response_areas(
    model: Model,
    gains: Gains,
    x0: Float[np.ndarray, "N n"],
    load: Float[np.ndarray, "N k"],
    horizon: int,
    limits: Ends | tuple[float, float],
) -> Float[np.ndarray, "P N"]:
    """Response area plus settling time of each design from each initial state."""
    n = model.order
    k = gains.k.transpose(0, 2, 1)
    l_ = gains.l.transpose(0, 2, 1)
    l_z = None if gains.l_z is None else gains.l_z.transpose(0, 2, 1)
    modes = gains.modes
    outputs = l_.shape[1]
    into_modes = error_input_matrix(modes, outputs)
    shape = _load_time_course(modes, outputs, horizon)
    x = np.broadcast_to(x0, (len(k), *x0.shape)).copy()
    x_hat = np.zeros_like(x)
    z = np.zeros((*x.shape[:2], k.shape[1] - n))
    area = np.zeros(x.shape[:2])
    settled_at = np.zeros(x.shape[:2])
    for sample in range(horizon):
        requested = x_hat @ k[:, :n] + z @ k[:, n:]
        u = np.clip(requested, *limits)
        lifted = model.scaffold_in(u)
        loaded = lifted + load * shape[sample]
        y = model.scaled_output_at(x, loaded)
        innovation = model.scaled_output_at(x_hat, lifted) - y
        size = np.linalg.norm(y, axis=2)
        area = area + size
        settled_at = np.where(size > SETTLED, sample + 1.0, settled_at)
        is_free = (u == requested).all(axis=2, keepdims=True)
        moved = z @ modes.T + y @ into_modes.T
        frozen = z @ frozen_modes(modes).T
        z = np.clip(np.where(is_free, moved, frozen), -LARGEST, LARGEST)
        x = model.advance(x, loaded)
        injected = () if l_z is None else (innovation @ l_z,)
        estimate = model.advance(x_hat, lifted, *injected) + innovation @ l_
        x_hat = np.clip(estimate, -LARGEST, LARGEST)
    return area + settled_at
