"""Closed loop from every initial condition (left), the same starts without control (middle), and
the input that the controller applied (right): on the true plant, or on the identified model where
there is none. A response has settled when it stays in the grey band."""

import matplotlib as mpl
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the closed loop's outputs, the uncontrolled plant's outputs and the inputs, for every
    initial condition."""
    (loop,) = study.read_from_best("closed_loop", otherwise="No run reached the closed loop.")
    if style.is_narrow():
        fig = style.new_figure(style.COLUMN_IN, 4.6)
        controlled, alone, given = fig.subplots(3, 1)
    else:
        fig = style.new_figure(style.PAGE_IN, 2.2)
        controlled, alone, given = fig.subplots(1, 3)
    rank = (
        loop["output"][:, 0, 0].argsort().argsort()
    )  # from dark (lowest start) to light, the same in every panel
    colours = [mpl.colormaps[style.SEQUENCE](0.9 * value / max(len(rank) - 1, 1)) for value in rank]
    goal = loop["reference"][0, -1, 0]
    band = loop.settling_band
    time_s = loop.time_s("output")
    for axes, name, title in (
        (controlled, "output", "Controlled"),
        (alone, "uncontrolled", "Uncontrolled"),
    ):
        for response, colour in zip(loop[name][:, :, 0], colours, strict=True):
            axes.plot(time_s, response, color=colour, lw=0.9)
        axes.axhspan(goal - band, goal + band, color=style.PALE, lw=0, zorder=0)
        axes.set(title=title, xlabel="Time (s)", ylabel=loop.label("output"))
    alone.sharey(controlled)
    for u, colour in zip(loop["input"][:, :, 0], colours, strict=True):
        given.step(time_s, u, where="post", color=colour, lw=0.8)
    given.set(title="Input of the controlled runs", xlabel="Time (s)", ylabel=loop.label("input"))
    for axes in (controlled, alone, given):
        axes.set_xlim(0, loop.settled_time_s)
    return fig
