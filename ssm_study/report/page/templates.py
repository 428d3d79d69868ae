"""Charts whose data the page's script fills in: responses, signals in one axis, one played
response, groups, and all settings at once."""

import json
from typing import Any

import pandas as pd

from ssm_study.report.page.chart_looks import framed, quantitative
from ssm_study.report.words import VERDICTS, words
from ssm_study.style import BLUE, CYCLE, GREY, INK, PALE
from ssm_study.table.columns import column, swept_settings

TIME = "Time (s)"
MOST_PARALLEL = 500  # runs: more lines are no picture
PALE_FROM = 200  # runs: from here on lines are nearly transparent
PARALLEL = ("fit_test_percent", "resolved_margin", "settling_time_mean_s", "stable_fraction")
BAND = {
    "data": {"name": "band"},
    "mark": {"type": "rect", "color": PALE},
    "encoding": {"y": {"field": "low", "type": "quantitative"}, "y2": {"field": "high"}},
}
BY_OUTCOME = {
    "field": "verdict",
    "type": "nominal",
    "legend": None,
    "scale": {
        "domain": [verdict.word for verdict in VERDICTS],
        "range": [verdict.colour for verdict in VERDICTS],
    },
}


def templates(table: pd.DataFrame) -> dict[str, Any]:
    """Chart templates by name. `parallel` is there only where it has something to show."""
    found = {"responses": responses(), "signals": signals(), "played": played()}
    parallel = parallel_coordinates(table)
    return found | ({} if parallel is None else {"parallel": parallel})


def line_layer(colour: dict[str, Any], **mark: Any) -> dict[str, Any]:
    """Layer that draws lines over time from the data set `rows`."""
    return {
        "data": {"name": "rows"},
        "mark": {"type": "line", "strokeWidth": 1.4, "clip": True, **mark},
        "encoding": {
            "x": quantitative("t", TIME),
            "y": quantitative("value", None, zero=False, nice=False),
            "color": colour,
            "detail": {"field": "case"},
        },
    }


def responses() -> dict[str, Any]:
    """Chart of responses with one line per initial state over the settling band. Colours follow the
    order of their first values."""
    by_rank = {"field": "rank", "type": "ordinal", "legend": None, "scale": {"scheme": "viridis"}}
    return framed({"layer": [BAND, line_layer(by_rank)]}, "")


def signals() -> dict[str, Any]:
    """Chart of several named signals in one axis."""
    by_name = {
        "field": "kind",
        "type": "nominal",
        "sort": None,
        "scale": {"range": [GREY, *CYCLE]},  # what was measured first
        "legend": {"title": None, "orient": "top", "columns": 3, "labelLimit": 220},
    }
    return framed({"layer": [BAND, line_layer(by_name)]}, "")


def played() -> dict[str, Any]:
    """Chart of a single response that can be played. One start under control up to a moment that
    a slider or the button moves."""
    one = {"filter": "datum.case === start"}
    until = {"filter": "datum.t <= moment"}
    at_moment = [one, until, {"joinaggregate": [{"op": "max", "field": "t", "as": "last"}]}]
    point = {
        "transform": [*at_moment, {"filter": "datum.t === datum.last"}],
        "mark": {"type": "point", "filled": True, "size": 80, "color": INK, "opacity": 1},
    }
    whole = {
        "transform": [one],
        "mark": {"type": "line", "color": GREY, "opacity": 0.45, "strokeWidth": 1.2},
    }
    past = {"transform": [one, until], "mark": {"type": "line", "color": BLUE, "strokeWidth": 2}}
    drawn: list[dict[str, Any]] = [whole, past, point]
    encoding = {
        "x": quantitative("t", TIME),
        "y": quantitative("value", None, zero=False, nice=False),
    }
    layer = [{"data": {"name": "rows"}, "encoding": encoding, **part} for part in drawn]
    params = [
        {"name": "start", "value": 0, "bind": {"input": "range", "min": 0, "name": "Start "}},
        {"name": "moment", "value": 0, "bind": {"input": "range", "min": 0, "name": "Time (s) "}},
    ]
    return framed({"params": params, "layer": [BAND, *layer]}, "One start under control, played")


def parallel_coordinates(table: pd.DataFrame) -> dict[str, Any] | None:
    """Chart with a line per run over the swept settings and four results. Each axis runs from its
    smallest to its largest value; None where there is too little or too much to see."""
    candidates = [name for name in (*swept_settings(table), *PARALLEL) if name in table]
    names = [name for name in candidates if column(table, name).nunique() > 1]
    if len(names) < 3 or len(table) > MOST_PARALLEL:
        return None
    x = parallel_axis(names)
    ends = [{"op": op, "field": "value", "as": op} for op in ("min", "max")]
    share = "datum.max > datum.min ? (datum.value - datum.min) / (datum.max - datum.min) : 0.5"
    scaled = [{"joinaggregate": ends, "groupby": ["key"]}, {"calculate": share, "as": "share"}]
    known = {"filter": "isValid(datum.value) && isNumber(datum.value)"}
    fold: list[dict[str, Any]] = [{"fold": names, "as": ["key", "value"]}, known]
    opacity = 0.15 if len(table) > PALE_FROM else 0.6
    lines = {
        "transform": [*fold, *scaled],
        "mark": {"type": "line", "strokeWidth": 1.3, "opacity": opacity},
        "encoding": {
            "x": x,
            "y": {"field": "share", "type": "quantitative", "axis": None},
            "detail": {"field": "i"},
            "color": BY_OUTCOME,
        },
    }
    labels = [end_label(op, fold, x) for op in ("min", "max")]
    description = f"All runs over {', '.join(map(words, names))}: one line per run"
    return framed({"data": {"name": "rows"}, "layer": [lines, *labels]}, description, 230) | {
        "usermeta": {"fields": names}
    }


def parallel_axis(names: list[str]) -> dict[str, Any]:
    """Axis with one place for each column, named as printed, without units."""
    titles = {name: words(name).partition(" (")[0] for name in names}
    axis = {
        "labelExpr": f"({json.dumps(titles)})[datum.value]",
        "labelAngle": -20,
        "labelLimit": 150,
        "grid": True,
        "domain": False,
    }
    return {"field": "key", "type": "nominal", "sort": names, "title": None, "axis": axis}


def end_label(op: str, fold: list[dict[str, Any]], x: dict[str, Any]) -> dict[str, Any]:
    """Vega-Lite layer with the number at one end of each axis."""
    aggregated = {"aggregate": [{"op": op, "field": "value", "as": op}], "groupby": ["key"]}
    return {
        "transform": [*fold, aggregated],
        "mark": {"type": "text", "dx": 6, "align": "left", "fontSize": 10, "color": INK},
        "encoding": {
            "x": x,
            "y": {"datum": 1 if op == "max" else 0, "type": "quantitative"},
            "text": {"field": op, "format": ".3~g"},
        },
    }
