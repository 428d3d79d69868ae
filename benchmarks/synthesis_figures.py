"""What is possible and what it costs, drawn from the tables of `synthesis_maps.py`.

    python benchmarks/synthesis_figures.py     (seconds)

Writes feasibility_map, gain_norm and contraction as PNG beside their tables.
"""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from synthesis_certified import FOLDER

from ssm_study import style
from ssm_study.table.columns import boolean_column, numeric_column, text_column

METHODS = {  # method: label, colour, marker
    "riccati": ("Riccati", style.BLUE, "o"),
    "closed_form": ("closed form", style.VERMILLION, "s"),
    "lmi_smallest_gain": ("LMI, smallest gain", style.GREEN, "^"),
    "lmi_feasibility": ("LMI, any solution", style.ORANGE, "v"),
}


def feasibility_map(table: pd.DataFrame) -> Figure:
    """The solver's verdict on the paper's inequality, rate by slope floor, under the exact frontier
    of the model.

    `table`: columns `slope_floor, rate, rate_limit, solver_certified`, all of one model.
    """
    floor = numeric_column(table, "slope_floor")
    rate = numeric_column(table, "rate")
    held = boolean_column(table, "solver_certified")
    fig = style.new_figure(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot(xscale="log")
    limits = pd.DataFrame(
        {"floor": floor, "limit": numeric_column(table, "rate_limit")}
    ).drop_duplicates()
    limits = limits.sort_values("floor")
    axes.fill_between(limits.floor, limits.limit, color=style.PALE, alpha=0.6, lw=0, zorder=1)
    axes.plot(limits.floor, limits.limit, color=style.INK, label="exact frontier", zorder=2)
    axes.scatter(
        floor[held], rate[held], c=style.BLUE, marker="o", s=14, label="solver: certified", zorder=3
    )
    axes.scatter(
        floor[~held],
        rate[~held],
        c=style.VERMILLION,
        marker="x",
        s=14,
        lw=0.9,
        label="solver: none",
        zorder=3,
    )
    axes.set_xticks([0.01, 0.1, 1], ["0.01", "0.1", "1"])
    axes.set(
        xlabel="Slope floor of S$_u$, slopes in [floor, 1] (–)",
        ylabel="Controller rate, ρ (1/sample)",
    )
    axes.set_ylim(0, 1)
    style.place_legend_above(axes, columns=3)
    return fig


def gain_norm(table: pd.DataFrame) -> Figure:
    """The norm of the certified gain against the asked rate, by method, up to the exact frontier.

    `table`: columns `method, rate, rate_limit, gain_norm`, all of one model and one ball.
    """
    fig = style.new_figure(style.COLUMN_IN, 2.6)
    axes = fig.add_subplot()
    _lines(axes, table, numeric_column(table, "rate"), numeric_column(table, "gain_norm"))
    axes.axvline(
        numeric_column(table, "rate_limit").max(),
        color=style.INK,
        lw=0.9,
        ls=":",
        label="exact frontier",
    )
    axes.set(xlabel="Controller rate, ρ (1/sample)", ylabel="Controller gain ‖K‖ (scaled)")
    axes.set_ylim(bottom=0)
    style.place_legend_above(axes, columns=2)
    return fig


def contraction(table: pd.DataFrame) -> Figure:
    """The worst contraction measured with slopes at the ends of the ball against the certified one,
    and the equal line.

    `table`: columns `method, certified, measured`, factors of the distance per sample.
    """
    certified = numeric_column(table, "certified")
    measured = numeric_column(table, "measured")
    fig = style.new_figure(style.COLUMN_IN, 2.8)
    axes = fig.add_subplot()
    span = (
        min(certified.min(), measured.min()) - 0.01,
        max(certified.max(), measured.max()) + 0.01,
    )
    axes.plot(span, span, color=style.INK, lw=0.8, ls=":", label="measured = certified", zorder=5)
    _lines(axes, table, certified, measured)
    axes.set(
        xlabel="Certified contraction, r (1/sample)", ylabel="Measured contraction, r (1/sample)"
    )
    axes.set(xlim=span, ylim=span)
    style.place_legend_above(axes, columns=2)
    return fig


def _lines(axes: Axes, table: pd.DataFrame, x: pd.Series, y: pd.Series) -> None:
    """One line per method; circles are hollow and larger, so that a line that coincides with them
    is seen."""
    method = text_column(table, "method")
    for name, (label, colour, marker) in METHODS.items():
        here = method == name
        if here.any():
            size, face, order = (6, "none", 4) if marker == "o" else (3, colour, 3)
            axes.plot(
                x[here],
                y[here],
                color=colour,
                marker=marker,
                ms=size,
                mfc=face,
                label=label,
                zorder=order,
                clip_on=False,
            )


FIGURES = {"feasibility_map": feasibility_map, "gain_norm": gain_norm, "contraction": contraction}


def main() -> None:
    for name, draw in FIGURES.items():
        with style.paper_style():
            paths = style.save_figure(
                draw(pd.read_csv(FOLDER / f"{name}.csv")), FOLDER, name, ("png",)
            )
        print(*paths, sep="\n")


if __name__ == "__main__":
    main()
