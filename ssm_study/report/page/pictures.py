"""Pictures of the best runs as plain values, which the page's script draws as charts."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from ssm_study.api.pictures.picture import Band, GuideLine, Picture, PicturePanel, Series, Values
from ssm_study.report.figures import figure_caption
from ssm_study.report.page.chart_looks import (
    DASH,
    STROKES,
    Spec,
    framed_specification,
    quantitative_axis,
)
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder
from ssm_study.style import INK

Stretch = Float[np.ndarray, "_"]
Places = Int[np.ndarray, "_"]
Range = tuple[float, float]
LegendEntry = tuple[str, str, str, str]  # name, mark, colour, lengths of dash and gap

PANEL_HEIGHT = 170  # pixels
SQUARE = 280  # pixels, where both axes have one scale
LINE = {"type": "line", "strokeWidth": 1.4}
STEPS = {**LINE, "interpolate": "step-after"}
STEMS = {"type": "bar", "width": 3}
DOT = {"type": "point", "shape": "circle", "filled": True}
CROSS = "M-1,-1L1,1M1,-1L-1,1"
MARKS: dict[str, Spec] = {"line": LINE, "steps": STEPS, "stems": STEMS}
MARKS["dots"] = {**DOT, "size": 8, "opacity": 1}
MARKS["point"] = {**DOT, "size": 70, "opacity": 1}
MARKS["circles"] = {"type": "point", "shape": "circle", "size": 40}
MARKS["triangles"] = {"type": "point", "shape": "triangle-up", "size": 40}
MARKS["crosses"] = {"type": "point", "shape": CROSS, "size": 30}
JOINED = ("line", "steps")  # marks that join one point to the next
MOST_POINTS = 150  # of a line: more than a chart has pixels for


def pictures_of_run(run: RunFolder) -> list[Spec]:
    """Pictures that can be made from the files of a run, and the reasons why other pictures cannot
    be made. They are in the order of `PICTURES`."""
    drawn = []
    reasons = []
    for name in PICTURES:
        try:
            picture = picture_of_run(name, run)
        except NothingToDraw as reason:
            reasons.append(f"{name.replace('_', ' ').capitalize()}: {reason}")
            continue
        drawn.append(picture_json(name, picture))
    if drawn and reasons:
        title = "Pictures that this run does not have"
        entry = {"name": "missing", "title": title, "charts": [], "caption": " ".join(reasons)}
        drawn.append(entry)
    return drawn


def picture_json(name: str, picture: Picture) -> Spec:
    """JSON form of a named picture without its empty panels, for the report page."""
    charts = []
    for panel in picture.panels:
        if panel.series:
            description = f"{picture.title}: {axes_text(panel)}"
            spec = panel_spec(panel, description)
            legend = legend_entries(panel)
            charts.append({"title": panel.title, "legend": legend, "spec": spec})
    content = {"name": name, "title": picture.title, "charts": charts}
    content["caption"] = figure_caption(name)
    return content


def axes_text(panel: PicturePanel) -> str:
    """Text that names the two axes of a picture's panel, such as `y against x`."""
    return f"{panel.y_label} against {panel.x_label}"


def panel_spec(panel: PicturePanel, description: str) -> Spec:
    """Vega-Lite specification of one panel of a picture, without a legend. The page writes the
    legend above."""
    axes = panel_axes(panel)
    layers = [band_layer(band, panel, axes) for band in panel.bands]
    layers += [guide_line_layer(rule) for rule in panel.rules]
    layers += [series_layer(series, panel, axes) for series in panel.series]
    spec: Spec = {"layer": layers, "height": PANEL_HEIGHT}
    if panel.equal:
        spec["width"] = SQUARE
        spec["height"] = SQUARE
    return framed_specification(spec, description)


def panel_axes(panel: PicturePanel) -> Spec:
    """Vega-Lite axes of one panel of a picture, with their scales."""
    x_scale = axis_scale(panel.log_x, panel.x_range)
    y_scale = axis_scale(panel.log_y, panel.y_range)
    x = quantitative_axis("x", panel.x_label, **x_scale)
    y = quantitative_axis("y", panel.y_label, **y_scale)
    return {"x": x, "y": y}


def legend_entries(panel: PicturePanel) -> list[LegendEntry]:
    """Legend entries of a picture's panel: each named curve or line with its mark, colour and
    dashes."""
    entries = [(rule.name, "line", INK, dash_text(guide_line_dashes(rule))) for rule in panel.rules]
    for series in panel.series:
        mark = "line" if series.mark in JOINED else series.mark
        entries.append((series.name, mark, series.colour, dash_text(series.dashes)))
    entries += [(band.name, "band", band.colour, "") for band in panel.bands]
    named = [entry for entry in entries if entry[0]]
    return list(dict.fromkeys(named))


def guide_line_dashes(guide_line: GuideLine) -> tuple[int, ...]:
    """Lengths of dash and gap with which a guide line is drawn; none for a solid line."""
    return tuple(DASH) if guide_line.dashed else ()


def dash_text(dashes: tuple[int, ...]) -> str:
    """Text of dash and gap lengths as SVG writes them."""
    return " ".join(map(str, dashes))


def axis_scale(log: bool, limits: Range | None) -> Spec:
    """Vega-Lite scale of one axis, linear or logarithmic. Without limits it has a few pixels of
    room."""
    scale: Spec = {"type": "log"} if log else {"type": "linear", "zero": False}
    if limits is None:
        scale["padding"] = 6
    else:
        scale["domain"] = list(limits)
    scale["nice"] = False
    return scale


def series_layer(series: Series, panel: PicturePanel, axes: Spec) -> Spec:
    """Vega-Lite layer that draws one curve of a picture. It is cut to the visible range, a long
    line is thinned, a gap shortened to one missing point."""
    x, y = cut_to_range(series.x, series.y, panel.x_range)
    x, y = thin_line(x, y)
    numbers = {"x": round_for_page(x), "y": round_for_page(y)}
    transform: list[Spec] = [{"flatten": ["x", "y"]}]
    encoding = dict(axes)
    encoding["color"] = {"value": series.colour}
    if series.mark in JOINED:  # curves may turn back: the points follow one another as computed
        row_number = {"op": "row_number", "as": "k"}
        transform.append({"window": [row_number]})
        encoding["order"] = {"field": "k"}
    mark = dict(MARKS[series.mark])
    if series.dashes:
        mark["strokeDash"] = list(series.dashes)
    mark["clip"] = True
    layer: Spec = {"data": {"values": [numbers]}}
    layer["transform"] = transform
    layer["mark"] = mark
    layer["encoding"] = encoding
    return layer


def guide_line_layer(guide_line: GuideLine) -> Spec:
    """Vega-Lite layer that draws a guide line across a panel."""
    axis = "x"
    place = guide_line.x
    if place is None:
        axis = "y"
        place = guide_line.y
    mark = STROKES | {"color": INK, "strokeDash": guide_line_dashes(guide_line)}
    return {"data": {"values": [{}]}, "mark": mark, "encoding": {axis: {"datum": place}}}


def band_layer(band: Band, panel: PicturePanel, axes: Spec) -> Spec:
    """Vega-Lite layer that draws a shaded area of a picture."""
    x, low = cut_to_range(band.x, band.low, panel.x_range)
    _, high = cut_to_range(band.x, band.high, panel.x_range)
    every = _line_stride(len(x))
    values = {"x": round_for_page(x[::every])}
    values["y"] = round_for_page(low[::every])
    values["y2"] = round_for_page(high[::every])
    encoding = dict(axes)
    encoding["y2"] = {"field": "y2"}
    encoding["color"] = {"value": band.colour}
    layer: Spec = {"data": {"values": [values]}}
    layer["transform"] = [{"flatten": ["x", "y", "y2"]}]
    layer["mark"] = {"type": "area", "opacity": 0.5, "clip": True}
    layer["encoding"] = encoding
    return layer


def cut_to_range(x: Values, y: Values, visible_range: Range | None) -> tuple[Stretch, Stretch]:
    """Part of a curve over time that lies in a visible range. Curves of other kinds stay as they
    are."""
    rises = bool(np.all(np.diff(x) > 0))
    if visible_range is None or not rises:
        return x, y
    first, last = np.searchsorted(x, visible_range)
    start = max(int(first) - 1, 0)
    stretch = slice(start, int(last) + 1)
    return x[stretch], y[stretch]


def thin_line(x: Values, y: Values) -> tuple[Stretch, Stretch]:
    """Reduce the number of points of a long curve so that no peak is lost. About `MOST_POINTS`
    stay: of each stretch the lowest and the highest. Of a gap one missing point stays, which breaks
    the line.

    Closed curves with gaps (discs) are not thinned.
    """
    is_seen = np.isfinite(x) & np.isfinite(y)
    drawn = np.flatnonzero(is_seen | starts_of_gaps(is_seen))
    if np.isfinite(x).all():
        drawn = extreme_indices(drawn, y)
    return x[drawn], y[drawn]


def extreme_indices(places: Places, y: Values) -> Places:
    """Indices of the lowest and the highest value in each section of a long curve.

    Both ends of the curve and its missing values are kept too."""
    if len(places) <= MOST_POINTS:
        return places
    kept = {int(places[0]), int(places[-1])}
    for stretch in np.array_split(places, MOST_POINTS // 2):
        values = y[stretch]
        kept.update(stretch[~np.isfinite(values)].tolist())
        if np.isfinite(values).any():
            kept.add(int(stretch[np.nanargmin(values)]))
            kept.add(int(stretch[np.nanargmax(values)]))
    return np.array(sorted(kept))


def starts_of_gaps(is_seen: Bool[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    """For each point of a curve, whether the point is the first missing one of a gap."""
    previous = np.ones_like(is_seen)
    previous[1:] = is_seen[:-1]
    return previous & ~is_seen


def _line_stride(points: int) -> int:
    """Number of successive points of a long curve that are reduced to their minimum and maximum."""
    stride = math.ceil(points / MOST_POINTS)
    return max(1, stride)


def round_for_page(values: Values) -> list[float | None]:
    """Round numbers to four significant digits for the report page; None stands for a gap in a
    line."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
