"""Simulation of many closed loops in parallel, and the recomputation of recorded inputs."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from ssm_study.loop.controller import Controller
from ssm_study.loop.rollout_log import (
    SampleOfCase,
    allocate_log,
    repeat_last_values,
    write_samples,
    write_stopped_cases,
)
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require

# An estimate (scaled), or an input in the plant's own amplitudes from rest, beyond this counts as
# having left the bound: the plant may saturate while the estimate grows without end.
LARGEST_SIGNAL = 1e6
STAYED = -1  # `left_at_sample` of a case that never left the bound
UNLIMITED = (-np.inf, np.inf)
Limit = float | Float[np.ndarray, "*m"]
Limits = tuple[Limit, Limit]
PerCase = Float[np.ndarray, "N"]
States = Float[np.ndarray, "N x"]
Outputs = Float[np.ndarray, "N p"]
OutputSignal = Float[np.ndarray, "T p"]
OutputSignals = Float[np.ndarray, "N T p"]
Bound = Float[np.ndarray, "p"]
Inputs = Float[np.ndarray, "N m"]
Estimates = Float[np.ndarray, "N n"]
CaseSelection = Bool[np.ndarray, "N"]


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Signals of several closed-loop simulations (cases), in physical units.

    `u[:, k]` is held over sample k, `y[:, k]` is read before it acts. `y` is the true output,
    `measured` what the controller saw, `estimate` its state estimate (the
    model's scaled state, width 0 if it has none). A case that leaves `|y - y_eq| <= bound` is
    stopped there: `left_at_sample` says when (`STAYED` if never), and from then on its signals
    repeat the last values inside the bound. One that starts outside repeats its start, with the
    input at rest: none was applied.
    """

    step_s: float
    reference: OutputSignal
    u: Float[np.ndarray, "N T m"]
    y: OutputSignals
    measured: OutputSignals
    estimate: Float[np.ndarray, "N T n"]
    states: Float[np.ndarray, "N T x"]
    bound: Bound
    left_at_sample: SampleOfCase = field(repr=False)

    @property
    def stayed_within_bound(self) -> CaseSelection:
        """For each simulation, whether all signals stayed within the bound at which a simulation is
        stopped as divergent."""
        return self.left_at_sample == STAYED

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        """Time of each sample of the simulation, in seconds."""
        samples = self.y.shape[1]
        return np.arange(samples) * self.step_s


def simulate_closed_loop(
    plant: Plant,
    controller: Controller,
    *,
    initial_states: States,
    reference: OutputSignal,
    noise: OutputSignals,
    disturbance: Float[np.ndarray, "N T q"],
    bound: Bound,
    limits: Limits = UNLIMITED,
    measured_disturbance: Float[np.ndarray, "T k"] | None = None,
) -> Rollouts:
    """Simulate a controller in closed loop with a plant, from several initial conditions at once.
    `u[k] = controller(y[k] + noise[k])`, `x[k+1] = plant.next_states(x[k], u[k], d[k])`.

    All cases at once. `bound (p,)` is the largest `|y - y_eq|` a case may reach before it is
    stopped, in the output's unit; input limits (input's unit) are known to the controller. A
    `measured_disturbance`, physical, drives the identified model and is told to the controller;
    without one it is at its equilibrium. Raises `BadRequest` for unmatched plant and controller.
    """
    _require_valid_experiment(plant, controller, reference, limits)
    cases, samples, _ = noise.shape
    memory = controller.initial_memory(cases)
    targets = controller.target_trajectory(reference)
    estimates = controller.estimate(memory).shape[1]
    log = allocate_log(plant, estimates, noise.shape, initial_states.shape[1])
    left_at_sample = np.full(cases, STAYED)
    going = np.arange(cases)
    x = initial_states
    for k in range(samples):
        y = plant.output(x)
        measured = y + noise[going, k]
        inputs = controller.input(memory, measured, targets[k])
        u = np.clip(inputs, *limits)
        inside = _is_inside_bound(plant, y, u, controller.estimate(memory), bound)
        if not inside.all():  # only those that stay go on
            leaves = ~inside
            stopped = going[leaves]
            left_at_sample[stopped] = k
            last = {"y": y[leaves], "measured": measured[leaves], "states": x[leaves]}
            write_stopped_cases(log, plant, stopped, k, last)
            x = x[inside]
            y = y[inside]
            measured = measured[inside]
            u = u[inside]
            memory = memory[inside]
            going = going[inside]
            controller = controller.select_cases(inside)
        estimate = controller.estimate(memory)
        values = {"u": u, "y": y, "measured": measured, "states": x, "estimate": estimate}
        write_samples(log, going, k, values)
        load = () if measured_disturbance is None else (measured_disturbance[k],)
        memory = controller.next_memory(memory, u, measured, targets[k], *load)
        x = plant.next_states(x, u, disturbance[going, k])
        if load:
            x = x + plant.disturbance_effect(*load)
    repeat_last_values(log, left_at_sample)
    return Rollouts(
        step_s=plant.step_s, reference=reference, bound=bound, left_at_sample=left_at_sample, **log
    )


def _is_inside_bound(
    plant: Plant, y: Outputs, u: Inputs, estimate: Estimates, bound: Bound
) -> CaseSelection:
    """For each simulation, whether output, input and estimate are within the bound at which a
    simulation is stopped as divergent."""
    rest = plant.equilibrium()
    input_deviation = u - rest.u
    input_amplitudes = np.array(plant.input_amplitude)
    amplitudes = input_deviation / input_amplitudes
    inputs_and_estimates = np.hstack([amplitudes, estimate])
    sizes = np.abs(inputs_and_estimates)
    distances = np.abs(y - rest.y)
    is_near = (distances <= bound).all(axis=1)
    is_small = (sizes < LARGEST_SIGNAL).all(axis=1)
    return np.asarray(is_near & is_small)


def _require_valid_experiment(
    plant: Plant, controller: Controller, reference: OutputSignal, limits: Limits
) -> None:
    """Raise `BadRequest` for a controller that does not fit the plant, or a reference that the
    plant cannot hold within the input limits."""
    _require_compatible_controller(plant, controller)
    if any(np.isfinite(end).any() for end in limits):
        required_inputs = controller.required_inputs(reference)
        _require_reachable_reference(required_inputs, limits)


def _require_compatible_controller(plant: Plant, controller: Controller) -> None:
    """Raise `BadRequest` for a controller whose inputs, outputs or sampling time differ from the
    plant's."""
    input_count = len(plant.inputs)
    output_count = len(plant.outputs)
    needed = (input_count, output_count)
    fits = controller.dimensions == needed
    problem = f"the plant has {needed}"
    remedy = "identify the model on this plant's records"
    require(fits, "controller inputs, outputs", controller.dimensions, problem, remedy)
    is_in_step = bool(np.isclose(controller.step_s, plant.step_s, rtol=1e-9))
    problem = f"the plant is sampled every {plant.step_s} s"
    remedy = "identify the model at the plant's sampling time"
    require(is_in_step, "controller.step_s", controller.step_s, problem, remedy)


def _require_reachable_reference(required_inputs: Float[np.ndarray, "K m"], limits: Limits) -> None:
    """Raise `BadRequest` for a reference that the plant can hold only with inputs beyond the
    limits."""
    feasible_inputs = np.clip(required_inputs, *limits)
    beyond = np.abs(required_inputs - feasible_inputs)
    largest_excess = beyond.max(initial=0.0)
    excess = float(largest_excess)
    if excess == 0.0:
        return
    lowest = required_inputs.min()
    highest = required_inputs.max()
    limit_values = (np.asarray(end).tolist() for end in limits)
    values = tuple(limit_values)
    problem = f"holding the reference takes inputs from {lowest:.4g} to {highest:.4g}"
    remedy = f"widen the limits by {excess:.4g}, or choose a smaller loop.reference"
    raise BadRequest("loop.input_lower, loop.input_upper", values, problem, remedy)


def replay_error(controller: Controller, rollouts: Rollouts, limits: Limits = UNLIMITED) -> float:
    """Largest difference between recorded inputs and the inputs that a controller computes again
    from the recorded measurements.

    `|u - u_again| / max |u|` over cases that stayed, `u_again` from the recorded measurements
    alone. `u_again` is cut at the limits that the controller knew of; an integrator replays its own
    hold at a limit. The memory advances by the recorded input, so that errors do not add up.
    """
    stayed = rollouts.stayed_within_bound
    targets = controller.target_trajectory(rollouts.reference)
    stayed_count = stayed.sum()
    memory = controller.initial_memory(int(stayed_count))
    worst = 0.0
    samples = rollouts.u.shape[1]
    for k in range(samples):
        applied = rollouts.u[stayed, k]
        measured = rollouts.measured[stayed, k]
        inputs = controller.input(memory, measured, targets[k])
        again = np.clip(inputs, *limits)
        differences = np.abs(again - applied)
        largest_difference = differences.max(initial=worst)
        worst = float(largest_difference)
        memory = controller.next_memory(memory, applied, measured, targets[k])
    input_sizes = np.abs(rollouts.u)
    largest = float(input_sizes.max())
    smallest_float = np.finfo(float).tiny
    divisor = max(largest, smallest_float)
    return worst / divisor
