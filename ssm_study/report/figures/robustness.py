"""How each controller bears what it was not designed for: share of starts settled (%), per controller and situation,
mean over the runs that compared them."""

import pandas as pd
import seaborn as sns
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.columns import column
from ssm_study.report.study_folder import Study


def draw(study: Study) -> Figure:
    return figure(study.comparison)


def figure(compared: pd.DataFrame) -> Figure:
    if "situation" not in compared or column(compared, "stable_fraction").isna().all():
        return style.message("No run compared controllers (experiment=robustness does).", style.PAGE_IN)
    rows = compared.assign(share=100 * column(compared, "stable_fraction"))
    shares = rows.pivot_table(index="controller", columns="situation", values="share", aggfunc="mean")
    shares = shares.reindex(index=rows["controller"].unique(), columns=rows["situation"].unique())
    shares = shares.rename(index=_spaced, columns=_spaced)
    fig = style.canvas(style.PAGE_IN, 0.9 + 0.22 * len(shares))
    axes = fig.add_subplot()
    axes.grid(False)
    bar = {"label": "Starts settled (%)"}
    sns.heatmap(shares, ax=axes, cmap="viridis", vmin=0, vmax=100, linewidths=0.8, annot=True, fmt=".0f", cbar_kws=bar)
    axes.set(xlabel="Situation", ylabel="Controller")
    axes.tick_params(axis="y", rotation=0)
    return fig


def _spaced(name: object) -> str:
    return str(name).replace("_", " ")
