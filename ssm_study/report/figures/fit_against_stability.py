"""Does a better fit mean a better loop? One point per run: fit of the model on the test record
against the mean
settling time, as a share of the uncontrolled one. Runs that do not settle from every start stand at
the top."""

from typing import Any

from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import counts, scatter, words
from ssm_study.table.columns import column

TOP = 1.6  # of the slowest that settles: where runs stand that do not settle


def draw(study: StudyFolder) -> Figure:
    table = study.table
    fit, share = column(table, "fit_test_percent"), column(table, "stable_fraction")
    time = column(table, "settling_time_mean_s") / column(table, "settling_time_open_loop_s")
    settled, lost = fit.notna() & (share >= 1) & time.notna(), fit.notna() & (share < 1)
    if fit[settled | lost].round(1).nunique() < 2:
        raise NothingToDraw(
            f"It takes two models with a closed loop whose fits differ by 0.1 % ({counts(table)})."
        )
    fig = style.canvas(style.COLUMN_IN, 2.5)
    axes = fig.add_subplot()
    top = (TOP if lost.any() else 1.0) * float(time[settled].max()) if settled.any() else 1.0
    scatter(axes, table, fit, time.where(settled, top).where(settled | lost))
    if lost.any():
        axes.axhline(top, color=style.PALE, lw=6, zorder=0)
        place: dict[str, Any] = {
            "xycoords": ("axes fraction", "data"),
            "ha": "right",
            "va": "center",
            "size": 6,
        }
        axes.annotate("does not settle", (0.99, top), **place)
    axes.set(
        xlabel=words(fit.name), ylabel="Mean settling time / uncontrolled (–)", ylim=(0, 1.1 * top)
    )
    style.above(axes, columns=2)
    return fig
