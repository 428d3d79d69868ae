"""Where certificates exist: every run at its slope ratio and controller rate. The bar is the exact
limit of a model. Below it a rate can be certified; above it none can, whatever the solver."""

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import printed_column_name, verdict_counts
from ssm_study.table.columns import boolean_column, numeric_column

RATE = "rate_controller"
LIMIT = "controller_rate_limit"


def draw(study: StudyFolder) -> Figure:
    """Draw each run's verdict over slope ratio and contraction rate, with a bar at the largest rate
    that can be certified for the model."""
    table = study.table
    ratio = numeric_column(table, "input_slope_lower") / numeric_column(table, "input_slope_upper")
    rate = numeric_column(table, RATE)
    has_both = ratio.notna() & rate.notna()
    if has_both.sum() < 2:
        raise NothingToDraw(f"It takes two runs with slopes and a rate ({verdict_counts(table)}).")
    spreads_far = ratio.max() > 20 * ratio[ratio > 0].min()
    fig = style.new_figure(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot(xscale="log" if spreads_far else "linear")
    certified = boolean_column(table, "controller_certified")
    feasible = boolean_column(table, "controller_feasible")
    groups = (
        (certified, "certified", style.BLUE, "o"),
        (feasible & ~certified, "found, not certified", style.ORANGE, "s"),
        (~feasible & ~certified, "no certificate", style.VERMILLION, "x"),
    )
    for here, label, colour, marker in groups:
        if (here & has_both).any():
            look: dict[str, Any] = {"c": colour, "marker": marker, "s": 16, "lw": 0.9, "zorder": 3}
            axes.scatter(ratio[here], rate[here], label=label, **look)
    draw_certifiable_rates(axes, ratio, numeric_column(table, LIMIT))
    style.place_legend_above(axes, columns=2)
    axes.set_xlabel("Certified slope ratio of S$_u$, smallest / largest (–)")
    axes.set_ylabel(printed_column_name(RATE))
    return fig


def draw_certifiable_rates(axes: Axes, ratio: pd.Series, limit: pd.Series) -> None:
    """Draw, for each model of a study, a bar at the largest contraction rate that can be certified.
    There is no single curve, since models differ in A."""
    models = pd.DataFrame({"ratio": ratio, "limit": limit}).dropna().drop_duplicates()
    if not len(models):
        return
    look: dict[str, Any] = {"c": style.INK, "marker": "_", "s": 90, "lw": 0.8, "zorder": 4}
    axes.scatter(models["ratio"], models["limit"], label="exact frontier", **look)
    highest = 1.05 * float(models["limit"].max())
    axes.set_ylim(0, max(axes.get_ylim()[1], highest))
