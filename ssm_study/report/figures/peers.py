"""The ways to a controller beside each other: share of starts settled, settling time relative to the plant left alone,
and peak input (one dot per run, a bar at the median of several). From the runs' own comparisons where they made one."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.columns import column, spoken, text, words
from ssm_study.report.study_folder import Study
from ssm_study.report.verdict import counts


def draw(study: Study) -> Figure:
    compared = study.comparison
    if "controller" not in compared:
        return figure(study.table, text(study.table, "synthesis_method"))
    nominal = compared[text(compared, "situation") == "nominal"]
    return figure(nominal, text(nominal, "controller"))


def figure(table: pd.DataFrame, method: pd.Series) -> Figure:
    ratio = column(table, "settling_time_mean_s") / column(table, "settling_time_open_loop_s")
    panels = [
        (column(table, "stable_fraction"), words("stable_fraction"), (-0.05, 1.05)),
        (ratio, "Settling time / uncontrolled (–)", (0, None)),
        (column(table, "input_peak_v"), words("input_peak_v"), (0, None)),
    ]
    known = method.ne("") & pd.concat([values for values, _, _ in panels], axis=1).notna().any(axis=1)
    if not known.any():
        return style.message(f"No run reached the closed loop.\n{counts(table)}", style.PAGE_IN)
    methods = list(dict.fromkeys(method[known]))  # in the order of the table, which tells a story
    fig = style.canvas(style.PAGE_IN, 0.9 + 0.2 * len(methods))
    for axes, (values, label, limits) in zip(fig.subplots(1, 3, sharey=True), panels, strict=True):
        _dots(axes, method, values, methods)
        axes.set(xlabel=label, xlim=limits, ylim=(len(methods) - 0.5, -0.5))
        axes.set_yticks(range(len(methods)), [spoken(name) for name in methods])
        axes.grid(axis="y", visible=False)
    return fig


def _dots(axes: Axes, method: pd.Series, values: pd.Series, methods: list[str]) -> None:
    for row, name in enumerate(methods):
        own = values[method == name].dropna()
        faint = 0.5 if len(own) > 1 else 1.0
        axes.scatter(own, [row] * len(own), s=16, color=style.BLUE, alpha=faint, lw=0, zorder=3, clip_on=False)
        if len(own) > 1:
            axes.plot([own.median()] * 2, [row - 0.3, row + 0.3], color=style.VERMILLION, lw=1.6, zorder=4)
