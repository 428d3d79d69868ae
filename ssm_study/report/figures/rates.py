"""What a faster certified rate buys and costs: mean settling time as a share of the uncontrolled
one, and norm of the
state feedback gain, against the controller rate. The grey line joins the medians of the runs at
each requested rate."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from ssm_study.report import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import counts, scatter, words
from ssm_study.table.columns import column, requested, text


def draw(study: StudyFolder) -> Figure:
    table, names = study.table, ("rate_controller", "settling_time_mean_s", "controller_gain_norm")
    rate, time_s, norm = (column(table, name) for name in names)
    if rate[time_s.notna() | norm.notna()].nunique() < 2:
        raise NothingToDraw(
            f"It takes runs at two rates, with a gain or a settling time ({counts(table)})."
        )
    fig = style.canvas(style.COLUMN_IN, 3.4)
    time, gain = fig.subplots(2, 1, sharex=True)
    relative = time_s / column(table, "settling_time_open_loop_s")
    shown = relative if relative.notna().any() else time_s
    for axes, values in ((time, shown), (gain, norm)):
        _medians(axes, table, rate, values)
        scatter(axes, table, rate, values, dodge=0.012 * float(rate.max() - rate.min()))
    time.set_ylabel(words(time_s.name))
    if shown is relative:
        time.axhline(1.0, color=style.GREY, lw=0.9, ls=":", label="uncontrolled")
        time.set_ylabel("Mean settling time\n/ uncontrolled (–)")
    style.above(time, columns=2, others=(gain,))
    time.set_ylim(bottom=0)
    for axes, wide in ((time, shown.max() > 10 * shown.median()), (gain, (norm > 0).any())):
        if wide:  # a few slow runs would press the others to the axis
            axes.set(yscale="log")
            axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5), numticks=12))
            axes.yaxis.set(
                major_formatter=FormatStrFormatter("%g"), minor_formatter=NullFormatter()
            )
    gain.set(xlabel=words(rate.name), ylabel=words(norm.name))
    fig.align_ylabels()
    return fig


def _medians(axes: Axes, table: pd.DataFrame, rate: pd.Series, y: pd.Series) -> None:
    """The median over the runs of one synthesis method and requested rate; one that `auto` chose is
    its run's alone."""
    frame = pd.DataFrame({"method": text(table, "synthesis_method"), "rate": rate, "y": y})
    for _, runs in frame[requested(table, str(rate.name)) != "auto"].dropna().groupby("method"):
        median = runs.groupby("rate").y.median()
        axes.plot(median.index, median, color=style.PALE, lw=2.5, zorder=1)
