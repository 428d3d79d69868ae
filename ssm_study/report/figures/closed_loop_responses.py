"""Closed loop from every initial condition (left), the same starts without control (middle), and
the controller's input (right). The loop is closed on the true plant, or on the identified model
where there is none. Each colour is one initial condition. A response has settled when it stays in
the grey band."""

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import RecordedCases, StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the best run's closed-loop outputs and inputs, and the outputs without control, for
    every initial condition."""
    (loop,) = study.read_from_best("closed_loop", otherwise="No run reached the closed loop.")
    if style.is_single_column():
        fig = style.new_figure(style.COLUMN_IN, 4.6)
        controlled, alone, given = fig.subplots(3, 1)
    else:
        fig = style.new_figure(style.PAGE_IN, 2.2)
        controlled, alone, given = fig.subplots(1, 3)
    starts = loop["output"][:, 0, 0]
    colours = colours_by_initial_state(starts)
    draw_responses(controlled, loop, "output", colours)
    controlled.set_title("Controlled")
    draw_responses(alone, loop, "uncontrolled", colours)
    alone.set_title("Uncontrolled")
    alone.sharey(controlled)
    time_s = loop.time_s("output")
    inputs = loop["input"][:, :, 0]
    for u, colour in zip(inputs, colours, strict=True):
        given.step(time_s, u, where="post", color=colour, lw=0.8)
    given.set(title="Input of the controlled runs", xlabel="Time (s)", ylabel=loop.label("input"))
    for axes in (controlled, alone, given):
        axes.set_xlim(0, loop.time_after_settling_s)
    return fig


def colours_by_initial_state(starts: Float[np.ndarray, "N"]) -> list[tuple[float, ...]]:
    """Colours for simulations from several initial states, from dark (lowest) to light, the same in
    every panel."""
    colour_map = mpl.colormaps[style.SEQUENCE]
    rank = starts.argsort().argsort()
    highest = max(len(rank) - 1, 1)
    return [colour_map(0.9 * place / highest) for place in rank]


def draw_responses(
    axes: Axes, loop: RecordedCases, name: str, colours: list[tuple[float, ...]]
) -> None:
    """Draw one output of the closed loop over time from every initial state, with the settling
    band."""
    time_s = loop.time_s("output")
    responses = loop[name][:, :, 0]
    for response, colour in zip(responses, colours, strict=True):
        axes.plot(time_s, response, color=colour, lw=0.9)
    goal = loop["reference"][0, -1, 0]
    band = loop.settling_band
    axes.axhspan(goal - band, goal + band, color=style.PALE, lw=0, zorder=0)
    axes.set(xlabel="Time (s)", ylabel=loop.label("output"))
