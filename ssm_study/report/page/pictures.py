"""Pictures of the best runs as plain values, which the page's script draws as charts."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.api.pictures.picture import Band, GuideLine, Picture, PicturePanel, Series, Values
from ssm_study.report.page.chart_looks import STROKES, framed, quantitative
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder
from ssm_study.style import INK

Stretch = Float[np.ndarray, "_"]
PANEL_HEIGHT = 170  # pixels
SQUARE = 280  # pixels, where both axes have one scale
LINE = {"type": "line", "strokeWidth": 1.4}
MARKS: dict[str, dict[str, Any]] = {
    "line": LINE,
    "steps": {**LINE, "interpolate": "step-after"},
    "stems": {"type": "bar", "width": 3},
    "dots": {"type": "point", "shape": "circle", "filled": True, "size": 8, "opacity": 1},
    "point": {"type": "point", "shape": "circle", "filled": True, "size": 70, "opacity": 1},
    "circles": {"type": "point", "shape": "circle", "size": 40},
    "triangles": {"type": "point", "shape": "triangle-up", "size": 40},
    "crosses": {"type": "point", "shape": "M-1,-1L1,1M1,-1L-1,1", "size": 30},
}
MOST_POINTS = 150  # of a line: more than a chart has pixels for


def pictures_of_run(run: RunFolder) -> list[dict[str, Any]]:
    """Pictures that can be made from a run's files, in the order of `PICTURES`."""
    drawn = []
    for name in PICTURES:
        try:
            drawn.append(picture_json(name, picture_of_run(name, run)))
        except NothingToDraw:
            continue
    return drawn


def picture_json(name: str, picture: Picture) -> dict[str, Any]:
    """Picture with its name as JSON values, without empty panels."""
    panels = [panel for panel in picture.panels if panel.series]
    charts = [
        {"title": panel.title, "spec": panel_spec(panel, f"{picture.title}: {axes_words(panel)}")}
        for panel in panels
    ]
    return {"name": name, "title": picture.title, "charts": charts}


def axes_words(panel: PicturePanel) -> str:
    """Text that names the two axes of a panel, such as `y against x`."""
    return f"{panel.y_label} against {panel.x_label}"


def panel_spec(panel: PicturePanel, description: str) -> dict[str, Any]:
    """Vega-Lite specification of one pair of axes. The legend above it has the series with a
    name."""
    axes = {
        "x": quantitative("x", panel.x_label, **axis_scale(panel.log_x, panel.x_range)),
        "y": quantitative("y", panel.y_label, **axis_scale(panel.log_y, panel.y_range)),
    }
    coloured = [(band.name, band.colour) for band in panel.bands]
    coloured += [(rule.name, INK) for rule in panel.rules]
    coloured += [(series.name, series.colour) for series in panel.series]
    legend = {name: colour for name, colour in coloured if name}
    layer = [band_layer(band, panel, axes, legend) for band in panel.bands]
    layer += [rule_layer(rule, legend) for rule in panel.rules]
    layer += [series_layer(series, panel, axes, legend) for series in panel.series]
    size = {"width": SQUARE, "height": SQUARE} if panel.equal else {"height": PANEL_HEIGHT}
    return framed({"layer": layer, **size}, description)


def axis_scale(log: bool, limits: tuple[float, float] | None) -> dict[str, Any]:
    """Vega-Lite scale of an axis, linear or logarithmic. Without limits it has a few pixels of
    room."""
    room: dict[str, Any] = {"padding": 6} if limits is None else {"domain": list(limits)}
    kind: dict[str, Any] = {"type": "log"} if log else {"type": "linear", "zero": False}
    return kind | room | {"nice": False}


def part_colour(name: str, colour: str, legend: dict[str, str]) -> dict[str, Any]:
    """Vega-Lite colour of a part of a picture, with its legend entry."""
    if not name:
        return {"value": colour}
    shown = {"title": None, "orient": "top", "columns": 2, "labelLimit": 260}
    entries = {"domain": list(legend), "range": list(legend.values())}
    return {"datum": name, "type": "nominal", "scale": entries, "legend": shown}


def series_layer(
    series: Series, panel: PicturePanel, axes: dict[str, Any], legend: dict[str, str]
) -> dict[str, Any]:
    """Vega-Lite layer of one series. It is cut to the visible range, a long line is thinned, a gap
    shortened to one missing point."""
    x, y = thin_line(*cut_to_range(series.x, series.y, panel.x_range))
    is_line = series.mark in ("line", "steps")
    transform: list[dict[str, Any]] = [{"flatten": ["x", "y"]}]
    encoding = {**axes, "color": part_colour(series.name, series.colour, legend)}
    if is_line:  # curves may turn back: the points follow one another as computed
        transform.append({"window": [{"op": "row_number", "as": "k"}]})
        encoding["order"] = {"field": "k"}
    dash = {"strokeDash": [5, 3]} if series.dashed else {}
    values = [{"x": short_numbers(x), "y": short_numbers(y)}]
    mark = {**MARKS[series.mark], **dash, "clip": True}
    data = {"values": values}
    return {"data": data, "transform": transform, "mark": mark, "encoding": encoding}


def rule_layer(rule: GuideLine, legend: dict[str, str]) -> dict[str, Any]:
    """Vega-Lite layer of a guide line across the panel."""
    axis = "y" if rule.x is None else "x"
    place = rule.y if rule.x is None else rule.x
    encoding = {axis: {"datum": place}, "color": part_colour(rule.name, INK, legend)}
    return {"data": {"values": [{}]}, "mark": STROKES, "encoding": encoding}


def band_layer(
    band: Band, panel: PicturePanel, axes: dict[str, Any], legend: dict[str, str]
) -> dict[str, Any]:
    """Vega-Lite layer of a shaded area, cut to the visible range and thinned like a line."""
    x, low = cut_to_range(band.x, band.low, panel.x_range)
    high = cut_to_range(band.x, band.high, panel.x_range)[1]
    every = _stride(len(x))
    edges = {"x": x, "y": low, "y2": high}
    values = {name: short_numbers(edge[::every]) for name, edge in edges.items()}
    layer: dict[str, Any] = {"data": {"values": [values]}}
    layer["transform"] = [{"flatten": ["x", "y", "y2"]}]
    layer["mark"] = {"type": "area", "opacity": 0.5, "clip": True}
    colour = part_colour(band.name, band.colour, legend)
    layer["encoding"] = {**axes, "y2": {"field": "y2"}, "color": colour}
    return layer


def cut_to_range(x: Values, y: Values, seen: tuple[float, float] | None) -> tuple[Stretch, Stretch]:
    """Part of a curve over time that lies in a range. Curves of other kinds stay as they are."""
    rises = bool(np.all(np.diff(x) > 0))
    if seen is None or not rises:
        return x, y
    first, last = np.searchsorted(x, seen)
    stretch = slice(max(int(first) - 1, 0), int(last) + 1)
    return x[stretch], y[stretch]


def thin_line(x: Values, y: Values) -> tuple[Stretch, Stretch]:
    """Reduce the number of points of a long line for the page, to about `MOST_POINTS`. Of a gap one
    missing point stays, which breaks the line.

    Closed curves with gaps (discs) are not thinned.
    """
    seen = np.isfinite(x) & np.isfinite(y)
    starts_gap = ~seen & np.r_[True, seen[:-1]]
    kept = np.flatnonzero(seen | starts_gap)
    if np.isfinite(x).all():
        kept = kept[:: _stride(len(kept))]
    return x[kept], y[kept]


def _stride(points: int) -> int:
    """Number of points of a long line for each point that is drawn."""
    return max(1, -(-points // MOST_POINTS))


def short_numbers(values: Values) -> list[float | None]:
    """Round numbers to four significant digits for the page; None breaks a line."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
