"""How training went: loss on the training and validation records against wall-clock time or epoch, best run."""

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssm_study.report import style
from ssm_study.report.columns import column
from ssm_study.report.study_folder import Study


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or not run.curve:
        return style.message("No run left a training curve.")
    return figure(pd.DataFrame(run.curve))


def figure(curve: pd.DataFrame) -> Figure:
    """`curve` has a row per epoch: `epoch` and any number of columns that start with `fit_` (%) or `loss`."""
    fig = style.canvas(style.COLUMN_IN, 2.3)
    axes = fig.add_subplot()
    fits = [name for name in curve if str(name).startswith("fit_")]
    shown = fits or [name for name in curve if "loss" in str(name)]
    x = column(curve, "epoch") if "epoch" in curve else pd.Series(range(len(curve)), index=curve.index)
    for name in shown:
        y = column(curve, str(name))
        axes.plot(x[y.notna()], y.dropna(), label=_spoken(str(name)))
    if not fits:
        axes.set_yscale("log")
    axes.set(xlabel="Epoch", ylabel="Fit (%)" if fits else "Loss (scaled output units²)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.above(axes)
    return fig


def _spoken(name: str) -> str:
    """`fit_validation_percent` -> `validation records`."""
    return f"{name.removesuffix('_percent').removeprefix('fit_').removeprefix('loss_')} records".replace("_", " ")
