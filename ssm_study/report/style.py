"""One look for every figure: widths of a two-column paper, colours that survive colour blindness and grey print."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import seaborn as sns
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLUMN_IN = 3.5
PAGE_IN = 7.16

# Okabe & Ito 2008, ordered so that neighbours also differ in lightness.
BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7"
INK, GREY, PALE = "#1A1A1A", "#6B6B6B", "#D9D9D9"
CYCLE = [BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE]
SEQUENCE = "viridis"  # monotone in lightness

_PAPER: dict[Any, Any] = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.linewidth": 0.6,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "axes.prop_cycle": cycler(color=CYCLE),
    "pdf.fonttype": 42,  # editable text; type 3 fonts are refused by many publishers
    "savefig.dpi": 300,
}


@contextmanager
def paper() -> Iterator[None]:
    """Everything drawn and saved inside has the look of this project; the caller's own settings come back after."""
    with sns.axes_style("ticks"), mpl.rc_context(_PAPER):
        yield


def canvas(width_in: float = COLUMN_IN, height_in: float = 2.3) -> Figure:
    """An empty figure without pyplot's global state, so that figures can be drawn anywhere and are freed."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def message(text: str, width_in: float = COLUMN_IN, height_in: float = 1.2) -> Figure:
    """A figure that says why there is nothing to draw; a missing figure would leave the reader guessing."""
    figure = canvas(width_in, height_in)
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", wrap=True, color=GREY)
    return figure


def above(axes: Axes, columns: int = 3, others: tuple[Axes, ...] = ()) -> None:
    """The legend in one row over the axes, with what only the `others` show: never on top of the data."""
    shown = {
        label: handle
        for part in (axes, *others)
        for handle, label in zip(*part.get_legend_handles_labels(), strict=True)
    }
    axes.legend(
        shown.values(),
        shown.keys(),
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=columns,
        borderaxespad=0.2,
        columnspacing=1.2,
    )


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """`folder/name.png` and `folder/name.pdf`; the same data give the same bytes (no creation date)."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    figure.savefig(paths[0], metadata={"Software": None})
    figure.savefig(paths[1], metadata={"CreationDate": None})
    return paths
