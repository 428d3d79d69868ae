"""Does a better fit mean a better loop? One point per run: fit of the model on the test record against the share of
initial conditions that settle on the plant. The line joins the runs no other run beats in both."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.columns import column, words
from ssm_study.report.pareto import pareto_front
from ssm_study.report.study_folder import Study
from ssm_study.report.verdict import counts, scatter

X, Y = "fit_test_percent", "stable_fraction"


def draw(study: Study) -> Figure:
    return figure(study.table)


def figure(table: pd.DataFrame) -> Figure:
    x, y = column(table, X), column(table, Y)
    if not (x.notna() & y.notna()).any():
        return style.message(f"No run has both a fit and a closed loop.\n{counts(table)}")
    fig = style.canvas(style.COLUMN_IN, 2.5)
    axes = fig.add_subplot()
    scatter(axes, table, x, y)
    _front(axes, x, y)
    style.above(axes, columns=2)
    axes.set(xlabel=words(X), ylabel=words(Y), ylim=(-0.05, 1.05))
    return fig


def _front(axes: Axes, x: pd.Series, y: pd.Series) -> None:
    best = pareto_front(x.to_numpy(), y.to_numpy())
    line = pd.DataFrame({"x": x[best], "y": y[best]}).sort_values("x")
    axes.plot(line.x, line.y, color=style.INK, lw=0.8, ls="--", drawstyle="steps-pre", zorder=1)
    axes.plot(line.x, line.y, "o--", color=style.INK, lw=0, ms=7, mfc="none", mew=0.8, label="Pareto front")
