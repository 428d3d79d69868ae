"""What the mismatch margin is worth, drawn: its ROC curve, and settling times against it.

Pure functions of a table with one certified design per row: `plant`, `mismatch_margin` (-), `kind` (`settled` if every
case of the design settled; anything else did not) and `relative_time` (mean settling time over that of the plant left
alone, missing where nothing settled). `benchmarks/loop_margin.py` writes such a table and draws it.
"""

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.columns import spoken

NEEDED = ("plant", "mismatch_margin", "kind", "relative_time")
SHOWN = (1e-3, 10.0)
"""Margins and relative times are drawn within these limits; what lies beyond is drawn at the edge."""


def roc_points(
    score: Float[np.ndarray, "N"], good: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """`(false, true)` shares accepted by `score >= threshold`, from the strictest threshold to the loosest.

    `good` holds 1 and 0; equal scores are one threshold, so the area below is Mann and Whitney's statistic.
    """
    order = np.argsort(-score, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)
    accepted = np.cumsum(good[order])[ends]
    rejected = np.cumsum(1 - good[order])[ends]
    return np.append(0.0, rejected / rejected[-1]), np.append(0.0, accepted / accepted[-1])


def roc(table: pd.DataFrame) -> Figure:
    """ROC of "all cases settle" per plant; the dot is the threshold at margin one."""
    fig = style.canvas(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot()
    for plant, own in table.groupby("plant"):
        good, score = own["kind"].eq("settled").to_numpy(float), own["mismatch_margin"].to_numpy(float)
        if good.min() == good.max():
            continue  # one kind only: no curve
        false, true = roc_points(score, good)
        (line,) = axes.plot(false, true, label=f"{spoken(plant)}, area {np.trapezoid(true, false):.3f}")
        above = score > 1
        axes.scatter((above * (1 - good)).sum() / (1 - good).sum(), (above * good).sum() / good.sum(), s=18, zorder=4)
        axes.collections[-1].set_color(line.get_color())
    axes.plot([0, 1], [0, 1], color=style.PALE, lw=0.8, zorder=1)
    axes.set(xlabel="Share of failing designs accepted (–)", ylabel="Share of settling designs accepted (–)")
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", title="dot: margin 1", title_fontsize=7)
    return fig


def settling(table: pd.DataFrame) -> Figure:
    """Settling time relative to the plant left alone against the margin, one panel per plant, one dot per design."""
    plants = list(dict.fromkeys(table["plant"]))
    fig = style.canvas(style.PAGE_IN, 2.5)
    for axes, plant in zip(np.atleast_1d(fig.subplots(1, len(plants), sharey=True)), plants, strict=True):
        _panel(axes, table[table["plant"] == plant])
        axes.set(title=spoken(plant), xlabel="Mismatch margin (–)")
    fig.axes[0].set_ylabel("Settling time / uncontrolled (–)")
    handles, labels = fig.axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2)
    return fig


def _panel(axes: Axes, own: pd.DataFrame) -> None:
    margin = own["mismatch_margin"].clip(*SHOWN)
    time = own["relative_time"].fillna(SHOWN[1]).clip(SHOWN[0], SHOWN[1])
    settled = own["kind"].eq("settled")
    for mask, colour, marker, label in (
        (settled, style.BLUE, "o", "all starts settle"),
        (~settled, style.VERMILLION, "x", "not all settle: mean over those that do, at the top if none"),
    ):
        width = 0.5 if marker == "x" else 0.0
        axes.scatter(margin[mask], time[mask], s=5, color=colour, marker=marker, alpha=0.45, lw=width, label=label)
    axes.axvline(1.0, color=style.INK, lw=0.8, ls="--")
    axes.set(xscale="log", yscale="log", xlim=(SHOWN[0], SHOWN[1] * 1.2), ylim=(0.08, SHOWN[1] * 1.2))
