"""Mean settling time (s) of each controller in situations that it was not designed for. The colour
is its ratio to the uncontrolled plant in the nominal situation: the palest is as slow as no
control, or slower. Orange with a share means that only this share of the starts settles. Each
number is the mean over the runs that compared the controllers."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ssm_study import style
from ssm_study.report.study_folder import NothingToDraw, StudyFolder
from ssm_study.report.words import choice_label
from ssm_study.table.columns import numeric_column

DARK = 0.45  # ratio below which a cell is so dark that its number is white
FASTEST = 0.2  # ratio at the dark end of the colours
TICKS = (0.2, 0.3, 0.5, 0.7, 1.0)
NOT_COMPARED = "No run compared controllers in several situations (experiment=robustness does)."
CENTRED: dict[str, Any] = {"ha": "center", "va": "center", "size": 6.5}
WHOLE = 1 - 1e-9  # share of starts above which all of them settle


def draw(study: StudyFolder) -> Figure:
    """Draw the settling time of every compared controller (rows) under every test condition
    (columns)."""
    compared = study.controller_comparison
    several = "situation" in compared and compared["situation"].nunique() > 1
    if not several or numeric_column(compared, "stable_fraction").isna().all():
        raise NothingToDraw(NOT_COMPARED)
    shares = _settling_time_table(compared, "stable_fraction")
    times = _settling_time_table(compared, "settling_time_mean_s")
    open_loop_s = numeric_column(compared, "settling_time_open_loop_s").dropna()
    ratios = times / float(open_loop_s.iloc[0])
    ratios = ratios.where(shares > WHOLE)
    fig = style.new_figure(style.PAGE_IN, 1.1 + 0.3 * len(shares))
    axes = fig.add_subplot()
    _draw_colours(fig, axes, ratios)
    _write_cells(axes, ratios.to_numpy(), times.to_numpy(), shares.to_numpy())
    axes.set_xticks(range(len(shares.columns)), shares.columns, rotation=35, ha="right")
    axes.set_yticks(range(len(shares)), shares.index)
    axes.set(xlabel="Situation", ylabel="Controller")
    return fig


def _draw_colours(fig: Figure, axes: Axes, ratios: pd.DataFrame) -> None:
    """Colour each cell of the grid of controllers and test conditions by relative settling time,
    and add a colour bar."""
    axes.grid(False)
    axes.set_facecolor(style.PALE)
    norm = LogNorm(vmin=FASTEST, vmax=1.0, clip=True)
    image = axes.imshow(ratios.to_numpy(), cmap="Blues_r", norm=norm, aspect="auto")
    bar = fig.colorbar(image, ax=axes, label="Settling time / uncontrolled (–)", extend="both")
    labels = [f"{tick:g}" for tick in TICKS]
    bar.set_ticks(list(TICKS), labels=labels)
    bar.minorticks_off()


def _write_cells(
    axes: Axes,
    ratios: Float[np.ndarray, "R C"],
    times: Float[np.ndarray, "R C"],
    shares: Float[np.ndarray, "R C"],
) -> None:
    """Write into each cell of the grid the settling time in seconds or, where not all loops settle,
    the fraction that does. The latter cells are red."""
    for (i, j), share in np.ndenumerate(shares):
        if np.isnan(share):
            continue
        colour = "white"
        if share > WHOLE:
            text = f"{times[i, j]:.2g}"
            if not ratios[i, j] < DARK:  # also where there is no ratio
                colour = style.INK
        else:
            text = f"{100 * share:.0f} %"
            corner = (j - 0.5, i - 0.5)
            axes.add_patch(Rectangle(corner, 1, 1, color=style.VERMILLION, lw=0))
        axes.text(j, i, text, color=colour, **CENTRED)


def _settling_time_table(compared: pd.DataFrame, name: str) -> pd.DataFrame:
    """Table of settling times with a row for each controller and a column for each test
    condition."""
    rows = compared.assign(value=numeric_column(compared, name))
    means = rows.pivot_table(
        index="controller", columns="situation", values="value", aggfunc="mean", dropna=False
    )
    controllers = rows["controller"].unique()
    situations = rows["situation"].unique()
    means = means.reindex(index=controllers, columns=situations)
    return means.rename(index=choice_label, columns=choice_label)
