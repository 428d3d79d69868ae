"""Fit (or loss) on the training and validation records over the epochs, for the best run."""

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssm_study import style
from ssm_study.report.study_folder import StudyFolder
from ssm_study.table.columns import numeric_column


def draw(study: StudyFolder) -> Figure:
    """Draw the training curves of the best run over the epochs: the fits in percent, or else the
    losses. The fits are the columns `fit_`."""
    (curve,) = study.read_from_best("curve", otherwise="No run left a training curve.")
    fig = style.new_figure(style.COLUMN_IN, 2.3)
    axes = fig.add_subplot()
    fits = [name for name in map(str, curve) if name.startswith("fit_")]
    for name in fits or [name for name in map(str, curve) if "loss" in name]:
        y = numeric_column(curve, name)
        records = (
            name.removesuffix("_percent")
            .removeprefix("fit_")
            .removeprefix("loss_")
            .replace("_", " ")
        )
        axes.plot(numeric_column(curve, "epoch")[y.notna()], y.dropna(), label=f"{records} records")
    axes.set_yscale("linear" if fits else "log")
    axes.set(xlabel="Epoch", ylabel="Fit (%)" if fits else "Loss (scaled output units²)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.place_legend_above(axes)
    return fig
