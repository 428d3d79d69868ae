"""What a faster certified rate buys and costs: mean settling time on the plant, and norm of the state feedback gain,
against the controller rate asked."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from ssm_study.report import style
from ssm_study.report.columns import column, text, words
from ssm_study.report.study_folder import Study
from ssm_study.report.verdict import counts, scatter

RATE, TIME, GAIN, ALONE = "rate_controller", "settling_time_mean_s", "controller_gain_norm", "settling_time_open_loop_s"


def draw(study: Study) -> Figure:
    return figure(study.table)


def figure(table: pd.DataFrame) -> Figure:
    rate = column(table, RATE)
    if not (rate.notna() & (column(table, TIME).notna() | column(table, GAIN).notna())).any():
        return style.message(f"No run has a rate with a gain or a settling time.\n{counts(table)}")
    fig = style.canvas(style.COLUMN_IN, 3.4)
    time, gain = fig.subplots(2, 1, sharex=True)
    for axes, name in ((time, TIME), (gain, GAIN)):
        _medians(axes, table, rate, column(table, name))
        scatter(axes, table, rate, column(table, name), dodge=0.012 * float(rate.max() - rate.min()))
        axes.set_ylabel(words(name))
    if column(table, ALONE).notna().any():
        time.axhline(column(table, ALONE).median(), color=style.GREY, lw=0.9, ls=":", label="uncontrolled")
    style.above(time, columns=2, others=(gain,))
    time.set_ylim(bottom=0)
    if (column(table, GAIN) > 0).any():
        gain.set_yscale("log")
        gain.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=12))
        gain.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        gain.yaxis.set_minor_formatter(NullFormatter())
    gain.set_xlabel(words(RATE))
    return fig


def _medians(axes: Axes, table: pd.DataFrame, rate: pd.Series, y: pd.Series) -> None:
    """The median over the runs of one synthesis method and rate: the eye's guide through the points."""
    frame = pd.DataFrame({"method": text(table, "synthesis_method"), "rate": rate, "y": y}).dropna()
    for _, runs in frame.groupby("method"):
        median = runs.groupby("rate").y.median()
        axes.plot(median.index, median, color=style.PALE, lw=2.5, zorder=1)
