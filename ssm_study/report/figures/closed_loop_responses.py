"""Closed loop from every initial condition (left), the same starts left alone (middle), and the input the controller
asked for (right): on the true plant, or on the identified model where there is none. The band counts as settled."""

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.study_folder import Study
from ssm_study.report.trajectories import ClosedLoop


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.closed_loop is None:
        return style.message("No run reached the closed loop.", style.PAGE_IN)
    return figure(run.closed_loop, run.settling_band)


def figure(loop: ClosedLoop, settling_band: float | None) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.2)
    controlled, alone, given = fig.subplots(1, 3)
    colours = _colours(loop.y[:, 0, 0])
    panels = [(controlled, loop.y, "Controlled"), (alone, loop.uncontrolled, "Uncontrolled")]
    for axes, y, title in panels:
        if y is not None:
            _responses(axes, loop.time_s, y[:, :, 0], colours)
            _settled(axes, loop, settling_band)
        axes.set(title=title, xlabel="Time (s)", ylabel=loop.output_label)
    if loop.uncontrolled is None:
        alone.text(
            0.5, 0.5, "no plant to leave alone:\nthe loop ran on the model", ha="center", transform=alone.transAxes
        )
    alone.sharey(controlled)
    for u, colour in zip(loop.u[:, :, 0], colours, strict=True):
        given.step(loop.time_s, u, where="post", color=colour, lw=0.8)
    given.set(title="Input of the controlled runs", xlabel="Time (s)", ylabel=loop.input_label)
    for axes in (controlled, alone, given):
        axes.set_xlim(0, loop.rest_s(settling_band))
    return fig


def _colours(start: Float[np.ndarray, "N"]) -> list[tuple[float, ...]]:
    """From dark (lowest start) to light (highest), so that a line can be followed from panel to panel."""
    rank = start.argsort().argsort() / max(len(start) - 1, 1)
    return [mpl.colormaps[style.SEQUENCE](0.9 * value) for value in rank]


def _responses(
    axes: Axes, time_s: Float[np.ndarray, "T"], y: Float[np.ndarray, "N T"], colours: list[tuple[float, ...]]
) -> None:
    for response, colour in zip(y, colours, strict=True):
        axes.plot(time_s, response, color=colour, lw=0.9)


def _settled(axes: Axes, loop: ClosedLoop, band: float | None) -> None:
    if band is not None:
        axes.axhspan(loop.reference[-1, 0] - band, loop.reference[-1, 0] + band, color=style.PALE, lw=0, zorder=0)
