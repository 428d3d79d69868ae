"""Simulation of closed loops for many cases at once, with measures of their behaviour.

Judged on the true output alone, never on the noisy measurement.
"""

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
# share of the horizon, at its end, that a settled case spends in the band: a last sample in it is
# no rest
DWELL = 0.1
# a case whose largest error in the last quarter is below this share of the one before is still on
# its way
STEADY = 0.9


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Simulated closed-loop runs of several cases, in physical units.

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
        """For each case, whether its signals stayed within the bound of the simulation."""
        return self.left_at_sample == STAYED

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        """Time of each sample, in seconds."""
        samples = self.y.shape[1]
        return np.arange(samples) * self.step_s


def simulate_closed_loop(
    plant: Plant,
    controller: Controller,
    *,
    x0: States,
    reference: OutputSignal,
    noise: OutputSignals,
    disturbance: Float[np.ndarray, "N T q"],
    bound: Bound,
    limits: Limits = UNLIMITED,
    measured_disturbance: Float[np.ndarray, "T k"] | None = None,
) -> Rollouts:
    """Simulate a controller in closed loop with a plant, for all cases at once. `u[k] =
    controller(y[k] + noise[k])`, `x[k+1] = plant.advance(x[k], u[k], d[k])`.

    All cases at once. `bound (p,)` is the largest `|y - y_eq|` a case may reach before it is
    stopped, in the output's unit; input limits (input's unit) are known to the controller. A
    `measured_disturbance`, physical, drives the identified model and is told to the controller;
    without one it is at its equilibrium. Raises `BadRequest` for unmatched plant and controller.
    """
    _check_request(plant, controller, reference, limits)
    cases, samples, _ = noise.shape
    memory = controller.initial_memory(cases)
    targets = controller.reference_targets(reference)
    estimates = controller.estimate(memory).shape[1]
    log = allocate_log(plant, estimates, noise.shape, x0.shape[1])
    left_at_sample = np.full(cases, STAYED)
    going = np.arange(cases)
    x = x0
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
        memory = controller.advance(memory, u, measured, targets[k], *load)
        x = plant.advance(x, u, disturbance[going, k])
        if load:
            x = x + plant.disturbance_effect(*load)
    repeat_last_values(log, left_at_sample)
    return Rollouts(
        step_s=plant.step_s, reference=reference, bound=bound, left_at_sample=left_at_sample, **log
    )


def _is_inside_bound(
    plant: Plant, y: Outputs, u: Inputs, estimate: Estimates, bound: Bound
) -> CaseSelection:
    """For each case, whether output, input and estimate are within the bound of the simulation."""
    rest = plant.equilibrium()
    amplitudes = (u - rest.u) / np.array(plant.input_amplitude)
    inputs_and_estimates = np.hstack([amplitudes, estimate])
    sizes = np.abs(inputs_and_estimates)
    distances = np.abs(y - rest.y)
    is_near = (distances <= bound).all(axis=1)
    is_small = (sizes < LARGEST_SIGNAL).all(axis=1)
    return np.asarray(is_near & is_small)


def _check_request(
    plant: Plant, controller: Controller, reference: OutputSignal, limits: Limits
) -> None:
    """Raise `BadRequest` for a controller that does not fit the plant, and for a reference beyond
    the reach of limited inputs."""
    _check_dimensions(plant, controller)
    if any(np.isfinite(end).any() for end in limits):
        required_inputs = controller.required_inputs(reference)
        _check_reference_inputs(required_inputs, limits)


def _check_dimensions(plant: Plant, controller: Controller) -> None:
    """Raise `BadRequest` for a controller whose inputs, outputs or sampling time differ from the
    plant's."""
    needed = (len(plant.inputs), len(plant.outputs))
    fits = controller.dimensions == needed
    problem = f"the plant has {needed}"
    remedy = "identify the model on this plant's records"
    require(fits, "controller inputs, outputs", controller.dimensions, problem, remedy)
    is_in_step = bool(np.isclose(controller.step_s, plant.step_s, rtol=1e-9))
    problem = f"the plant is sampled every {plant.step_s} s"
    remedy = "identify the model at the plant's sampling time"
    require(is_in_step, "controller.step_s", controller.step_s, problem, remedy)


def _check_reference_inputs(demanded: Float[np.ndarray, "K m"], limits: Limits) -> None:
    """Raise `BadRequest` for a reference whose values need inputs beyond the limits."""
    beyond = np.abs(demanded - np.clip(demanded, *limits))
    excess = float(beyond.max(initial=0.0))
    if excess == 0.0:
        return
    lowest = demanded.min()
    highest = demanded.max()
    values = tuple(np.asarray(end).tolist() for end in limits)
    problem = f"holding the reference takes inputs from {lowest:.4g} to {highest:.4g}"
    remedy = f"widen the limits by {excess:.4g}, or choose a smaller loop.reference"
    raise BadRequest("loop.input_lower, loop.input_upper", values, problem, remedy)


def last_step_sample(reference: OutputSignal) -> int:
    """Sample at which a step reference reaches its final value.

    0 if the reference still moves in the second half.
    """
    steps = np.diff(reference, axis=0)
    has_changed = np.any(steps != 0, axis=1)
    changes = np.flatnonzero(has_changed)
    if not len(changes):
        return 0
    last = int(changes[-1]) + 1
    middle = len(reference) // 2
    return last if last <= middle else 0


def settling_times_s(rollouts: Rollouts, band: float) -> tuple[float | None, ...]:
    """Settling time of each case, in seconds after the last step of the reference.

    From that time on `|y - reference| <= band` holds to the end. None if there is no such time, or
    if less than `DWELL` of the horizon follows it. `band` in the output's unit. A case that left
    the bound never settles, whatever it did before; one that is in the band throughout settles in
    0.
    """
    error = rollouts.y - rollouts.reference
    is_far = np.abs(error) > band
    outside = is_far.any(axis=2)
    samples = outside.shape[1]
    backwards = outside[:, ::-1]
    since_last_outside = np.argmax(backwards, axis=1)
    was_outside = outside.any(axis=1)
    first = np.where(was_outside, samples - since_last_outside, 0)
    share_in_samples = np.ceil(DWELL * samples)
    dwell = max(int(share_in_samples), 1)
    dwells = first <= samples - dwell
    is_settled = rollouts.stayed_within_bound & dwells
    last_step = last_step_sample(rollouts.reference)
    after_step = np.maximum(first - last_step, 0)
    times_s: list[float | None] = []
    for k, settles in zip(after_step, is_settled, strict=True):
        time_s = float(k * rollouts.step_s)
        times_s.append(time_s if settles else None)
    return tuple(times_s)


def classify_motions(rollouts: Rollouts, band: float) -> tuple[str, ...]:
    """Class of each case's motion: `settled`, `lost`, `slow`, `oscillating` or `drifting`.

    Lost: it left the bound. Slow: the error still shrinks from the third quarter of the horizon to
    the last. Oscillating: over these two, the swing about a straight line exceeds what the line
    itself rises. Drifting: the rest, an error that stays where it is among them.
    """
    times_s = settling_times_s(rollouts, band)
    has_settled = [time_s is not None for time_s in times_s]
    error = rollouts.y - rollouts.reference
    size = np.linalg.norm(error, axis=2)
    quarter = max(size.shape[1] // 4, 1)
    half = 2 * quarter
    in_third_quarter = size[:, -half:-quarter]
    in_last_quarter = size[:, -quarter:]
    third_quarter = in_third_quarter.max(axis=1)
    last_quarter = in_last_quarter.max(axis=1)
    largest_errors = np.abs(error).max(axis=1)
    worst_output = np.argmax(largest_errors, axis=1)
    places = worst_output[:, None, None]
    worst_error = np.take_along_axis(error, places, axis=2)[:, :, 0]
    rise, swing = trend_and_oscillation(worst_error[:, -half:])
    least_swing = np.maximum(np.abs(rise), band)
    oscillates = swing > least_swing
    moving = np.where(oscillates, "oscillating", "drifting")
    still_shrinks = last_quarter < STEADY * third_quarter
    kinds = np.where(still_shrinks, "slow", moving)
    kinds = np.where(rollouts.stayed_within_bound, kinds, "lost")
    kinds = np.where(has_settled, "settled", kinds)
    return tuple(str(kind) for kind in kinds)


def trend_and_oscillation(signals: Float[np.ndarray, "N K"]) -> tuple[PerCase, PerCase]:
    """Trend of each row, as the rise of its least-squares line, and its peak-to-peak oscillation
    about that line."""
    samples = signals.shape[1]
    time = np.linspace(-0.5, 0.5, samples)
    time_power = time @ time
    rise = signals @ time / time_power
    means = signals.mean(axis=1, keepdims=True)
    line = rise[:, None] * time
    deviation = (signals - means) - line
    return rise, np.ptp(deviation, axis=1)


def residual_oscillations(rollouts: Rollouts, band: float) -> Float[np.ndarray, "S"]:
    """Amplitude of each settled case's oscillation in the last tenth of the horizon, for the output
    that oscillates most.

    The amplitude is about a straight line. A loop that swings for ever inside the band of settling
    is settled by definition, and not at rest. In the output's unit.
    """
    times_s = settling_times_s(rollouts, band)
    is_settled = np.array([time_s is not None for time_s in times_s])
    error = (rollouts.y - rollouts.reference)[is_settled]
    _, samples, outputs = error.shape
    share_in_samples = np.ceil(DWELL * samples)
    last = max(int(share_in_samples), 2)
    tails = error[:, -last:]
    swings = []
    for output in range(outputs):
        _, swing = trend_and_oscillation(tails[:, :, output])
        swings.append(swing)
    largest_swings = np.max(swings, axis=0)
    return np.asarray(largest_swings / 2)


def overshoots(rollouts: Rollouts, band: float) -> PerCase:
    """Overshoot of each case beyond the reference, as a share of the initial error.

    An excursion counts on the far side from the start, which is the last step of the reference; the
    worst channel counts. Only excursions beyond the band count: within it, the measurement noise
    that the controller passes on decides. Zero for cases that start within the band.
    """
    start_sample = last_step_sample(rollouts.reference)
    error = (rollouts.y - rollouts.reference)[:, start_sample:]
    start = error[:, :1]
    size = np.abs(start[:, 0])
    on_far_side = -np.sign(start) * error
    excursions = np.maximum(on_far_side, 0.0)
    excursion = excursions.max(axis=1)
    counts = (size > band) & (excursion > band)
    divisors = np.where(counts, size, 1.0)
    shares = excursion / divisors
    counted_shares = np.where(counts, shares, 0.0)
    return counted_shares.max(axis=1)


def measured_contraction_rate(rollouts: Rollouts, band: float) -> float | None:
    """Measured contraction rate `1 - r^2` of the closed loop, median over pairs of cases.

    r is the mean shrink per sample of `|y_i - y_j|` from the start until it is within the band.
    Pairs count that start more than twice the band apart; the rate is in the convention of
    `rate_controller` (distances shrink by `sqrt(1 - rate)`), so the two compare. Pairs that
    never come within the band are taken to the end of the horizon. None without such pairs.
    """
    i, j = np.triu_indices(len(rollouts.y), k=1)  # each pair of cases once
    differences = rollouts.y[i] - rollouts.y[j]
    distances = np.linalg.norm(differences, axis=2)
    starts_apart = distances[:, 0] > 2 * band
    if not starts_apart.any():
        return None
    resolution = band / 2  # an exact zero is not a rate
    distances = np.maximum(distances[starts_apart], resolution)
    per_case = mean_squared_contraction(distances, band)
    median = np.median(per_case)
    return float(1.0 - median)


def mean_squared_contraction(
    distance: Float[np.ndarray, "N T"], until: float | Float[np.ndarray, "N 1"]
) -> PerCase:
    """Squared mean factor per sample by which each row of distances shrinks.

    A row counts until it is at most `until`, else to its end.
    """
    is_small = distance <= until
    last_sample = distance.shape[1] - 1
    becomes_small = is_small.any(axis=1)
    first_small = np.argmax(is_small, axis=1)
    at = np.where(becomes_small, first_small, last_sample)
    rows = np.arange(len(distance))
    ratios = distance[rows, at] / distance[:, 0]
    exponents = 2.0 / np.maximum(at, 1)
    return np.asarray(ratios**exponents)


def replay_error(controller: Controller, run: Rollouts, limits: Limits = UNLIMITED) -> float:
    """Largest difference between recorded inputs and the inputs that the controller computes again,
    relative to the largest input.

    `|u - u_again| / max |u|` over cases that stayed, `u_again` from the recorded measurements
    alone. `u_again` is cut at the limits that the controller knew of; an integrator replays its own
    hold at a limit. The memory advances by the recorded input, so that errors do not add up.
    """
    stayed = run.stayed_within_bound
    targets = controller.reference_targets(run.reference)
    memory = controller.initial_memory(int(stayed.sum()))
    worst = 0.0
    for k in range(run.u.shape[1]):
        applied = run.u[stayed, k]
        measured = run.measured[stayed, k]
        inputs = controller.input(memory, measured, targets[k])
        again = np.clip(inputs, *limits)
        differences = np.abs(again - applied)
        worst = float(differences.max(initial=worst))
        memory = controller.advance(memory, applied, measured, targets[k])
    largest = float(np.abs(run.u).max())
    divisor = max(largest, np.finfo(float).tiny)
    return worst / divisor
