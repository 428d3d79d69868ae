"""What coverage costs in settling time: all designs of eight plants, drawn from the table of
`coverage_designs.py`.

    python benchmarks/coverage_figure.py     (seconds)

Writes coverage_designs.png beside its table.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import seaborn as sns
from common import REFERENCE
from matplotlib.figure import Figure

from ssm_study import style

TABLE = REFERENCE / "certificates" / "coverage_designs.csv"
PLANTS = (  # of aside_plants.py
    "bent_sensor",
    "equal_percentage_valve",
    "flexible_shaft",
    "inverse_response",
    "magnetic_valve",
    "slow_spread",
    "stirred_reactor",
    "tyre_sideslip",
)
LEAST = 0.02  # coverage at the left end
UNSETTLED = 1.9  # height of the designs that do not settle
COLUMNS = 4
SETTLES = {True: "settles all ten starts", False: "does not"}


def read_designs(path: Path) -> pd.DataFrame:
    """Designs of the eight plants, with their settling time over the uncontrolled one."""
    table = pd.read_csv(path)
    table = table[table.plant.isin(PLANTS)].copy()
    table["coverage"] = table.coverage_by_frequency.clip(lower=LEAST)
    settles = (table.stable_count == 10) & (table.stable_count_noise_free == 10)
    ratio = table.settling_time_mean_s / table.settling_time_open_loop_s
    table["ratio"] = ratio.where(settles, UNSETTLED).clip(upper=UNSETTLED)
    table["outcome"] = settles.map(SETTLES)
    return table


def fastest_with_coverage(designs: pd.DataFrame) -> pd.DataFrame:
    """Smallest settling time among settling designs that cover at least as much, for each
    coverage."""
    settling = designs[designs.outcome == SETTLES[True]]
    by_coverage = settling.sort_values("coverage", ascending=False)
    fastest = np.minimum.accumulate(by_coverage.ratio.to_numpy())
    return pd.DataFrame({"coverage": by_coverage.coverage, "ratio": fastest})


def draw_designs(table: pd.DataFrame) -> Figure:
    """One panel for each plant, with the fastest design of each coverage as a line."""
    rows = -(-len(PLANTS) // COLUMNS)
    fig = style.new_figure(style.PAGE_IN, 2.1 * rows)
    panels = fig.subplots(rows, COLUMNS, sharex=True, sharey=True).ravel()
    for plant, axes in zip(PLANTS, panels, strict=True):
        designs = table[table.plant == plant]
        sns.scatterplot(
            designs,
            x="coverage",
            y="ratio",
            hue="outcome",
            style="outcome",
            hue_order=list(SETTLES.values()),
            style_order=list(SETTLES.values()),
            palette=[style.BLUE, style.VERMILLION],
            markers=["o", "X"],
            s=14,
            alpha=0.7,
            linewidth=0,
            legend=axes is panels[0],
            ax=axes,
        )
        front = fastest_with_coverage(designs)
        axes.step(front.coverage, front.ratio, where="post", color=style.INK, lw=1)
        axes.axvline(1, color=style.INK, lw=0.6, ls=":")
        axes.set_xscale("log")
        axes.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
        axes.set_title(plant.replace("_", " "), fontsize="small")
        axes.set(xlabel="", ylabel="")
    panels[0].legend(title=None, loc="lower left", fontsize="x-small")
    fig.supxlabel("Coverage, by frequency (–)", fontsize="medium")
    fig.supylabel("Settling time / uncontrolled (–)", fontsize="medium")
    return fig


def main() -> None:
    with style.paper_style():
        figure = draw_designs(read_designs(TABLE))
        style.save_figure(figure, TABLE.parent, TABLE.stem, ("png",))


if __name__ == "__main__":
    main()
