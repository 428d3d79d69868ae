"""Frame, axes and line styles that all charts of the report page share."""

from typing import Any

from ssm_study.style import GREY

Spec = dict[str, Any]

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"
HEIGHT = 150  # pixels
DASH = [4, 3]
STROKES = {"type": "rule", "strokeDash": DASH, "color": GREY, "clip": True}
NO_FRAME = {"stroke": None}
# Labels stand under their ticks and apart: neighbours must not read as one number ("0.550.60").
AXIS = {
    "gridColor": "#E6E6E6",
    "titleFontWeight": "normal",
    "labelFlush": False,
    "labelSeparation": 8,
}
CONFIG = {"font": "system-ui, sans-serif", "view": NO_FRAME, "axis": AXIS}
LOOK = {"$schema": SCHEMA, "config": CONFIG}  # of every chart, which the page's script adds


def framed_specification(spec: Spec, description: str, height: int = HEIGHT) -> Spec:
    """Vega-Lite specification of a chart as wide as the report page."""
    frame = {"width": "container", "height": height, "description": description}
    return frame | spec


def quantitative_axis(field: str, title: str | None, **scale: Any) -> Spec:
    """Axis of a Vega-Lite chart for a numeric field."""
    axis: Spec = {"field": field}
    axis["type"] = "quantitative"
    axis["title"] = title
    if scale:
        axis["scale"] = scale
    return axis


def horizontal_legend(columns: int, widest_px: int) -> Spec:
    """Legend above a Vega-Lite chart, without a title."""
    legend: Spec = {"title": None, "orient": "top"}
    legend["columns"] = columns
    legend["labelLimit"] = widest_px
    return legend
