"""The page's plots as Vega-Lite specifications: one point per run, brushed together, coloured by verdict."""

from dataclasses import dataclass
from typing import Any

import altair as alt
import pandas as pd

from ssm_study.report import style, verdict
from ssm_study.report.columns import column, words

SHAPES = {
    verdict.SETTLED.word: "circle",
    verdict.LOST.word: "triangle-up",
    verdict.UNCERTIFIED.word: "square",
    verdict.IDENTIFIED.word: "triangle-down",
    verdict.INFEASIBLE.word: "cross",
    verdict.FAILED.word: "diamond",
}
HEIGHT = 250


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One plot: what it asks, the two columns, where a rule stands, and whether an axis is logarithmic if it can be."""

    question: str
    note: str = ""
    x: str
    y: str
    log_x: bool = False
    log_y: bool = False
    rule_x: float | None = None
    rule_y_column: str | None = None  # a horizontal rule at its median
    tick_column: str | None = None  # a short bar per run at this height


PANELS = (
    Panel(question="Does a better fit mean a better loop?", x="fit_test_percent", y="stable_fraction"),
    Panel(
        question="What does a faster rate buy?",
        note="Dashed: the plant left alone.",
        x="rate_controller",
        y="settling_time_mean_s",
        rule_y_column="settling_time_open_loop_s",
    ),
    Panel(
        question="Where does feasibility end?",
        note="Bars: the exact rate limit of each model; nothing above its own bar can be certified.",
        x="slope_ratio",
        y="rate_controller",
        log_x=True,
        tick_column="controller_rate_limit",
    ),
    Panel(
        question="Does the mismatch margin foretell the plant?",
        note="Dashed: margin one; to its right every start should settle.",
        x="mismatch_margin",
        y="stable_fraction",
        log_x=True,
        rule_x=1.0,
    ),
    Panel(
        question="Does the margin by frequency foretell the plant?",
        note="Dashed: margin one; to its right every start should settle.",
        x="resolved_margin",
        y="stable_fraction",
        log_x=True,
        rule_x=1.0,
    ),
    Panel(question="What does a faster rate cost?", x="rate_controller", y="controller_gain_norm", log_y=True),
)


# The script fills these two fields with any columns. (Not x and y: Vega names a brush's own signals so.)
EXPLORER = Panel(question="Any column against any other", x="across", y="up")


def panels(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The plots this table has numbers for: question, columns used, and specification without data."""
    usable = [p for p in PANELS if (column(table, p.x).notna() & column(table, p.y).notna()).any()]
    return [
        {
            "question": p.question,
            "note": p.note,
            "x": p.x,
            "y": p.y,
            "tick": p.tick_column,
            "spec": specification(p, table),
        }
        for p in usable
    ]


def specification(panel: Panel, table: pd.DataFrame) -> dict[str, Any]:
    """The script sets the parameters `mask` (runs shown) and `chosen` (run looked at), and hears `brush`.

    It also fills the data sets `runs` and `ticks`.
    """
    points = _points(panel, table)
    layers = [*_rules(panel, table), points]
    chart = alt.layer(*layers, data=alt.NamedData("runs")).properties(width="container", height=HEIGHT)
    chart = chart.properties(
        description=f"{panel.question} {words(panel.y)} against {words(panel.x)}, one point per run"
    )
    chart = chart.configure(font="system-ui, sans-serif", background="white").configure_view(stroke=None)
    chart = chart.configure_axis(
        labelColor=style.INK, titleColor=style.INK, titleFontWeight="normal", titleFontSize=12, labelFontSize=11,
        gridColor="#E6E6E6", domainColor=style.GREY, tickColor=style.GREY,
    )  # fmt: skip
    spec: dict[str, Any] = chart.to_dict(validate=True)
    return spec


def _points(panel: Panel, table: pd.DataFrame) -> alt.Chart:
    mask, chosen = alt.param(name="mask", value=[]), alt.param(name="chosen", value=-1)
    known, here = "!length(mask) || mask[datum.i]", "datum.i === chosen"
    verdicts = [v.word for v in verdict.ALL]
    colours, shapes = [v.colour for v in verdict.ALL], [SHAPES[word] for word in verdicts]
    return (
        alt.Chart()
        .mark_point(filled=True, strokeWidth=2, aria=False, tooltip=alt.TooltipContent("data"))
        .encode(
            x=_axis(alt.X, panel.x, table, panel.log_x, [] if panel.rule_x is None else [panel.rule_x]),
            y=_axis(alt.Y, panel.y, table, panel.log_y, [*_rule_height(panel, table), *_tick_heights(panel, table)]),
            color=alt.Color("verdict:N", scale=alt.Scale(domain=verdicts, range=colours), legend=None),
            shape=alt.Shape("verdict:N", scale=alt.Scale(domain=verdicts, range=shapes), legend=None),
            opacity=alt.condition(known, alt.value(0.85), alt.value(0.06)),
            size=alt.condition(here, alt.value(220), alt.value(45)),
            stroke=alt.condition(here, alt.value(style.INK), alt.value(None)),
        )
        .add_params(alt.selection_interval(name="brush"), mask, chosen)
    )


def _rules(panel: Panel, table: pd.DataFrame) -> list[alt.Chart]:
    found = []
    if panel.rule_x is not None:
        found.append(_rule().encode(x=alt.datum(panel.rule_x)))
    found += [_rule().encode(y=alt.datum(height)) for height in _rule_height(panel, table)]
    if panel.tick_column:
        tick = alt.Chart(alt.NamedData("ticks")).mark_tick(
            orient="horizontal", color=style.INK, size=16, thickness=1, opacity=0.8, aria=False,
            tooltip=alt.TooltipContent("data"),
        )  # fmt: skip
        x, y = alt.X(f"{panel.x}:Q"), alt.Y(f"{panel.tick_column}:Q")
        found.append(tick.encode(x=x, y=y))
    return found


def _rule_height(panel: Panel, table: pd.DataFrame) -> list[float]:
    known = column(table, panel.rule_y_column).dropna() if panel.rule_y_column else pd.Series(dtype=float)
    return [] if known.empty else [float(known.median())]


def _tick_heights(panel: Panel, table: pd.DataFrame) -> list[float]:
    return list(column(table, panel.tick_column).dropna()) if panel.tick_column else []


def _rule() -> alt.Chart:
    """One line: on the data of the points it would be drawn once per run."""
    return alt.Chart(alt.InlineData([{}])).mark_rule(strokeDash=[4, 3], color=style.GREY, aria=False)


def _axis(kind: Any, name: str, table: pd.DataFrame, log: bool, beside: list[float]) -> Any:
    """Logarithmic only if all values allow it and they spread over more than a decade; a share from 0 to 1.

    `beside`: what else is drawn on this axis, so has to lie on it.
    """
    if name == "stable_fraction":
        return kind(f"{name}:Q", title=words(name), scale=alt.Scale(domain=[-0.05, 1.05], nice=False))
    values = pd.concat([column(table, name).dropna(), pd.Series(beside, dtype=float)])
    if values.nunique() == 1:  # an axis of one value would have no room around it
        only = float(values.iloc[0])
        room = 0.1 * abs(only) or 1.0
        return kind(f"{name}:Q", title=words(name), scale=alt.Scale(domain=[only - room, only + room], nice=False))
    spread = log and bool((values > 0).all()) and float(values.max()) > 10 * float(values.min())
    scale = alt.Scale(type="log", padding=8) if spread else alt.Scale(zero=False, padding=8)
    return kind(f"{name}:Q", title=words(name), scale=scale)
