"""Where certificates exist: every run at its slope ratio and controller rate, with the exact frontier of each model.
Below its model's bar a rate can be certified; above it none can, whatever the solver."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.columns import column, flag, words
from ssm_study.report.study_folder import Study
from ssm_study.report.verdict import counts

RATE, LIMIT = "rate_controller", "controller_rate_limit"


def draw(study: Study) -> Figure:
    return figure(study.table)


def figure(table: pd.DataFrame) -> Figure:
    ratio = column(table, "input_slope_lower") / column(table, "input_slope_upper")
    rate = column(table, RATE)
    if not (ratio.notna() & rate.notna()).any():
        return style.message(f"No run has both slopes and a rate.\n{counts(table)}")
    fig = style.canvas(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot()
    if ratio.max() > 20 * ratio[ratio > 0].min():
        axes.set_xscale("log")
    _runs(axes, table, ratio, rate)
    _frontier(axes, ratio, column(table, LIMIT))
    style.above(axes, columns=2)
    axes.set(xlabel="Certified slope ratio of S$_u$, smallest / largest (–)", ylabel=words(RATE))
    return fig


def _runs(axes: Axes, table: pd.DataFrame, ratio: pd.Series, rate: pd.Series) -> None:
    certified, feasible = flag(table, "controller_certified"), flag(table, "controller_feasible")
    groups = [
        (certified, "certified", style.BLUE, "o"),
        (feasible & ~certified, "found, not certified", style.ORANGE, "s"),
        (~feasible & ~certified, "no certificate", style.VERMILLION, "x"),
    ]
    for here, label, colour, marker in groups:
        if (here & ratio.notna() & rate.notna()).any():
            axes.scatter(ratio[here], rate[here], c=colour, marker=marker, s=16, lw=0.9, label=label, zorder=3)


def _frontier(axes: Axes, ratio: pd.Series, limit: pd.Series) -> None:
    """One bar per model: its own exact rate limit (models differ in A, so there is no single curve)."""
    models = pd.DataFrame({"ratio": ratio, "limit": limit}).dropna().drop_duplicates().sort_values("ratio")
    if models.empty:
        return
    bar = axes.scatter(models.ratio, models.limit, marker="_", s=90, color=style.INK, lw=0.8, zorder=4)
    bar.set_label("exact frontier")
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(models.limit.max())))
