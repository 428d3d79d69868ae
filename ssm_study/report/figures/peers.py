"""Controllers side by side: settling time relative to the uncontrolled plant, and peak input. There
is one dot for each run, and a bar at the median of several. The share of starts that settle is
drawn where controllers differ in it. The axis of settling time is logarithmic. The numbers come
from the runs' own comparisons where they made one."""

from dataclasses import dataclass, replace
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import PlantUnits, choice_label, printed_column_name, verdict_counts
from ssm_study.table.columns import numeric_column, text_column

NO_UNITS = PlantUnits()
DOT: dict[str, Any] = {"s": 16, "color": style.BLUE, "lw": 0, "zorder": 3, "clip_on": False}
BAR: dict[str, Any] = {"color": style.VERMILLION, "lw": 1.6, "zorder": 4}


@dataclass(frozen=True, kw_only=True)
class ControllerPanel:
    """Panel of a figure that shows one result of each compared controller, with the settings of its
    axis."""

    values: pd.Series
    label: str
    scale: dict[str, Any]


def draw(study: StudyFolder) -> Figure:
    """Draw the comparison of a study's controllers: a panel for each result, a row for each
    controller."""
    compared = "controller" in study.controller_comparison
    if compared:
        situation = text_column(study.controller_comparison, "situation")
        table = study.controller_comparison[situation == "nominal"]
        method = text_column(table, "controller")
    else:
        table = study.table
        method = text_column(table, "synthesis_method")
    panels = create_controller_panels(table, study.units)
    numbers = pd.concat([panel.values for panel in panels], axis=1)
    is_measured = numbers.notna().any(axis=1)
    has_value = method.ne("") & is_measured
    if method[has_value].nunique() < 2:
        counts = verdict_counts(study.table)
        raise NothingToDraw(f"It takes two controllers in the closed loop ({counts}).")
    methods = list(
        dict.fromkeys(method[has_value])
    )  # in the order of the table, which tells a story
    if panels[0].values[has_value].nunique() < 2:  # the share that settles is the same for all
        panels = panels[1:]
    rows = len(methods)
    labels = list(map(choice_label, methods))
    fig = style.new_figure(style.PAGE_IN, 0.9 + 0.2 * rows)
    places = fig.subplots(1, len(panels), sharey=True)
    for axes, panel in zip(places, panels, strict=True):
        for row, name in enumerate(methods):
            values = panel.values[method == name]
            draw_controller_row(axes, row, values.dropna())
        axes.set(xlabel=panel.label, ylim=(rows - 0.5, -0.5), **panel.scale)
        if axes.get_xscale() == "log":
            label_decades(axes)
        axes.set_yticks(range(rows), labels)
        axes.grid(axis="y", visible=False)
    return fig


def create_controller_panels(
    table: pd.DataFrame, units: PlantUnits = NO_UNITS
) -> list[ControllerPanel]:
    """Panels of a figure that compares controllers: fraction of settled loops, relative settling
    time, peak input."""
    share = create_controller_panel(table, "stable_fraction", (-0.05, 1.05))
    peak = create_controller_panel(table, "input_peak_v", (0.0, None))
    time_s = numeric_column(table, "settling_time_mean_s")
    open_loop_s = numeric_column(table, "settling_time_open_loop_s")
    ratio = time_s / open_loop_s
    ratio = ratio.where(ratio > 0)  # without: starts that were at rest
    logarithmic = {"xscale": "log"} if ratio.notna().any() else {}
    label = "Settling time / uncontrolled (–)"
    relative_time = ControllerPanel(values=ratio, label=label, scale=logarithmic)
    peak = replace(peak, label=units.replace_words_by_units(peak.label))
    return [share, relative_time, peak]


def create_controller_panel(
    table: pd.DataFrame, name: str, limits: tuple[float, float | None]
) -> ControllerPanel:
    """Panel of a figure that compares controllers by one column of the comparison table."""
    values = numeric_column(table, name)
    label = printed_column_name(name)
    return ControllerPanel(values=values, label=label, scale={"xlim": limits})


def draw_controller_row(axes: Axes, row: int, values: pd.Series) -> None:
    """Draw the results of one controller in a row: a dot for each run, and a bar at the median if
    there are several. Many dots are faint, so that they can be seen through each other."""
    several = len(values) > 1
    opacity = 0.5 if several else 1.0
    heights = [row] * len(values)
    axes.scatter(values, heights, alpha=opacity, **DOT)
    if several:
        median = values.median()
        axes.plot([median, median], [row - 0.3, row + 0.3], **BAR)


def label_decades(axes: Axes) -> None:
    """Label a logarithmic axis at 1, 2 and 5 of each power of ten. Minor labels such as 3 x 10^-1
    would overlap with 0.5."""
    major = LogLocator(subs=(1.0, 2.0, 5.0))
    axes.xaxis.set(major_formatter="{x:g}", major_locator=major, minor_formatter=NullFormatter())
