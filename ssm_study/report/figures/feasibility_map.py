"""Where certificates exist: every run at its slope ratio and controller rate, with the exact
frontier of each model. Below its model's bar a rate can be certified; above it none can, whatever
the solver."""

import pandas as pd
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import counts, words
from ssm_study.table.columns import column, flag

RATE = "rate_controller"
LIMIT = "controller_rate_limit"


def draw(study: StudyFolder) -> Figure:
    table = study.table
    ratio = column(table, "input_slope_lower") / column(table, "input_slope_upper")
    rate = column(table, RATE)
    known = ratio.notna() & rate.notna()
    if known.sum() < 2:
        raise NothingToDraw(f"It takes two runs with slopes and a rate ({counts(table)}).")
    fig = style.canvas(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot(xscale="log" if ratio.max() > 20 * ratio[ratio > 0].min() else "linear")
    certified = flag(table, "controller_certified")
    feasible = flag(table, "controller_feasible")
    for here, label, colour, marker in (
        (certified, "certified", style.BLUE, "o"),
        (feasible & ~certified, "found, not certified", style.ORANGE, "s"),
        (~feasible & ~certified, "no certificate", style.VERMILLION, "x"),
    ):
        if (here & known).any():
            axes.scatter(
                ratio[here],
                rate[here],
                c=colour,
                marker=marker,
                s=16,
                lw=0.9,
                label=label,
                zorder=3,
            )
    # One bar per model, its own exact rate limit: models differ in A, so there is no single curve.
    models = (
        pd.DataFrame({"ratio": ratio, "limit": column(table, LIMIT)}).dropna().drop_duplicates()
    )
    if len(models):
        axes.scatter(
            models.ratio,
            models.limit,
            c=style.INK,
            marker="_",
            s=90,
            lw=0.8,
            label="exact frontier",
            zorder=4,
        )
        axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(models.limit.max())))
    style.above(axes, columns=2)
    axes.set(xlabel="Certified slope ratio of S$_u$, smallest / largest (–)", ylabel=words(RATE))
    return fig
