"""Plots of the report page as Vega-Lite specifications, with one point per run, coloured by
verdict. A selection in one plot applies to all."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, Literal

import altair as alt
import numpy as np
import pandas as pd

from ssm_study import style
from ssm_study.report.answers import Answer
from ssm_study.report.words import VERDICTS, printed_column_name
from ssm_study.table.columns import numeric_column

HEIGHT = 250  # pixels
Axis = Literal["x", "y"]
SAME_FIT = 0.1  # percent: below, what fits differ by is chance


@dataclass(frozen=True)
class ScatterPlot:
    """Settings of one scatter plot of the report page: question, two columns, reference line, kinds
    of axes."""

    question: str
    x: str
    y: str
    note: str = ""
    log: str = ""
    rule_x: float | None = None
    rule_y: str = ""  # a column: a horizontal rule at its median
    tick: str = ""  # a column: a short bar per run at this height


ABOVE_ONE = "Dashed: margin one; to its right every start should settle."
ALL_SETTLE = "All starts settle, so the plot shows how fast."
OWN_LIMIT = "Bars: the exact rate limit of each model; nothing above its own bar can be certified."
ALONE = "Dashed: the uncontrolled plant."
FIT_AND_LOOP = ScatterPlot(
    "Does a better fit mean a better loop?", "fit_test_percent", "stable_fraction"
)
RATE_BUYS = ScatterPlot(
    "What does a faster rate buy?",
    "rate_controller",
    "settling_time_mean_s",
    ALONE,
    rule_y="settling_time_open_loop_s",
)
FEASIBILITY = ScatterPlot(
    "Where does feasibility end?",
    "slope_ratio",
    "rate_controller",
    OWN_LIMIT,
    log="x",
    tick="controller_rate_limit",
)
PREDICTION = ScatterPlot(
    "Does the prediction hold on the plant?",
    "resolved_margin",
    "stable_fraction",
    ABOVE_ONE,
    log="x",
    rule_x=1.0,
)
RATE_COSTS = ScatterPlot(
    "What does a faster rate cost?", "rate_controller", "controller_gain_norm", log="y"
)
PANELS = (FIT_AND_LOOP, RATE_BUYS, FEASIBILITY, PREDICTION, RATE_COSTS)

# The script fills these two fields with any columns. (Not x and y: Vega names a brush's own signals
# so.)
EXPLORER = ScatterPlot("Any column against any other", "across", "up")


RUNS = alt.NamedData("runs")
SHOWN = "!length(mask) || mask[datum.i]"  # Vega's words for: the run is among those shown
CHOSEN = "datum.i === chosen"
BEST = "datum.i === 0"
EDGE = 1.3  # factor: room beside the values on a logarithmic axis
AXIS_LOOK: dict[str, Any] = {
    "labelColor": style.INK,
    "titleColor": style.INK,
    "titleFontWeight": "normal",
    "titleFontSize": 12,
    "labelFontSize": 11,
    # pixels: else neighbours read as one number ("1.82.0")
    "labelFlush": False,
    "labelSeparation": 8,
    "gridColor": "#E6E6E6",
    "domainColor": style.GREY,
    "tickColor": style.GREY,
}
BAR_LOOK: dict[str, Any] = {"color": style.INK, "size": 16, "thickness": 1}
BAR_LOOK |= {"opacity": 0.8, "aria": False}
MEAN_LOOK: dict[str, Any] = {"color": style.INK, "size": 20, "thickness": 2}
MEAN_LOOK |= {"opacity": 1, "aria": False}
RING_LOOK: dict[str, Any] = {"size": 170, "strokeWidth": 1.3, "color": style.INK}
RING_LOOK |= {"opacity": 1, "aria": False}
RULE_LOOK: dict[str, Any] = {"strokeDash": [4, 3], "color": style.GREY, "aria": False}


def scatter_plot_contents(
    table: pd.DataFrame, answered: Collection[Answer] = ()
) -> list[dict[str, Any]]:
    """Content of each scatter plot that the report page shows: question, columns, chart
    specification. The sentences of an answer stand with the plot of its question."""
    drawn = []
    for panel in scatter_plots_with_data(table):
        spec = scatter_plot_specification(panel, table)
        stem = question_beginning(panel.question)
        answer = next((a for a in answered if question_beginning(a.question) == stem), None)
        content = vars(panel) | {"spec": spec, "sentences": []}
        if answer is not None:
            content["question"] = answer.question
            content["sentences"] = list(answer.sentences)
        drawn.append(content)
    return drawn


def scatter_plots_with_data(table: pd.DataFrame) -> list[ScatterPlot]:
    """Scatter plots that a study's table has enough numbers for. Plots against fits that are nearly
    equal are left out, since they show nothing."""
    fits = numeric_column(table, "fit_test_percent")
    alike = fits.max() - fits.min() < SAME_FIT
    candidates = [panel for panel in PANELS if not (alike and panel.x == fits.name)]
    telling = [_replace_constant_settled_fraction(table, panel) for panel in candidates]
    return [panel for panel in telling if _has_numbers(table, panel)]


def unplotted_answers(table: pd.DataFrame, answered: Collection[Answer]) -> list[Answer]:
    """Answers to questions about a study for which the report page has no plot. A single run has no
    plots at all."""
    plotted = set()
    if len(table) > 1:
        plotted = {question_beginning(panel.question) for panel in scatter_plots_with_data(table)}
    return [answer for answer in answered if question_beginning(answer.question) not in plotted]


def question_beginning(question: str) -> str:
    """First three words of a question, by which the report page pairs a chart with an answer."""
    return " ".join(question.split()[:3])


def _has_numbers(table: pd.DataFrame, panel: ScatterPlot) -> bool:
    """Whether at least one run has a number in both columns of a scatter plot."""
    across = numeric_column(table, panel.x)
    up = numeric_column(table, panel.y)
    return bool((across * up).notna().any())


def _replace_constant_settled_fraction(table: pd.DataFrame, panel: ScatterPlot) -> ScatterPlot:
    """Plot the settling time instead of the settled fraction if every initial state settles."""
    if panel.y != "stable_fraction":
        return panel
    shares = numeric_column(table, panel.y).dropna()
    if len(shares) < 2 or (shares < 1).any():
        return panel
    note = f"{panel.note} {ALL_SETTLE}".strip()
    return replace(panel, y="settling_time_mean_s", note=note)


def scatter_plot_specification(panel: ScatterPlot, table: pd.DataFrame) -> dict[str, Any]:
    """Vega-Lite specification of one scatter plot of the report page. The page's script sets the
    parameters `mask` (runs shown) and `chosen` (selected run), and reads `brush`.

    It also fills the data sets `runs` and `ticks`.
    """
    upright = [] if panel.rule_x is None else [panel.rule_x]
    level = _reference_heights(panel, table)
    ticks = numeric_column(table, panel.tick).dropna().tolist()
    across = _axis_scale(panel.x, table, panel.log == "x", upright)
    up = _axis_scale(panel.y, table, panel.log == "y", level + ticks)
    x_words = printed_column_name(panel.x)
    y_words = printed_column_name(panel.y)
    x = alt.X(f"{panel.x}:Q", title=x_words, scale=across)
    y = alt.Y(f"{panel.y}:Q", title=y_words, scale=up)
    layers = [_reference_line().encode(x=alt.datum(value)) for value in upright]
    layers += [_reference_line().encode(y=alt.datum(value)) for value in level]
    if panel.tick:  # on the points' scale: one of its own would include zero
        bar_height = alt.Y(f"{panel.tick}:Q", scale=up)
        layers.append(_stage_time_bars().encode(x=x, y=bar_height))
    ring_x = alt.X(f"{panel.x}:Q", scale=across)
    ring_y = alt.Y(f"{panel.y}:Q", scale=up)
    layers.append(_best_run_ring().encode(x=ring_x, y=ring_y))
    layers.append(_run_points().encode(x=x, y=y))
    chart = alt.layer(*layers, data=RUNS)
    description = f"{panel.question} {y_words} against {x_words}, one point per run"
    return _styled_specification(chart, description=description)


def _reference_heights(panel: ScatterPlot, table: pd.DataFrame) -> list[float]:
    """Height of a plot's horizontal reference line, as a list that is empty if there is none."""
    values = numeric_column(table, panel.rule_y)
    median = float(values.median())
    return [] if np.isnan(median) else [median]


def _stage_time_bars() -> alt.Chart:
    """Layer of a chart with one short bar for each run that shows the computing times of its
    steps."""
    hint = alt.TooltipContent("data")
    chart = alt.Chart(alt.NamedData("ticks"))
    return chart.mark_tick(orient="horizontal", tooltip=hint, **BAR_LOOK)


def _best_run_ring() -> alt.Chart:
    """Layer of a chart with a ring around the point of the best run."""
    best = alt.Chart().transform_filter(BEST)
    return best.mark_point(**RING_LOOK)


def _styled_specification(chart: Any, **properties: Any) -> dict[str, Any]:
    """Vega-Lite specification of a chart with the fonts and colours of the report page.

    Not compared with the schema of Vega-Lite, which takes half the time of a page; a test does so.
    """
    sized = chart.properties(width="container", height=HEIGHT, **properties)
    plain = sized.configure(font="system-ui, sans-serif", background="white")
    frameless = plain.configure_view(stroke=None)
    dressed = frameless.configure_axis(**AXIS_LOOK)
    spec: dict[str, Any] = dressed.to_dict(validate=False)
    return spec


def group_chart_specification() -> dict[str, Any]:
    """Vega-Lite specification of a chart with one row for all runs that share a setting. It has a
    point per run, a bar at the mean of the visible ones, and a ring around the best.

    The script fills in the rows, the height, the name of the axis and whether it is logarithmic.
    """
    scale = alt.Scale(zero=False, padding=12)
    axis = alt.Axis(labelLimit=220, grid=True)
    few_ticks = alt.Axis(tickCount=8)
    x = alt.X("value:Q", title="", scale=scale, axis=few_ticks)
    y = alt.Y("label:N", title=None, sort=None, axis=axis)
    visible = alt.Chart().transform_filter(SHOWN)
    grouped = visible.transform_aggregate(value="mean(value)", groupby=["label"])
    means = grouped.mark_tick(**MEAN_LOOK)
    parts = (means, _best_run_ring(), _run_points("x"))
    layers = [part.encode(x=x, y=y) for part in parts]
    chart = alt.layer(*layers, data=RUNS)
    return _styled_specification(chart)


def _run_points(*brushed: Axis) -> alt.Chart:
    """Layer of a chart with one point for each run of a study. A selection covers both axes, or
    those that are named."""
    mask = alt.param(name="mask", value=[])
    chosen = alt.param(name="chosen", value=-1)
    hint = alt.TooltipContent("data")
    points = alt.Chart().mark_point(filled=True, strokeWidth=2, aria=False, tooltip=hint)
    encodings = _encode_verdicts() | _encode_selection()
    return points.encode(**encodings).add_params(_brush_selection(*brushed), mask, chosen)


def _encode_verdicts() -> dict[str, Any]:
    """Colour and shape of a point in a chart, by the verdict of its run."""
    names = [verdict.word for verdict in VERDICTS]
    colours = [verdict.colour for verdict in VERDICTS]
    shapes = [verdict.shape for verdict in VERDICTS]
    colour_scale = alt.Scale(domain=names, range=colours)
    shape_scale = alt.Scale(domain=names, range=shapes)
    color = alt.Color("verdict:N", scale=colour_scale, legend=None)
    shape = alt.Shape("verdict:N", scale=shape_scale, legend=None)
    return {"color": color, "shape": shape}


def _encode_selection() -> dict[str, Any]:
    """Settings that fade a run's point in a chart while the run is filtered out, and enlarge the
    point while the run is selected.

    As objects: finding the class of a dictionary takes Altair a third of the time of the charts.
    """
    opacity = alt.condition(SHOWN, alt.value(0.85), alt.value(0.06))
    size = alt.condition(CHOSEN, alt.value(220), alt.value(45))
    stroke = alt.condition(CHOSEN, alt.value(style.INK), alt.value(None))
    return {
        "opacity": alt.OpacityValue(**opacity),
        "size": alt.SizeValue(**size),
        "stroke": alt.StrokeValue(**stroke),
    }


def _brush_selection(*encodings: Axis) -> alt.Parameter:
    """Vega-Lite selection by a rectangle that the reader of the page drags."""
    if encodings:
        return alt.selection_interval(name="brush", encodings=list(encodings))
    return alt.selection_interval(name="brush")


def _reference_line() -> alt.Chart:
    """Layer of a chart with a single horizontal reference line. With the data of the points, it
    would be drawn once per run."""
    chart = alt.Chart(alt.InlineData([{}]))
    return chart.mark_rule(**RULE_LOOK)


def _axis_scale(
    name: str, table: pd.DataFrame, log: bool, further_values: list[float]
) -> alt.Scale:
    """Linear or logarithmic scale of a chart's axis for a column. It is logarithmic only if all
    values allow it and spread over more than a decade; a share goes from 0 to 1.

    `further_values`: what else is drawn on this axis, so has to lie on it.
    """
    if name == "stable_fraction":
        return alt.Scale(domain=[-0.05, 1.05], nice=False)  # points at 0 and 1 are drawn whole
    own = numeric_column(table, name).dropna()
    others = pd.Series(further_values, dtype=float)
    values = pd.concat([own, others])
    if values.empty:  # the explorer: the script fills in the column
        return alt.Scale(zero=False, padding=8)
    low = float(values.min())
    high = float(values.max())
    if log and low > 0 and high > 10 * low:
        return alt.Scale(type="log", domain=[low / EDGE, high * EDGE], nice=False)
    room = 0.05 * (high - low) or 0.1 * abs(low) or 1.0  # an axis of one value would have none
    reaches_zero = 0 <= low <= room
    lowest = 0.0 if reaches_zero else low - room
    return alt.Scale(domain=[lowest, high + room], nice=False)
