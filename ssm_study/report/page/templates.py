"""Chart specifications of the report page whose data are filled in by the page's script."""

import json
import textwrap

import pandas as pd

from ssm_study.report.page.chart_looks import (
    Spec,
    framed_specification,
    horizontal_legend,
    quantitative_axis,
)
from ssm_study.report.words import VERDICTS, printed_column_name
from ssm_study.style import BLUE, CYCLE, GREY, INK, PALE
from ssm_study.table.columns import numeric_column, swept_settings

TIME = "Time (s)"
MOST_PARALLEL = 500  # runs: more lines are no picture
FEWEST_AXES = 3
PARALLEL_HEIGHT = 230  # pixels
PALE_FROM = 200  # runs: from here on lines are nearly transparent
PALE_OPACITY = 0.15
OPACITY = 0.6
PARALLEL = ("fit_test_percent", "resolved_margin", "settling_time_mean_s", "stable_fraction")
LABEL_ROOM = 9  # pixels
LABEL_LETTERS = 10  # in a line of an axis' name: five axes stand beside each other on a phone
ENDS = ("min", "max")
ROWS = {"name": "rows"}
BAND_MARK = {"type": "rect", "color": PALE}
BAND_LOW = {"field": "low", "type": "quantitative"}
BAND_HIGH = {"field": "high"}
BAND_ENCODING = {"y": BAND_LOW, "y2": BAND_HIGH}
BAND = {"data": {"name": "band"}, "mark": BAND_MARK, "encoding": BAND_ENCODING}
OUTCOME_NAMES = [verdict.word for verdict in VERDICTS]
OUTCOME_COLOURS = [verdict.colour for verdict in VERDICTS]
OUTCOME_SCALE = {"domain": OUTCOME_NAMES, "range": OUTCOME_COLOURS}
BY_OUTCOME = {"field": "verdict", "type": "nominal", "legend": None, "scale": OUTCOME_SCALE}


def chart_templates(table: pd.DataFrame) -> Spec:
    """Vega-Lite charts of the report page, keyed by name, whose data the page's script fills in.
    `parallel` is there only if it has something to show."""
    charts = {"responses": response_chart()}
    charts["signals"] = signal_chart()
    charts["played"] = animated_response_chart()
    parallel = parallel_coordinates(table)
    if parallel is not None:
        charts["parallel"] = parallel
    return charts


def time_axes() -> Spec:
    """Vega-Lite axes of a chart over time, whose value range need not include zero."""
    x = quantitative_axis("t", TIME)
    y = quantitative_axis("value", None, zero=False, nice=False)
    return {"x": x, "y": y}


def line_layer(colour: Spec) -> Spec:
    """Layer of a Vega-Lite chart that draws lines over time."""
    line = {"type": "line", "strokeWidth": 1.4, "clip": True}
    encoding = time_axes()
    encoding["color"] = colour
    encoding["detail"] = {"field": "case"}
    return {"data": ROWS, "mark": line, "encoding": encoding}


def response_chart() -> Spec:
    """Chart of closed-loop responses over time, one line per initial state. Colours follow the
    order of their first values."""
    by_rank: Spec = {"field": "rank", "type": "ordinal", "legend": None}
    by_rank["scale"] = {"scheme": "viridis"}
    lines = line_layer(by_rank)
    return framed_specification({"layer": [BAND, lines]}, "")


def signal_chart() -> Spec:
    """Chart of several named signals on one pair of axes."""
    by_name: Spec = {"field": "kind", "type": "nominal", "sort": None}
    by_name["scale"] = {"range": [GREY, *CYCLE]}  # what was measured first
    by_name["legend"] = horizontal_legend(3, 220)
    lines = line_layer(by_name)
    return framed_specification({"layer": [BAND, lines]}, "")


def animated_response_chart() -> Spec:
    """Chart of a single closed-loop response that the report page can animate. It shows one initial
    state under control, up to a moment that a slider or the button moves."""
    params = [slider_parameter("start", "Start "), slider_parameter("moment", "Time (s) ")]
    layers = [layer_over_time(part) for part in animated_response_layers()]
    chart = {"params": params, "layer": [BAND, *layers]}
    return framed_specification(chart, "One start under control, played")


def slider_parameter(name: str, label: str) -> Spec:
    """Vega-Lite parameter whose value a slider of the report page sets."""
    slider = {"input": "range", "min": 0, "name": label}
    return {"name": name, "value": 0, "bind": slider}


def animated_response_layers() -> list[Spec]:
    """Layers of an animated response: the full curve, its past part and the present point."""
    of_start = {"filter": "datum.case === start - 1"}  # the reader counts from one
    until_moment = {"filter": "datum.t <= moment"}
    latest_time = {"op": "max", "field": "t", "as": "last"}
    add_latest = {"joinaggregate": [latest_time]}
    at_latest = {"filter": "datum.t === datum.last"}
    faint = {"type": "line", "color": GREY, "opacity": 0.45, "strokeWidth": 1.2}
    strong = {"type": "line", "color": BLUE, "strokeWidth": 2}
    dot = {"type": "point", "filled": True, "size": 80, "color": INK, "opacity": 1}
    whole = {"transform": [of_start], "mark": faint}
    past = {"transform": [of_start, until_moment], "mark": strong}
    point = {"transform": [of_start, until_moment, add_latest, at_latest], "mark": dot}
    return [whole, past, point]


def layer_over_time(marks: Spec) -> Spec:
    """Layer of a Vega-Lite chart that draws data over time with given marks."""
    return {"data": ROWS, "encoding": time_axes(), **marks}


def parallel_coordinates(table: pd.DataFrame) -> Spec | None:
    """Parallel-coordinates chart of a study, with one line per run over the swept settings and four
    results. None with too few or too many runs. Each axis runs from its smallest to its largest
    value."""
    names = parallel_coordinate_columns(table)
    if len(names) < FEWEST_AXES or len(table) > MOST_PARALLEL:
        return None
    x = parallel_axis(names)
    fold = unpivot_columns(names)
    layers = [parallel_lines(fold, x, len(table))]
    layers += [axis_end_label(end, fold, x) for end in ENDS]
    listed = ", ".join(map(printed_column_name, names))
    description = f"All runs over {listed}: one line per run"
    spec: Spec = {"data": ROWS, "layer": layers}
    spec["usermeta"] = {"fields": names}
    return framed_specification(spec, description, PARALLEL_HEIGHT)


def parallel_coordinate_columns(table: pd.DataFrame) -> list[str]:
    """Names of the swept settings and results in which the runs of a study differ."""
    candidates = (*swept_settings(table), *PARALLEL)
    present = [name for name in candidates if name in table]
    return [name for name in present if numeric_column(table, name).nunique() > 1]


def unpivot_columns(names: list[str]) -> list[Spec]:
    """Vega-Lite transform to long form: one row for each run and column."""
    fold = {"fold": names, "as": ["key", "value"]}
    known_filter = {"filter": "isValid(datum.value) && isNumber(datum.value)"}
    return [fold, known_filter]


def parallel_lines(fold: list[Spec], x: Spec, runs: int) -> Spec:
    """Layer of a parallel-coordinates chart with one line per run, each axis scaled to the range of
    the runs."""
    ends = [aggregate_value(end) for end in ENDS]
    add_ends = {"joinaggregate": ends, "groupby": ["key"]}
    share = "datum.max > datum.min ? (datum.value - datum.min) / (datum.max - datum.min) : 0.5"
    scale = {"calculate": share, "as": "share"}
    opacity = PALE_OPACITY if runs > PALE_FROM else OPACITY
    mark = {"type": "line", "strokeWidth": 1.3, "opacity": opacity}
    y = {"field": "share", "type": "quantitative", "axis": None}
    encoding = {"x": x, "y": y, "detail": {"field": "i"}}
    encoding["color"] = BY_OUTCOME
    return {"transform": [*fold, add_ends, scale], "mark": mark, "encoding": encoding}


def aggregate_value(operation: str) -> Spec:
    """Vega-Lite aggregate, such as minimum or maximum, of the column `value`."""
    return {"op": operation, "field": "value", "as": operation}


def parallel_axis(names: list[str]) -> Spec:
    """Horizontal axis of a parallel-coordinates chart, with one place for each column."""
    titles = {name: textwrap.wrap(printed_column_name(name), LABEL_LETTERS) for name in names}
    written_titles = json.dumps(titles)
    axis: Spec = {"labelExpr": f"({written_titles})[datum.value]"}
    axis["labelAngle"] = 0
    axis["labelFontSize"] = 9.5
    axis["labelPadding"] = LABEL_ROOM
    axis["grid"] = True
    axis["domain"] = False
    x: Spec = {"field": "key", "type": "nominal", "sort": names}
    x["title"] = None
    x["axis"] = axis
    return x


def axis_end_label(end: str, fold: list[Spec], x: Spec) -> Spec:
    """Vega-Lite layer with the number at one end of each axis of a parallel-coordinates chart."""
    aggregate = {"aggregate": [aggregate_value(end)], "groupby": ["key"]}
    height = 1 if end == "max" else 0
    away = -LABEL_ROOM if height else LABEL_ROOM  # above or below the lines, which would cross it
    mark = {"type": "text", "dy": away, "fontSize": 10, "color": INK}
    y = {"datum": height, "type": "quantitative"}
    text = {"field": end, "format": ".3~g"}
    encoding = {"x": x, "y": y, "text": text}
    return {"transform": [*fold, aggregate], "mark": mark, "encoding": encoding}
