"""Free runs of the identified model on the test record (top) and on the validation record. Dots are
measured, lines are the model. Below the test record stands its error. Below the validation record
stand its input and a disturbance, if one was measured."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import RecordedCases, StudyFolder

Stretch = Float[np.ndarray, "T"]
LONGEST = 1200  # samples; a longer record would be a solid block of ink in a column


def draw(study: StudyFolder) -> Figure:
    """Draw measured outputs and free-run simulation on the test record and on the validation record
    of the best run."""
    reason = "No run left a validation record."
    test, validation, record = study.read_from_best(
        "test", "validation", "record", otherwise=reason
    )
    cases = validation.cases.values()
    has_disturbance = all("disturbance" in case for case in cases)
    heights = [1.6, 0.8, 1.6, 1.1]
    height_inches = 5.0
    if has_disturbance:
        heights.append(1.1)
        height_inches = 6.0
    fig = style.new_figure(style.COLUMN_IN, height_inches)
    panels = fig.subplots(len(heights), 1, height_ratios=heights)
    free_run, error, other_run, applied = panels[:4]
    draw_free_run(free_run, test, "test", record.get("fit_test_percent"))
    draw_error(error, test)
    draw_free_run(other_run, validation, "validation", record.get("fit_validation_percent"))
    time_s = validation.time_s("measured")[:LONGEST]
    u = first_channel_samples(validation, "input")
    applied.step(time_s, u, where="post", color=style.INK, lw=0.7)
    label_axes(applied, time_s, validation.label("input"))
    if has_disturbance:
        measured = first_channel_samples(validation, "disturbance")
        panels[4].plot(time_s, measured, color=style.GREEN, lw=0.7)
        label_axes(panels[4], time_s, validation.label("disturbance"))
    fig.align_ylabels()
    return fig


def first_channel_samples(part: RecordedCases, name: str) -> Stretch:
    """Values at the beginning of the first channel of a recorded signal."""
    signal: Stretch = part[name][0, :LONGEST, 0]
    return signal


def label_axes(axes: Axes, time_s: Stretch, label: str) -> None:
    """Label the axes of a panel with the time and the signal's name and unit."""
    axes.set(xlabel="Time (s)", ylabel=label)
    axes.set_xlim(time_s[0], time_s[-1])


def draw_free_run(axes: Axes, part: RecordedCases, name: str, fit: float | None) -> None:
    """Draw the measured output as dots, with the model's free-run simulation on top."""
    time_s = part.time_s("measured")[:LONGEST]
    label = "model" if fit is None else f"model (fit {fit:.1f} % on the whole record)"
    measured = first_channel_samples(part, "measured")
    axes.plot(time_s, measured, ".", ms=1.5, color=style.GREY, label=f"{name} record")
    simulated = first_channel_samples(part, "simulated")
    axes.plot(time_s, simulated, color=style.BLUE, lw=1.0, label=label)
    style.place_legend_above(axes, columns=2)
    label_axes(axes, time_s, part.label("measured"))


def draw_error(axes: Axes, part: RecordedCases) -> None:
    """Draw the measured output minus the simulated output, in the output's unit."""
    time_s = part.time_s("measured")[:LONGEST]
    error = first_channel_samples(part, "measured") - first_channel_samples(part, "simulated")
    axes.axhline(0, color=style.PALE)
    axes.plot(time_s, error, color=style.VERMILLION, lw=0.7)
    unit = part.unit("measured")
    label_axes(axes, time_s, f"Error ({unit})" if unit else "Error")
