"""Frame, axes and strokes that all charts of the report page share."""

from typing import Any

from ssm_study.style import GREY

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"
HEIGHT = 150  # pixels
STROKES = {"type": "rule", "strokeDash": [4, 3], "color": GREY, "clip": True}
# Labels stand under their ticks and apart: neighbours must not read as one number ("0.550.60").
LOOK = {
    "font": "system-ui, sans-serif",
    "view": {"stroke": None},
    "axis": {
        "gridColor": "#E6E6E6",
        "titleFontWeight": "normal",
        "labelFlush": False,
        "labelSeparation": 8,
    },
}


def framed(spec: dict[str, Any], description: str, height: int = HEIGHT) -> dict[str, Any]:
    """Vega-Lite specification with the frame and the width of the report page."""
    frame = {"$schema": SCHEMA, "width": "container", "height": height, "config": LOOK}
    return frame | {"description": description} | spec


def quantitative(field: str, title: str | None, **scale: Any) -> dict[str, Any]:
    """Vega-Lite axis for a numeric field."""
    shown: dict[str, Any] = {"field": field, "type": "quantitative", "title": title}
    return shown | ({"scale": scale} if scale else {})
