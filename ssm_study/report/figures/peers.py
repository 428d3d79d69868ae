"""Controllers side by side: settling time relative to the plant left alone, on a logarithmic axis,
peak input, and the share of starts settled where it is not the same for all (one dot per run, a bar
at the median of several). From the runs' own comparisons where they made one."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import counts, spoken, words
from ssm_study.table.columns import column, text


def draw(study: StudyFolder) -> Figure:
    compared = "controller" in study.comparison
    table = (
        study.comparison[text(study.comparison, "situation") == "nominal"]
        if compared
        else study.table
    )
    method = text(table, "controller" if compared else "synthesis_method")
    ratio = column(table, "settling_time_mean_s") / column(table, "settling_time_open_loop_s")
    ratio = ratio.where(ratio > 0)  # without: starts that were at rest
    panels: list[tuple[pd.Series, str, dict[str, Any]]] = [
        (column(table, "stable_fraction"), words("stable_fraction"), {"xlim": (-0.05, 1.05)}),
        (
            ratio,
            "Settling time / uncontrolled (–)",
            {"xscale": "log"} if ratio.notna().any() else {},
        ),
        (column(table, "input_peak_v"), words("input_peak_v"), {"xlim": (0, None)}),
    ]
    known = method.ne("") & pd.concat([values for values, _, _ in panels], axis=1).notna().any(
        axis=1
    )
    if method[known].nunique() < 2:
        raise NothingToDraw(f"It takes two controllers in the closed loop ({counts(study.table)}).")
    methods = list(dict.fromkeys(method[known]))  # in the order of the table, which tells a story
    panels = panels[panels[0][0][known].nunique() < 2 :]
    fig = style.canvas(style.PAGE_IN, 0.9 + 0.2 * len(methods))
    for axes, (values, label, scale) in zip(
        fig.subplots(1, len(panels), sharey=True), panels, strict=True
    ):
        for row, name in enumerate(methods):
            own = values[method == name].dropna()
            faint = 0.5 if len(own) > 1 else 1.0  # so that dots on one another are seen
            axes.scatter(
                own,
                [row] * len(own),
                s=16,
                color=style.BLUE,
                alpha=faint,
                lw=0,
                zorder=3,
                clip_on=False,
            )
            if len(own) > 1:
                axes.plot(
                    [own.median()] * 2,
                    [row - 0.3, row + 0.3],
                    color=style.VERMILLION,
                    lw=1.6,
                    zorder=4,
                )
        axes.set(xlabel=label, ylim=(len(methods) - 0.5, -0.5), **scale)
        if axes.get_xscale() == "log":
            ticks = {
                "major_locator": LogLocator(subs=(1.0, 2.0, 5.0)),
                "minor_formatter": NullFormatter(),
            }
            axes.xaxis.set(
                major_formatter="{x:g}", **ticks
            )  # without minor ones: 3 x 10^-1 would stand beside 0.5
        axes.set_yticks(range(len(methods)), [spoken(name) for name in methods])
        axes.grid(axis="y", visible=False)
    return fig
