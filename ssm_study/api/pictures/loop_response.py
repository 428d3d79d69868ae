"""Pictures of the closed loop's response to initial outputs and to a step of the set point."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study import style
from ssm_study.api.pictures.picture import (
    DASHED,
    Band,
    EmptyPictureError,
    GuideLine,
    Picture,
    PicturePanel,
    Series,
)
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.decay_time import plain_digits
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.motion import settling_times_s
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.rollout import Rollouts
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

SIZES = (0.5, 0.25, 0.1)  # steps tried, in output scales: the first that the input can hold
BEFORE = 0.1  # share of the horizon before the step
SEEN_SETTLING_TIMES = 6  # how much is drawn after the step, in settling times
FEWEST_SEEN = 40  # samples
MOTION = 0.01  # share of its largest deviation from which on an input counts as moving
OUTPUT_MOTION = 0.05  # share of its way from which on an output counts as moving
Inputs = Sequence[Float[np.ndarray, "_ m"]]
Times = Float[np.ndarray, "T"]


def initial_response_picture(
    controlled: Rollouts,
    uncontrolled: Rollouts,
    plant: Any,
    recorded_inputs: Inputs,
    loop_place: str,
) -> Picture:
    """Picture of the closed loop's outputs and inputs from given initial outputs, beside the
    response without control."""
    output_count = len(plant.outputs)
    input_count = len(plant.inputs)
    columns = max(output_count, input_count)
    upper = []
    for j, channel in enumerate(plant.outputs):
        open_loop = _curves_of_initial_states(uncontrolled, "y", j, "open loop", style.GREY)
        closed = _curves_of_initial_states(controlled, "y", j, "under control", style.BLUE)
        series = (*open_loop, *closed)
        axis_label = channel_label(channel)
        panel = PicturePanel(x_label="Time (s)", y_label=axis_label, series=series)
        upper.append(panel)
    lower = _input_panels(controlled, plant.inputs, recorded_inputs)
    upper_row = _pad_panels(upper, columns)
    lower_row = _pad_panels(lower, columns)
    panels = (*upper_row, *lower_row)
    title = f"Closed loop on {loop_place}"
    return Picture(title=title, panels=panels, columns=columns, wide=True)


def set_point_picture(
    plant: Plant | IdentifiedPlant,
    design: Design,
    model: Any,
    loop: LoopExperiment,
    recorded_inputs: Inputs,
    loop_place: str,
    size: float | None = None,
) -> Picture:
    """Picture of the closed loop's response to a step of the set point, without noise.

    `size` is in the output's unit. By default it is the largest share of the output's scale, among
    those in `SIZES`, at which an input within the limits of `loop` can hold the output. Raises
    `EmptyPictureError` if there is none.
    """
    controller = ObserverFeedback.from_design(model, design)
    output_scale = model.scale.output_scale
    scale = float(output_scale.min())
    sizes = (size,) if size is not None else tuple(share * scale for share in SIZES)
    reason = "No step of the set point can be held."
    for candidate in sizes:
        try:
            run = _simulate_step_response(plant, controller, loop, candidate)
        except BadRequest as refusal:
            reason = f"No step of the set point can be held: {refusal}"
            continue
        return _step_picture(run, plant, recorded_inputs, loop_place, candidate)
    raise EmptyPictureError(reason)


def _simulate_step_response(
    plant: Any, controller: ObserverFeedback, loop: LoopExperiment, size: float
) -> Rollouts:
    """Simulate the closed loop for a step of the set point, starting at the equilibrium."""
    samples = loop.horizon_samples(plant.step_s)
    at_s = BEFORE * samples * plant.step_s
    reference = StepReference(before=0.0, after=size, at_s=at_s)
    rest = plant.equilibrium().y[None]
    noise_shape = (1, samples, len(plant.outputs))
    noise = np.zeros(noise_shape)
    stepped_loop = replace(loop, reference=reference)
    return stepped_loop.simulate(plant, controller, rest, noise)


def _step_picture(
    run: Rollouts, plant: Any, recorded_inputs: Inputs, loop_place: str, size: float
) -> Picture:
    """Picture of a step response: the output beside its reference, and the input."""
    (time_s,) = settling_times_s(run, plant.settling_band)
    time_range = _drawn_time_range(run, time_s)
    samples_before = BEFORE * len(run.time_s)
    at_s = samples_before * run.step_s
    ahead = _first_input_change_s(run) < at_s - run.step_s
    set_point_name = "set point, known in advance" if ahead else "set point"
    output_count = len(plant.outputs)
    input_count = len(plant.inputs)
    columns = max(output_count, input_count)
    upper = []
    for j, channel in enumerate(plant.outputs):
        ndim = run.reference.ndim
        goal = run.reference[0, :, j] if ndim == 3 else run.reference[:, j]
        band = _settling_band(run.time_s, goal, plant.settling_band, channel.unit)
        set_point = Series(
            x=run.time_s, y=goal, mark="steps", colour=style.INK, dashes=DASHED, name=set_point_name
        )
        y = run.y[0, :, j]
        output = Series(x=run.time_s, y=y, name="output")
        series = (set_point, output)
        axis_label = channel_label(channel)
        panel = PicturePanel(
            x_label="Time (s)", y_label=axis_label, series=series, bands=(band,), x_range=time_range
        )
        upper.append(panel)
    input_panels = _input_panels(run, plant.inputs, recorded_inputs)
    lower = [replace(panel, x_range=time_range) for panel in input_panels]
    upper_row = _pad_panels(upper, columns)
    lower_row = _pad_panels(lower, columns)
    panels = (*upper_row, *lower_row)
    ending = "does not settle"
    if time_s is not None:
        ending = f"settles in {plain_digits(time_s)} s"
        if ahead:
            since_motion_s = time_s + at_s - _first_output_change_s(run)
            ending += f" ({since_motion_s:.2g} s after the output first moves)"
    unit = f" {plant.outputs[0].unit}" if plant.outputs[0].unit else ""
    known = ", known in advance," if ahead else ""
    title = f"Step of the set point by {size:.3g}{unit}{known} on {loop_place}: {ending}"
    return Picture(title=title, panels=panels, columns=columns, wide=True)


def _settling_band(time_s: Times, goal: Times, half_width: float, unit: str) -> Band:
    """Band in which a response counts as settled, around a set point that steps."""
    doubled_times = np.repeat(time_s, 2)
    twice_s = doubled_times[1:]
    doubled_goal = np.repeat(goal, 2)
    held_goal = doubled_goal[:-1]
    point_count = len(twice_s)
    is_corner = np.ones(point_count, dtype=bool)
    same_before = held_goal[1:-1] == held_goal[:-2]
    same_after = held_goal[1:-1] == held_goal[2:]
    is_corner[1:-1] = ~(same_before & same_after)
    corners = held_goal[is_corner]
    name = f"settling band, ± {half_width:.2g} {unit}".rstrip()
    return Band(
        x=twice_s[is_corner], low=corners - half_width, high=corners + half_width, name=name
    )


def _drawn_time_range(run: Rollouts, settling_time_s: float | None) -> tuple[float, float]:
    """Time range of a step response that a picture shows, from shortly before the output moves."""
    end_s = float(run.time_s[-1])
    samples_before = BEFORE * len(run.time_s)
    at_s = samples_before * run.step_s
    if settling_time_s is None:
        return 0.0, end_s
    shortest_s = FEWEST_SEEN * run.step_s
    span_s = max(SEEN_SETTLING_TIMES * settling_time_s, shortest_s)
    early_s = at_s - span_s / 4
    first_motion_s = _first_input_change_s(run)
    start_s = min(early_s, first_motion_s - run.step_s)
    return max(0.0, start_s), min(end_s, at_s + span_s)


def _first_input_change_s(run: Rollouts) -> float:
    """Time in seconds at which the input first changes in a step response. It is before the step
    where a trajectory is planned, since the step is then known in advance
    (`loop.trajectory.reference_tracking_trajectory`)."""
    motion = run.u[0] - run.u[0, :1]
    away = np.abs(motion).max(axis=1)
    moved = away > MOTION * away.max()
    first_moved = int(moved.argmax()) if moved.any() else -1
    return float(run.time_s[first_moved])


def _first_output_change_s(run: Rollouts) -> float:
    """Time in seconds at which the output has covered a small fraction of its total change."""
    motion = run.y[0] - run.y[0, :1]
    away = np.abs(motion).max(axis=1)
    moved = away > OUTPUT_MOTION * away[-1]
    first_moved = int(moved.argmax())
    return float(run.time_s[first_moved])


def _curves_of_initial_states(
    runs: Rollouts, signal: str, j: int, name: str, colour: str
) -> tuple[Series, ...]:
    """Curves of one signal from all initial states; only the first curve has a legend entry."""
    values = getattr(runs, signal)
    mark: Any = "steps" if signal == "u" else "line"
    curves = (
        Series(
            x=runs.time_s,
            y=values[i, :, j],
            name="" if i else name,
            colour=colour,
            mark=mark,
            thin=True,
        )
        for i in range(len(values))
    )
    return tuple(curves)


def _input_panels(
    runs: Rollouts, inputs: Sequence[Channel], recorded_inputs: Inputs
) -> list[PicturePanel]:
    """Panels of a picture that show the inputs, with lines at the ends of their recorded range."""
    panels = []
    for j, channel in enumerate(inputs):
        rules: tuple[GuideLine, ...] = ()
        if len(recorded_inputs):
            recorded_values = [record[:, j] for record in recorded_inputs]
            values = np.concatenate(recorded_values)
            lowest = values.min()
            guide_line = GuideLine(y=float(lowest), name="recorded range")
            y = float(values.max())
            rules = (guide_line, GuideLine(y=y))
        series = _curves_of_initial_states(runs, "u", j, "input", style.VERMILLION)
        axis_label = channel_label(channel)
        panel = PicturePanel(x_label="Time (s)", y_label=axis_label, series=series, rules=rules)
        panels.append(panel)
    return panels


def _pad_panels(panels: list[PicturePanel], columns: int) -> list[PicturePanel]:
    """Fill a row of panels with empty panels up to a number of columns."""
    empty = PicturePanel(x_label="", y_label="", series=())
    missing = columns - len(panels)
    return panels + [empty] * missing


def channel_label(channel: Any) -> str:
    """Axis label of a channel: its name, with its unit in parentheses."""
    channel_name = str(channel.name)
    name = channel_name.replace("_", " ")
    return f"{name[:1].upper()}{name[1:]} ({channel.unit})" if channel.unit else name
