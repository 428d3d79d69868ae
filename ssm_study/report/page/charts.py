"""Plots of the report page as Vega-Lite specifications, with one point per run, coloured by
verdict. A selection in one plot applies to all."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import altair as alt
import numpy as np
import pandas as pd

from ssm_study import style
from ssm_study.report.words import VERDICTS, column_words
from ssm_study.table.columns import numeric_column

HEIGHT = 250  # pixels
SAME_FIT = 0.1  # percent: below, what fits differ by is chance


@dataclass(frozen=True)
class Panel:
    """Settings of one scatter plot of the report page: its question, its two columns, its reference
    line, and which axis may be logarithmic."""

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
PANELS = (
    Panel("Does a better fit mean a better loop?", "fit_test_percent", "stable_fraction"),
    Panel("What does a faster rate buy?", "rate_controller", "settling_time_mean_s", ALONE,
          rule_y="settling_time_open_loop_s"),
    Panel("Where does feasibility end?", "slope_ratio", "rate_controller", OWN_LIMIT, log="x",
          tick="controller_rate_limit"),
    Panel("Does the prediction hold on the plant?", "resolved_margin", "stable_fraction", ABOVE_ONE,
          log="x", rule_x=1.0),
    Panel("What does a faster rate cost?", "rate_controller", "controller_gain_norm", log="y"),
)  # fmt: skip

# The script fills these two fields with any columns. (Not x and y: Vega names a brush's own signals
# so.)
EXPLORER = Panel("Any column against any other", "across", "up")


def panels(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Plots for which a study's table has numbers, as question, columns, and specification without
    data.

    Fits that all but agree say nothing.
    """
    fits = numeric_column(table, "fit_test_percent")
    alike = fits.max() - fits.min() < SAME_FIT
    drawn = [_telling(table, panel) for panel in PANELS if not (alike and panel.x == fits.name)]
    usable = [
        panel
        for panel in drawn
        if (numeric_column(table, panel.x) * numeric_column(table, panel.y)).notna().any()
    ]
    return [vars(panel) | {"spec": specification(panel, table)} for panel in usable]


def _telling(table: pd.DataFrame, panel: Panel) -> Panel:
    """Replace the share of settled runs in a plot by the settling time where every run settles,
    since a share then says nothing."""
    shares = numeric_column(table, panel.y).dropna()
    if panel.y != "stable_fraction" or len(shares) < 2 or (shares < 1).any():
        return panel
    return replace(panel, y="settling_time_mean_s", note=f"{panel.note} {ALL_SETTLE}".strip())


def specification(panel: Panel, table: pd.DataFrame) -> dict[str, Any]:
    """Vega-Lite specification of one plot. The page's script sets the parameters `mask` (runs
    shown) and `chosen` (selected run), and reads `brush`.

    It also fills the data sets `runs` and `ticks`.
    """
    upright = [] if panel.rule_x is None else [panel.rule_x]
    median = float(numeric_column(table, panel.rule_y).median())
    level = [] if np.isnan(median) else [median]
    ticks = numeric_column(table, panel.tick).dropna().tolist()
    across = _scale(panel.x, table, panel.log == "x", upright)
    up = _scale(panel.y, table, panel.log == "y", level + ticks)
    x = alt.X(f"{panel.x}:Q", title=column_words(panel.x), scale=across)
    y = alt.Y(f"{panel.y}:Q", title=column_words(panel.y), scale=up)
    layers = [_rule().encode(x=alt.datum(value)) for value in upright]
    layers += [_rule().encode(y=alt.datum(value)) for value in level]
    if panel.tick:  # on the points' scale: one of its own would include zero
        layers.append(_bars().encode(x=x, y=alt.Y(f"{panel.tick}:Q", scale=up)))
    at_x = alt.X(f"{panel.x}:Q", scale=across)
    layers.append(_ring().encode(x=at_x, y=alt.Y(f"{panel.y}:Q", scale=up)))
    points = _points().encode(x=x, y=y)
    chart = alt.layer(*layers, points, data=alt.NamedData("runs"))
    axes = f"{column_words(panel.y)} against {column_words(panel.x)}"
    description = f"{panel.question} {axes}, one point per run"
    sized = chart.properties(width="container", height=HEIGHT, description=description)
    return _dressed(sized)


def _bars() -> alt.Chart:
    """Layer of a chart with one short bar per run for its stage times."""
    look: dict[str, Any] = {
        "color": style.INK,
        "size": 16,
        "thickness": 1,
        "opacity": 0.8,
        "aria": False,
    }
    hint = alt.TooltipContent("data")
    return alt.Chart(alt.NamedData("ticks")).mark_tick(orient="horizontal", tooltip=hint, **look)


def _ring() -> alt.Chart:
    """Layer of a chart that marks the best run, the first of the table, with a ring."""
    best = alt.Chart().transform_filter("datum.i === 0")
    return best.mark_point(size=170, strokeWidth=1.3, color=style.INK, opacity=1, aria=False)


def _dressed(chart: Any) -> dict[str, Any]:
    """Vega-Lite specification with the fonts and colours of the report page."""
    chart = chart.configure(font="system-ui, sans-serif", background="white").configure_view(
        stroke=None
    )
    spec: dict[str, Any] = chart.configure_axis(
        labelColor=style.INK, titleColor=style.INK, titleFontWeight="normal", titleFontSize=12,
        labelFontSize=11,
        # pixels: else neighbours read as one number ("1.82.0")
        labelFlush=False, labelSeparation=8,
        gridColor="#E6E6E6", domainColor=style.GREY, tickColor=style.GREY,
    ).to_dict(validate=True)  # fmt: skip
    return spec


def groups_specification() -> dict[str, Any]:
    """Vega-Lite specification of a chart with one row per group. It has a point per run, a bar at
    the mean of the visible ones, and a ring around the best.

    The script fills in the rows, the height, the name of the axis and whether it is logarithmic.
    """
    x = alt.X("value:Q", title="", scale=alt.Scale(zero=False, padding=12))
    y = alt.Y("label:N", title=None, sort=None, axis=alt.Axis(labelLimit=220, grid=True))
    shown = alt.Chart().transform_filter("!length(mask) || mask[datum.i]")
    grouped = shown.transform_aggregate(value="mean(value)", groupby=["label"])
    means = grouped.mark_tick(color=style.INK, size=20, thickness=2, opacity=1, aria=False)
    layers = [layer.encode(x=x, y=y) for layer in (means, _ring(), _points("x"))]
    chart = alt.layer(*layers, data=alt.NamedData("runs"))
    return _dressed(chart.properties(width="container", height=HEIGHT))


def _points(*brushed: Literal["x", "y"]) -> alt.Chart:
    """Layer of a chart with one point per run. A selection covers both axes, or those that are
    named."""
    mask = alt.param(name="mask", value=[])
    chosen = alt.param(name="chosen", value=-1)
    known = "!length(mask) || mask[datum.i]"
    here = "datum.i === chosen"
    names = [v.word for v in VERDICTS]
    colours = alt.Scale(domain=names, range=[v.colour for v in VERDICTS])
    shapes = alt.Scale(domain=names, range=[v.shape for v in VERDICTS])
    points = alt.Chart().mark_point(
        filled=True, strokeWidth=2, aria=False, tooltip=alt.TooltipContent("data")
    )
    color = alt.Color("verdict:N", scale=colours, legend=None)
    shape = alt.Shape("verdict:N", scale=shapes, legend=None)
    opacity = alt.condition(known, alt.value(0.85), alt.value(0.06))
    size = alt.condition(here, alt.value(220), alt.value(45))
    stroke = alt.condition(here, alt.value(style.INK), alt.value(None))
    looks = {"color": color, "shape": shape, "opacity": opacity, "size": size, "stroke": stroke}
    return points.encode(**looks).add_params(_brush(*brushed), mask, chosen)


def _brush(*encodings: Literal["x", "y"]) -> alt.Parameter:
    """Selection parameter of Vega-Lite: a rectangle that the reader of the page drags."""
    if encodings:
        return alt.selection_interval(name="brush", encodings=list(encodings))
    return alt.selection_interval(name="brush")


def _rule() -> alt.Chart:
    """Layer of a chart with a single reference line. With the data of the points, it would be drawn
    once per run."""
    return alt.Chart(alt.InlineData([{}])).mark_rule(
        strokeDash=[4, 3], color=style.GREY, aria=False
    )


def _scale(name: str, table: pd.DataFrame, log: bool, beside: list[float]) -> alt.Scale:
    """Linear or logarithmic scale for a column. It is logarithmic only if all values allow it and
    spread over more than a decade; a share goes from 0 to 1.

    `beside`: what else is drawn on this axis, so has to lie on it.
    """
    if name == "stable_fraction":
        return alt.Scale(domain=[-0.05, 1.05], nice=False)  # points at 0 and 1 are drawn whole
    values = pd.concat([numeric_column(table, name).dropna(), pd.Series(beside, dtype=float)])
    if values.empty:  # the explorer: the script fills in the column
        return alt.Scale(zero=False, padding=8)
    low = float(values.min())
    high = float(values.max())
    if log and low > 0 and high > 10 * low:
        return alt.Scale(type="log", domain=[low / 1.3, high * 1.3], nice=False)
    room = 0.05 * (high - low) or 0.1 * abs(low) or 1.0  # an axis of one value would have none
    return alt.Scale(domain=[low - room if low < 0 or low > room else 0.0, high + room], nice=False)
