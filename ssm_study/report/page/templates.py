"""Chart specifications of the report page whose data are filled in by the page's script."""

import json
from typing import Any

import pandas as pd

from ssm_study.report.page.chart_looks import framed, quantitative
from ssm_study.report.words import VERDICTS, column_words
from ssm_study.style import BLUE, CYCLE, GREY, INK, PALE
from ssm_study.table.columns import numeric_column, swept_settings

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


def chart_templates(table: pd.DataFrame) -> dict[str, Any]:
    """Vega-Lite charts, keyed by name, whose data the page's script fills in. `parallel` is there
    only if it has something to show."""
    found = {
        "responses": response_chart(),
        "signals": signal_chart(),
        "played": played_response_chart(),
    }
    parallel = parallel_coordinates(table)
    return found | ({} if parallel is None else {"parallel": parallel})


def line_layer(colour: dict[str, Any], **mark: Any) -> dict[str, Any]:
    """Layer that draws lines over time from the data set `rows`."""
    line = {"type": "line", "strokeWidth": 1.4, "clip": True, **mark}
    encoding: dict[str, Any] = {"x": quantitative("t", TIME)}
    encoding["y"] = quantitative("value", None, zero=False, nice=False)
    encoding["color"] = colour
    encoding["detail"] = {"field": "case"}
    return {"data": {"name": "rows"}, "mark": line, "encoding": encoding}


def response_chart() -> dict[str, Any]:
    """Chart of closed-loop responses, one line per initial state. Colours follow the order of their
    first values."""
    by_rank = {"field": "rank", "type": "ordinal", "legend": None, "scale": {"scheme": "viridis"}}
    return framed({"layer": [BAND, line_layer(by_rank)]}, "")


def signal_chart() -> dict[str, Any]:
    """Chart of several named signals on one pair of axes."""
    by_name: dict[str, Any] = {"field": "kind", "type": "nominal", "sort": None}
    by_name["scale"] = {"range": [GREY, *CYCLE]}  # what was measured first
    by_name["legend"] = {"title": None, "orient": "top", "columns": 3, "labelLimit": 220}
    return framed({"layer": [BAND, line_layer(by_name)]}, "")


def played_response_chart() -> dict[str, Any]:
    """Chart of a single response that the page can animate. It shows one initial state under
    control, up to a moment that a slider or the button moves."""
    one = {"filter": "datum.case === start"}
    until = {"filter": "datum.t <= moment"}
    at_moment = [one, until, {"joinaggregate": [{"op": "max", "field": "t", "as": "last"}]}]
    last = [*at_moment, {"filter": "datum.t === datum.last"}]
    dot = {"type": "point", "filled": True, "size": 80, "color": INK, "opacity": 1}
    point = {"transform": last, "mark": dot}
    faint = {"type": "line", "color": GREY, "opacity": 0.45, "strokeWidth": 1.2}
    whole = {"transform": [one], "mark": faint}
    strong = {"type": "line", "color": BLUE, "strokeWidth": 2}
    past = {"transform": [one, until], "mark": strong}
    drawn: list[dict[str, Any]] = [whole, past, point]
    y = quantitative("value", None, zero=False, nice=False)
    encoding = {"x": quantitative("t", TIME), "y": y}
    layer = [{"data": {"name": "rows"}, "encoding": encoding, **part} for part in drawn]
    start = {"input": "range", "min": 0, "name": "Start "}
    moment = {"input": "range", "min": 0, "name": "Time (s) "}
    params = [
        {"name": "start", "value": 0, "bind": start},
        {"name": "moment", "value": 0, "bind": moment},
    ]
    return framed({"params": params, "layer": [BAND, *layer]}, "One start under control, played")


def parallel_coordinates(table: pd.DataFrame) -> dict[str, Any] | None:
    """Chart with one line per run over the swept settings and four results; None with too few or
    too many runs. Each axis runs from its smallest to its largest value."""
    candidates = [name for name in (*swept_settings(table), *PARALLEL) if name in table]
    names = [name for name in candidates if numeric_column(table, name).nunique() > 1]
    if len(names) < 3 or len(table) > MOST_PARALLEL:
        return None
    x = parallel_axis(names)
    ends = [{"op": op, "field": "value", "as": op} for op in ("min", "max")]
    share = "datum.max > datum.min ? (datum.value - datum.min) / (datum.max - datum.min) : 0.5"
    scaled = [{"joinaggregate": ends, "groupby": ["key"]}, {"calculate": share, "as": "share"}]
    known = {"filter": "isValid(datum.value) && isNumber(datum.value)"}
    fold: list[dict[str, Any]] = [{"fold": names, "as": ["key", "value"]}, known]
    opacity = 0.15 if len(table) > PALE_FROM else 0.6
    mark = {"type": "line", "strokeWidth": 1.3, "opacity": opacity}
    y = {"field": "share", "type": "quantitative", "axis": None}
    encoding = {"x": x, "y": y, "detail": {"field": "i"}, "color": BY_OUTCOME}
    lines = {"transform": [*fold, *scaled], "mark": mark, "encoding": encoding}
    labels = [end_label(op, fold, x) for op in ("min", "max")]
    description = f"All runs over {', '.join(map(column_words, names))}: one line per run"
    spec = {"data": {"name": "rows"}, "layer": [lines, *labels], "usermeta": {"fields": names}}
    return framed(spec, description, 230)


def parallel_axis(names: list[str]) -> dict[str, Any]:
    """Axis with one place for each column, which has its printed name without unit."""
    titles = {name: column_words(name).partition(" (")[0] for name in names}
    axis = {
        "labelExpr": f"({json.dumps(titles)})[datum.value]",
        "labelAngle": -20,
        "labelLimit": 150,
        "grid": True,
        "domain": False,
    }
    return {"field": "key", "type": "nominal", "sort": names, "title": None, "axis": axis}


def end_label(op: str, fold: list[dict[str, Any]], x: dict[str, Any]) -> dict[str, Any]:
    """Vega-Lite layer with the number at one end of each axis of a parallel-coordinates chart."""
    aggregated = {"aggregate": [{"op": op, "field": "value", "as": op}], "groupby": ["key"]}
    mark = {"type": "text", "dx": 6, "align": "left", "fontSize": 10, "color": INK}
    y = {"datum": 1 if op == "max" else 0, "type": "quantitative"}
    encoding = {"x": x, "y": y, "text": {"field": op, "format": ".3~g"}}
    return {"transform": [*fold, aggregated], "mark": mark, "encoding": encoding}
