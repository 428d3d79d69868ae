"""Pictures of the best runs as plain values, which the page's script draws as charts."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.api.pictures.picture import Band, GuideLine, Picture, PicturePanel, Series, Values
from ssm_study.report.run_pictures import PICTURES, picture_of_run
from ssm_study.report.study_folder import NothingToDraw, RunFolder

Stretch = Float[np.ndarray, "_"]
MOST_POINTS = 150  # of a line: more than a chart has pixels for


def pictures_of_run(run: RunFolder) -> list[dict[str, Any]]:
    """Every picture that the run's files allow, in the order of `PICTURES`."""
    drawn = []
    for name in PICTURES:
        try:
            drawn.append(picture_json(name, picture_of_run(name, run)))
        except NothingToDraw:
            continue
    return drawn


def picture_json(name: str, picture: Picture) -> dict[str, Any]:
    """A picture as JSON values, with its name; empty panels are left out."""
    panels = [_panel(panel) for panel in picture.panels if panel.series]
    return {"name": name, "title": picture.title, "panels": panels}


def _panel(panel: PicturePanel) -> dict[str, Any]:
    """One pair of axes; what has its default is left out."""
    values: dict[str, Any] = {
        "x": panel.x_label,
        "y": panel.y_label,
        "title": panel.title,
        "logX": panel.log_x,
        "logY": panel.log_y,
        "equal": panel.equal,
        "rangeX": panel.x_range,
        "rangeY": panel.y_range,
        "series": [_series(series, panel.x_range) for series in panel.series],
        "rules": [_rule(rule) for rule in panel.rules],
        "bands": [_band(band, panel.x_range) for band in panel.bands],
    }
    return {key: value for key, value in values.items() if value}


def _series(series: Series, seen: tuple[float, float] | None) -> dict[str, Any]:
    """One series, cut to what is seen, a long line thinned, gaps shortened to one missing point."""
    x, y = thinned(*cut(series.x, series.y, seen))
    look: dict[str, Any] = {
        "name": series.name,
        "mark": series.mark,
        "colour": series.colour,
        "dashed": series.dashed,
    }
    points = {"x": short_numbers(x), "y": short_numbers(y)}
    return {key: value for key, value in look.items() if value} | points


def _rule(rule: GuideLine) -> dict[str, Any]:
    """A line across the panel."""
    values = {"x": rule.x, "y": rule.y, "name": rule.name}
    return {key: value for key, value in values.items() if value not in (None, "")}


def _band(band: Band, seen: tuple[float, float] | None) -> dict[str, Any]:
    """A shaded area, cut and thinned like a line."""
    x, low = cut(band.x, band.low, seen)
    high = cut(band.x, band.high, seen)[1]
    every = _stride(len(x))
    return {
        "x": short_numbers(x[::every]),
        "low": short_numbers(low[::every]),
        "high": short_numbers(high[::every]),
        "name": band.name,
        "colour": band.colour,
    }


def cut(x: Values, y: Values, seen: tuple[float, float] | None) -> tuple[Stretch, Stretch]:
    """The stretch of a signal over time that lies in a range; other curves as they are."""
    rises = bool(np.all(np.diff(x) > 0))
    if seen is None or not rises:
        return x, y
    first, last = np.searchsorted(x, seen)
    stretch = slice(max(int(first) - 1, 0), int(last) + 1)
    return x[stretch], y[stretch]


def thinned(x: Values, y: Values) -> tuple[Stretch, Stretch]:
    """At most about `MOST_POINTS` points; of a gap one point stays, which breaks the line.

    Closed curves with gaps (discs) are not thinned.
    """
    seen = np.isfinite(x) & np.isfinite(y)
    starts_gap = ~seen & np.r_[True, seen[:-1]]
    kept = np.flatnonzero(seen | starts_gap)
    if np.isfinite(x).all():
        kept = kept[:: _stride(len(kept))]
    return x[kept], y[kept]


def _stride(points: int) -> int:
    """Every how many points are kept."""
    return max(1, -(-points // MOST_POINTS))


def short_numbers(values: Values) -> list[float | None]:
    """Four significant digits; None breaks a line."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
