"""What the prediction of `robustness.prediction` is worth, drawn: its ROC curve, and settling times
against the margin.

Pure functions of a table with one certified design per row: `plant`, `mismatch_margin`,
`resolved_margin`, `controller_radius` and `noise_peak` (all -), `kind` (`settled` if every case of
the design settled; anything else did not) and `relative_time` (mean settling time over that of the
plant left alone, missing where nothing settled). `benchmarks/loop_margin.py` writes such a table
and draws it.
"""

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.words import choice_label

NEEDED = (
    "plant",
    "mismatch_margin",
    "resolved_margin",
    "controller_radius",
    "noise_peak",
    "kind",
    "relative_time",
)
SHOWN = (1e-3, 10.0)
"""Margins and relative times are drawn within these limits; what lies beyond is drawn at the
edge."""


def roc_points(
    score: Float[np.ndarray, "N"], good: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """`(false, true)` shares accepted by `score >= threshold`, from the strictest threshold to the
    loosest.

    `good` holds 1 and 0; equal scores are one threshold, so the area below is Mann and Whitney's
    statistic.
    """
    order = np.argsort(-score, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)
    accepted = np.cumsum(good[order])[ends]
    rejected = np.cumsum(1 - good[order])[ends]
    return np.append(0.0, rejected / rejected[-1]), np.append(0.0, accepted / accepted[-1])


def prediction_score(table: pd.DataFrame) -> Float[np.ndarray, "N"]:
    """In (0, 1): the share `m / (1 + m)` of the resolved margin m; less one where another condition
    refuses the design.

    That is, where the controller is unstable by itself or the noise leaves the band. Above one
    half: predicted to be stable on the plant.
    """
    margin = table["resolved_margin"].to_numpy(float)
    others = table[["controller_radius", "noise_peak"]]
    return 1 - 1 / (1 + margin) - (others >= 1).any(axis=1).to_numpy()


def roc(table: pd.DataFrame) -> Figure:
    """ROC of "all cases settle" per plant: by the prediction, its threshold as a dot, and by the
    margin in total."""
    fig = style.new_figure(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot()
    for plant, own in table.groupby("plant"):
        good = own["kind"].eq("settled").to_numpy(float)
        score = prediction_score(own)
        if good.min() == good.max():
            continue  # one kind only: no curve
        false, true = roc_points(score, good)
        (line,) = axes.plot(
            false, true, label=f"{choice_label(plant)}, area {np.trapezoid(true, false):.3f}"
        )
        axes.plot(
            *roc_points(own["mismatch_margin"].to_numpy(float), good),
            color=line.get_color(),
            lw=0.7,
            ls=":",
        )
        kept = score > 0.5
        axes.scatter(
            (kept * (1 - good)).sum() / (1 - good).sum(),
            (kept * good).sum() / good.sum(),
            s=18,
            zorder=4,
        )
        axes.collections[-1].set_color(line.get_color())
    axes.plot([0, 1], [0, 1], color=style.PALE, lw=0.8, zorder=1)
    axes.set(
        xlabel="Share of failing designs accepted (–)",
        ylabel="Share of settling designs accepted (–)",
    )
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    if axes.get_legend_handles_labels()[0]:
        title = (
            "Solid: accepted by the whole prediction\n(dot: margin above 1). Dotted: by the "
            "margin\nin total alone. Grey: by chance."
        )
        axes.legend(loc="lower right", title=title, title_fontsize=6)
    return fig


def settling(table: pd.DataFrame) -> Figure:
    """Settling time relative to the uncontrolled plant against the resolved margin, one panel per
    plant."""
    plants = list(dict.fromkeys(table["plant"]))
    fig = style.new_figure(style.PAGE_IN, 2.7)
    for axes, plant in zip(
        np.atleast_1d(fig.subplots(1, len(plants), sharey=True)), plants, strict=True
    ):
        _panel(axes, table[table["plant"] == plant])
        axes.set(title=choice_label(plant), xlabel="Stability margin (–)")
    fig.axes[0].set_ylabel("Settling time / uncontrolled (–)")
    handles, labels = fig.axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2)
    return fig


def _panel(axes: Axes, own: pd.DataFrame) -> None:
    margin = own["resolved_margin"].clip(*SHOWN)
    time = own["relative_time"].fillna(SHOWN[1]).clip(SHOWN[0], SHOWN[1])
    settled = own["kind"].eq("settled")
    passed = (own[["controller_radius", "noise_peak"]] < 1).all(axis=1)
    for mask, colour, marker, label in (
        (
            settled & passed,
            style.BLUE,
            "o",
            "stable controller, noise within bound: all starts settle",
        ),
        (
            settled & ~passed,
            style.ORANGE,
            "o",
            "unstable controller or too much noise: all starts settle",
        ),
        (
            ~settled & passed,
            style.BLUE,
            "x",
            "stable controller, noise within bound: not all (at 10: none)",
        ),
        (
            ~settled & ~passed,
            style.VERMILLION,
            "x",
            "unstable controller or too much noise: not all",
        ),
    ):
        size, width = (
            (14, 1.0)
            if marker == "x" and colour == style.BLUE
            else (5, 0.5 if marker == "x" else 0.0)
        )
        axes.scatter(
            margin[mask],
            time[mask],
            s=size,
            color=colour,
            marker=marker,
            alpha=0.45,
            lw=width,
            label=label,
        )
    axes.axvline(1.0, color=style.INK, lw=0.8, ls="--")
    axes.set(
        xscale="log", yscale="log", xlim=(SHOWN[0], SHOWN[1] * 1.2), ylim=(0.08, SHOWN[1] * 1.2)
    )
