"""Controllers side by side: settling time relative to the uncontrolled plant, on a logarithmic
axis, peak input, and the share of starts settled where it is not the same for all (one dot per run,
a bar at the median of several). From the runs' own comparisons where they made one."""

from dataclasses import dataclass
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import choice_label, column_words, verdict_counts
from ssm_study.table.columns import numeric_column, text_column


@dataclass(frozen=True, kw_only=True)
class PeerPanel:
    """Panel of a figure that shows one number for each controller, with the settings of its
    axis."""

    values: pd.Series
    label: str
    scale: dict[str, Any]


def draw(study: StudyFolder) -> Figure:
    """Draw a panel for each number, with a row for each controller."""
    compared = "controller" in study.comparison
    if compared:
        table = study.comparison[text_column(study.comparison, "situation") == "nominal"]
    else:
        table = study.table
    method = text_column(table, "controller" if compared else "synthesis_method")
    panels = create_panels(table)
    measured = pd.concat([panel.values for panel in panels], axis=1).notna().any(axis=1)
    known = method.ne("") & measured
    if method[known].nunique() < 2:
        raise NothingToDraw(
            f"It takes two controllers in the closed loop ({verdict_counts(study.table)})."
        )
    methods = list(dict.fromkeys(method[known]))  # in the order of the table, which tells a story
    if panels[0].values[known].nunique() < 2:  # the share that settles is the same for all
        panels = panels[1:]
    fig = style.new_figure(style.PAGE_IN, 0.9 + 0.2 * len(methods))
    for axes, panel in zip(fig.subplots(1, len(panels), sharey=True), panels, strict=True):
        for row, name in enumerate(methods):
            draw_row(axes, row, panel.values[method == name].dropna())
        axes.set(xlabel=panel.label, ylim=(len(methods) - 0.5, -0.5), **panel.scale)
        if axes.get_xscale() == "log":
            label_decades(axes)
        axes.set_yticks(range(len(methods)), [choice_label(name) for name in methods])
        axes.grid(axis="y", visible=False)
    return fig


def create_panels(table: pd.DataFrame) -> list[PeerPanel]:
    """Panels of the figure: share settled, relative settling time and peak input of each
    controller."""
    ratio = numeric_column(table, "settling_time_mean_s") / numeric_column(
        table, "settling_time_open_loop_s"
    )
    ratio = ratio.where(ratio > 0)  # without: starts that were at rest
    logarithmic = {"xscale": "log"} if ratio.notna().any() else {}
    share = numeric_column(table, "stable_fraction")
    peak = numeric_column(table, "input_peak_v")
    return [
        PeerPanel(
            values=share, label=column_words("stable_fraction"), scale={"xlim": (-0.05, 1.05)}
        ),
        PeerPanel(values=ratio, label="Settling time / uncontrolled (–)", scale=logarithmic),
        PeerPanel(values=peak, label=column_words("input_peak_v"), scale={"xlim": (0, None)}),
    ]


def draw_row(axes: Axes, row: int, values: pd.Series) -> None:
    """Draw one dot for each run in a row, and a bar at the median if there are several. Many dots
    are faint, so that they can be seen through each other."""
    several = len(values) > 1
    look: dict[str, Any] = {"s": 16, "color": style.BLUE, "lw": 0, "zorder": 3, "clip_on": False}
    axes.scatter(values, [row] * len(values), alpha=0.5 if several else 1.0, **look)
    if several:
        bar: dict[str, Any] = {"color": style.VERMILLION, "lw": 1.6, "zorder": 4}
        axes.plot([values.median()] * 2, [row - 0.3, row + 0.3], **bar)


def label_decades(axes: Axes) -> None:
    """Label a logarithmic axis at 1, 2 and 5 of each decade. Minor labels such as 3 x 10^-1 would
    overlap with 0.5."""
    major = LogLocator(subs=(1.0, 2.0, 5.0))
    axes.xaxis.set(major_formatter="{x:g}", major_locator=major, minor_formatter=NullFormatter())
