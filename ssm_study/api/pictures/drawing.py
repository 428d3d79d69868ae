"""Drawing of pictures with Matplotlib."""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ssm_study import style
from ssm_study.api.pictures.picture import GuideLine, Mark, Picture, PicturePanel, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW_IN = 1.55  # height of a panel of height one
TITLE_LINE_IN = 0.14  # height of a further line of a title
LETTERS_PER_INCH = 16  # of a title: more would be cut off at the edge
SHAPES: dict[Mark, str] = {
    "dots": ".",
    "crosses": "x",
    "circles": "o",
    "triangles": "^",
    "point": "o",
}
MOST_LEGEND_COLUMNS = 3
FEW_DECADES = 200  # ratio of the ends of a logarithmic axis below which more ticks have labels


def draw_picture(picture: Picture) -> "Figure":
    """Draw a picture with Matplotlib in the style of the paper. Returns the figure; nothing is
    shown."""
    with style.paper_style():
        return draw_unstyled(picture)


def draw_unstyled(picture: Picture) -> "Figure":
    """Draw a picture with the Matplotlib settings that are in force, instead of the project's
    style."""
    row_starts = range(0, len(picture.panels), picture.columns)
    rows = [picture.panels[i : i + picture.columns] for i in row_starts]
    heights = [row[0].height for row in rows]
    width = style.PAGE_IN if picture.wide or picture.columns > 1 else style.COLUMN_IN
    letters = int(LETTERS_PER_INCH * width)
    title = textwrap.fill(picture.title, letters)
    panel_heights = sum(heights)
    line_breaks = title.count("\n")
    height_in = 0.35 + ROW_IN * panel_heights + TITLE_LINE_IN * line_breaks
    figure = style.new_figure(width, height_in)
    row_count = len(rows)
    grid = figure.subplots(row_count, picture.columns, squeeze=False, height_ratios=heights)
    for axes_of_row, panels in zip(grid, rows, strict=True):
        for axes, panel in zip(axes_of_row, panels, strict=False):
            draw_panel(axes, panel)
        for axes in axes_of_row[len(panels) :]:
            axes.set_axis_off()
    _hide_repeated_labels(grid, rows)
    if picture.title:
        figure.suptitle(title, size=8, x=0.01, ha="left")
    figure.align_ylabels()
    return figure


def draw_panel(axes: "Axes", panel: PicturePanel) -> None:
    """Draw one panel of a picture into Matplotlib axes."""
    for band in panel.bands:
        label = band.name or None
        axes.fill_between(
            band.x, band.low, band.high, color=band.colour, lw=0, label=label, alpha=0.6
        )
    for rule in panel.rules:
        _draw_guide_line(axes, rule)
    for series in panel.series:
        _draw_series(axes, series)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label, title=panel.title)
    if panel.log_x:
        axes.set_xscale("log")
    if panel.log_y:
        axes.set_yscale("log")
        _thin_minor_labels(axes)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box")
    if panel.x_range:
        axes.set_xlim(*panel.x_range)
    if panel.y_range:
        axes.set_ylim(*panel.y_range)
    legend_handles_labels = axes.get_legend_handles_labels()
    if legend_handles_labels[1] and not panel.title:
        columns = MOST_LEGEND_COLUMNS if _is_wide(axes) else 2
        style.place_legend_above(axes, columns=columns)
    elif axes.get_legend_handles_labels()[1]:
        axes.legend(loc="best")


def _thin_minor_labels(axes: "Axes") -> None:
    """Label only the multiples 2 and 5 of each power of ten on a logarithmic axis that spans few
    powers."""
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    low, high = axes.get_ylim()
    if high < FEW_DECADES * low:
        subs = (1.0, 2.0, 5.0)
        log_locator = LogLocator(subs=subs)
        axes.yaxis.set_major_locator(log_locator)
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(lambda *_: "")


def _is_wide(axes: "Axes") -> bool:
    """Whether Matplotlib axes are as wide as a page rather than a column of text."""
    figure = axes.figure
    columns = axes.get_subplotspec()
    assert columns is not None
    across = columns.get_gridspec().ncols
    panel_in = figure.get_figwidth() / across  # type: ignore[union-attr]
    page_from_in = style.COLUMN_IN + 0.5
    return bool(panel_in > page_from_in)


def _draw_series(axes: "Axes", series: Series) -> None:
    """Draw one series of a picture as a line, as dots or with another mark."""
    label = series.name or None
    look: dict[str, Any] = {"color": series.colour, "label": label}
    linewidth = 0.7 if series.thin else 1.1
    dashes = series.dashes or (None, None)
    line: dict[str, Any] = {"linewidth": linewidth, "dashes": dashes}
    if series.mark == "line":
        axes.plot(series.x, series.y, **look, **line)
    elif series.mark == "steps":
        axes.step(series.x, series.y, where="post", **look, **line)
    elif series.mark == "stems":
        axes.vlines(series.x, 0, series.y, color=series.colour, linewidth=1.0)
        axes.plot(series.x, series.y, marker="o", markersize=2, linestyle="", **look)
    elif series.mark == "dots":
        axes.plot(series.x, series.y, marker=".", markersize=2.5, linestyle="", **look)
    else:
        fill = "full" if series.mark == "point" else "none"
        shape = SHAPES[series.mark]
        axes.plot(series.x, series.y, marker=shape, linestyle="", fillstyle=fill, zorder=4, **look)


def _draw_guide_line(axes: "Axes", rule: GuideLine) -> None:
    """Draw a horizontal or vertical guide line across Matplotlib axes."""
    linestyle = "--" if rule.dashed else "-"
    label = rule.name or None
    look: dict[str, Any] = {
        "color": style.INK,
        "linewidth": 0.8,
        "linestyle": linestyle,
        "label": label,
    }
    if rule.y is not None:
        axes.axhline(rule.y, **look)
    if rule.x is not None:
        axes.axvline(rule.x, **look)


def _hide_repeated_labels(grid: Any, rows: list[tuple[PicturePanel, ...]]) -> None:
    """Hide the repeated labels of a horizontal axis that several panels of a column share."""
    for j in range(len(rows[0])):
        labels = [row[j].x_label for row in rows if j < len(row)]
        if len(set(labels)) > 1:
            continue
        for i in range(len(labels) - 1):
            x_range = rows[i][j].x_range
            panel_below = rows[i + 1][j]
            if x_range == panel_below.x_range:
                axes = grid[i][j]
                axes_below = grid[i + 1]
                axes.sharex(axes_below[j])
                grid[i][j].set_xlabel("")
                grid[i][j].tick_params(labelbottom=False)


def circle_points(
    radius: float = 1.0, points: int = 181
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Coordinates of points on a circle around the origin."""
    angles = np.linspace(0, 2 * np.pi, points)
    x = radius * np.cos(angles)
    y = radius * np.sin(angles)
    return x, y
