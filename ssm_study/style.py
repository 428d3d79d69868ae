"""Style of all figures: sizes, fonts and how they are saved. One look for every figure: widths of a
two-column paper, colours that survive colour blindness and grey print."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ssm_study.durable import refuse_symbolic_link, write_atomically

if TYPE_CHECKING:  # a colour is asked for more often than a figure is drawn
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Width = Literal["page", "column"]
COLUMN_IN = 3.5
PAGE_IN = 7.16

# Okabe & Ito 2008, ordered so that neighbours also differ in lightness.
BLUE = "#0072B2"
VERMILLION = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
SKY = "#56B4E9"
PURPLE = "#CC79A7"
INK = "#1A1A1A"
GREY = "#6B6B6B"
PALE = "#D9D9D9"
CYCLE = [BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE]
SEQUENCE = "viridis"  # monotone in lightness

_PAPER: dict[str, dict[str, Any]] = {  # by group, as `matplotlib.rc` takes them
    "font": {"family": "STIXGeneral", "size": 8},
    "mathtext": {"fontset": "stix"},
    "text": {"color": INK},
    "axes": {"labelsize": 8, "titlesize": 8, "titlelocation": "left", "linewidth": 0.6,
             "edgecolor": INK,
             "labelcolor": INK, "grid": True, "axisbelow": True},
    "axes.spines": {"top": False, "right": False},
    "legend": {"fontsize": 7, "frameon": False, "handlelength": 1.6},
    "xtick": {"labelsize": 7, "color": INK, "major.width": 0.6, "major.size": 2.5},
    "ytick": {"labelsize": 7, "color": INK, "major.width": 0.6, "major.size": 2.5},
    "grid": {"color": "#E6E6E6", "linewidth": 0.5},
    "lines": {"linewidth": 1.1, "markersize": 4},
    "pdf": {"fonttype": 42},  # editable text; type 3 fonts are refused by many publishers
    "savefig": {"dpi": 300},
}  # fmt: skip


NOTEBOOK_DPI = 100  # as wide as shown; drawn twice as fine for sharp screens
_PAGE: ContextVar[float] = ContextVar("_PAGE", default=PAGE_IN)


def is_single_column() -> bool:
    """Whether figures are drawn for a single column of a paper, not for its full width."""
    return _PAGE.get() == COLUMN_IN


@contextmanager
def paper_style(width: Width = "page") -> Iterator[None]:
    """Context manager in which all figures are drawn and saved in the project's style. Afterwards
    the caller's own settings are in force again. `width="column"`: figures that can be are drawn
    for one column."""
    import matplotlib as mpl
    import seaborn as sns
    from cycler import cycler

    look: dict[Any, Any] = {
        f"{group}.{name}": v for group, values in _PAPER.items() for name, v in values.items()
    }
    look["axes.prop_cycle"] = cycler(color=CYCLE)
    width_token = _PAGE.set(COLUMN_IN if width == "column" else PAGE_IN)
    with mpl.rc_context():
        mpl.rcdefaults()  # a user's own file may ask for TeX, which a run need not have
        try:
            with sns.axes_style("ticks"), mpl.rc_context(look):
                yield
        finally:
            _PAGE.reset(width_token)


def new_figure(width_in: float = COLUMN_IN, height_in: float = 2.3) -> "Figure":
    """Create an empty Matplotlib figure of a given size, independent of pyplot's global state. It
    can be drawn anywhere and is freed; a notebook displays it whether or not pyplot is loaded."""
    return _figure_class()(figsize=(width_in, height_in), layout="constrained")


@cache
def _figure_class() -> "type[Figure]":
    """Class of Matplotlib figures that a notebook displays in the project's style."""
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
            """PNG image of a figure for a notebook, and the width and height shown, in pixels."""
            content = io.BytesIO()
            with paper_style():
                self.savefig(content, format="png", dpi=2 * NOTEBOOK_DPI)
            width, height = (round(NOTEBOOK_DPI * side_in) for side_in in self.get_size_inches())
            return content.getvalue(), {"width": width, "height": height}

    return NotebookFigure


def place_legend_above(axes: "Axes", columns: int = 3, others: "tuple[Axes, ...]" = ()) -> None:
    """Place the legend of a figure in one row above its axes, so that the legend never covers the
    data. Labels that only the `others` have are included."""
    handle_by_label: dict[str, Any] = {}
    for part in (axes, *others):
        handles, labels = part.get_legend_handles_labels()
        handle_by_label |= dict(zip(labels, handles, strict=True))
    look = {"bbox_to_anchor": (0, 1.0), "borderaxespad": 0.2, "columnspacing": 1.2}
    axes.legend(
        handle_by_label.values(), handle_by_label.keys(), loc="lower left", ncols=columns, **look
    )


def save_figure(
    figure: "Figure", folder: Path, name: str, kinds: tuple[str, ...] = ("png", "pdf")
) -> list[Path]:
    """Save a figure under a name in a folder, as PNG, PDF or both.

    The same data give the same bytes: no creation date is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    refuse_symbolic_link(folder)
    dated = {"png": "Software", "pdf": "CreationDate"}
    paths = [folder / f"{name}.{kind}" for kind in kinds]
    for path, kind in zip(paths, kinds, strict=True):
        content = io.BytesIO()
        figure.savefig(content, format=kind, metadata={dated[kind]: None})
        write_atomically(path, content.getvalue(), durable=False)
    return paths
