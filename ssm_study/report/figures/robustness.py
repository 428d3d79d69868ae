"""How each controller copes with what it was not designed for: share of starts settled (%) as
colour and number, and below it the mean settling time (s) of those that do; per controller and
situation, mean over the runs that compared them."""

import pandas as pd
import seaborn as sns
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import spoken
from ssm_study.table.columns import column


def draw(study: StudyFolder) -> Figure:
    compared = study.comparison
    several = "situation" in compared and compared["situation"].nunique() > 1
    if not several or column(compared, "stable_fraction").isna().all():
        raise NothingToDraw(
            "No run compared controllers in several situations (experiment=robustness does)."
        )
    shares = 100 * _table(compared, "stable_fraction")
    times = _table(compared, "settling_time_mean_s")
    said = shares.map("{:.0f} %".format) + times.map(
        lambda time: "" if pd.isna(time) else f"\n{time:.2g} s"
    )
    fig = style.canvas(style.PAGE_IN, 0.9 + 0.32 * len(shares))
    axes = fig.add_subplot()
    axes.grid(False)
    look = {
        "cmap": "viridis",
        "vmin": 0,
        "vmax": 100,
        "linewidths": 0.8,
        "cbar_kws": {"label": "Starts settled (%)"},
    }
    sns.heatmap(shares, ax=axes, annot=said, fmt="", annot_kws={"size": 6.5}, **look)
    axes.set(xlabel="Situation", ylabel="Controller")
    axes.tick_params(axis="y", rotation=0)
    return fig


def _table(compared: pd.DataFrame, name: str) -> pd.DataFrame:
    """Controllers down, situations across, in the order in which they were compared."""
    rows = compared.assign(value=column(compared, name))
    means = rows.pivot_table(
        index="controller", columns="situation", values="value", aggfunc="mean", dropna=False
    )
    means = means.reindex(index=rows["controller"].unique(), columns=rows["situation"].unique())
    return means.rename(index=spoken, columns=spoken)
