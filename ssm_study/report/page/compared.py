"""Comparisons of controllers on the model and plant of one run: by test condition, or of many
certified designs."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from ssm_study.certificates.decay_time import plain_digits
from ssm_study.report.page.chart_looks import STROKES, Spec, framed_specification, quantitative_axis
from ssm_study.report.words import choice_label
from ssm_study.style import BLUE

HEADS = ("Settled", "Mean settling (s)", "Worst (s)", "Peak input", "Mismatch margin", "Certified")
NUMBERS = ("settling_time_mean_s", "settling_time_worst_s", "input_peak_v", "mismatch_margin")
NOT_SETTLED = "rgb(179 89 0 / {:.0f}%)"  # the fewer settle the darker; the number says it too
MISSING = "–"
OF_ONE_SITUATION = "Controllers on this run's plant, from the same starts"
OF_SITUATIONS = "Controllers on this run's plant: share settled, mean settling time of those"
DESIGNS = (
    "Share of starts settled on the plant against mismatch margin, one point per certified design"
)


@dataclass(frozen=True, kw_only=True)
class ControllerTable:
    """Printed table of compared controllers: its caption, headings, and cells with or without a
    background."""

    caption: str
    heads: tuple[str, ...]
    rows: list[tuple[str, list[tuple[str, str]]]]


def comparison_json(rows: pd.DataFrame) -> Spec:
    """Comparison of the controllers tried in a run, as JSON values for a table or a chart."""
    rows = rows.dropna(axis="columns", how="all")
    if "controller" in rows:
        return {"table": table_html(controllers_table(rows))}
    return {"chart": settled_fraction_chart(rows)}


def controllers_table(rows: pd.DataFrame) -> ControllerTable:
    """Printed table that compares controllers, with one row for each. Its columns are the numbers
    of a single situation, or all situations."""
    situations = list(dict.fromkeys(rows["situation"]))
    if len(situations) == 1:
        return single_condition_table(rows)
    return conditions_table(rows, situations)


def single_condition_table(rows: pd.DataFrame) -> ControllerTable:
    """Printed table with the results of each controller under a single test condition."""
    cells = []
    for name, own in rows.groupby("controller", sort=False):
        first = own.iloc[0]
        cells.append((choice_label(name), single_condition_cells(first)))
    return ControllerTable(caption=OF_ONE_SITUATION, heads=HEADS, rows=cells)


def conditions_table(rows: pd.DataFrame, situations: list[str]) -> ControllerTable:
    """Printed table with one column for each test condition: fraction of settled loops and mean
    settling time."""
    tried: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows.to_dict("records"):
        named = {str(name): value for name, value in row.items()}
        key = (str(row["controller"]), str(row["situation"]))
        tried.setdefault(key, named)
    cells = []
    for name in dict.fromkeys(rows["controller"]):
        own = [tried.get((name, situation), {}) for situation in situations]
        cells.append((choice_label(name), list(map(settled_fraction_cell, own))))
    heads = tuple(map(choice_label, situations))
    return ControllerTable(caption=OF_SITUATIONS, heads=heads, rows=cells)


def single_condition_cells(row: "pd.Series[Any]") -> list[tuple[str, str]]:
    """Table cells with the results of one controller under a single test condition."""
    texts = [format_percent(row.get("stable_fraction"))]
    texts += [format_number(row.get(name)) for name in NUMBERS]
    is_certified = row.get("certified") == 1  # True, or what a table of numbers makes of it
    texts.append("yes" if is_certified else MISSING)
    return [(text, "") for text in texts]


def settled_fraction_cell(row: dict[str, Any]) -> tuple[str, str]:
    """Table cell with the fraction of initial states from which a loop settles, and the mean
    settling time."""
    share = row.get("stable_fraction", np.nan)
    if pd.isna(share):
        return MISSING, ""
    words = format_percent(share)
    time_s = row.get("settling_time_mean_s")
    if time_s is not None and not pd.isna(time_s):
        words += f" {plain_digits(time_s)} s"
    shade = NOT_SETTLED.format(45 * (1 - float(share)))
    return words, shade


def format_percent(fraction: Any) -> str:
    """Text of a fraction in per cent."""
    return MISSING if pd.isna(fraction) else f"{100 * fraction:.0f} %"


def format_number(value: Any) -> str:
    """Text of a number with four significant digits; a placeholder for a missing number."""
    return MISSING if pd.isna(value) else f"{value:.4g}"


def table_html(table: ControllerTable) -> str:
    """HTML of a table of compared controllers. All texts are escaped."""
    caption = escape(table.caption)
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in table.heads)
    rows = "".join(row_html(name, cells) for name, cells in table.rows)
    place = f'class="scroll compared" tabindex="0" role="region" aria-label="{caption}"'
    head = f'<thead><tr><th scope="col" class="text">Controller</th>{heads}</tr></thead>'
    body = f"<tbody>{rows}</tbody>"
    figcaption = f"<figcaption>{caption}</figcaption>"
    return f"<figure>{figcaption}<div {place}><table>{head}{body}</table></div></figure>"


def row_html(name: str, cells: list[tuple[str, str]]) -> str:
    """HTML of one row of a table."""
    title = f'<th scope="row">{escape(name)}</th>'
    printed = "".join(cell_html(text, shade) for text, shade in cells)
    return f"<tr>{title}{printed}</tr>"


def cell_html(text: str, shade: str) -> str:
    """HTML of one table cell, shaded or not."""
    background = f' style="background: {shade}"' if shade else ""
    return f"<td{background}>{escape(text)}</td>"


def settled_fraction_chart(rows: pd.DataFrame) -> Spec:
    """Chart of certified controllers: stability margin against the fraction of initial states from
    which the loop on the plant settles."""
    points = margins_and_settled_fractions(rows)
    values = []
    for _, row in points.iterrows():
        values.append({name: float(f"{value:.4g}") for name, value in row.items()})
    x = quantitative_axis("margin", "Mismatch margin (–)", type="log")
    y = quantitative_axis("share", "Starts settled (share)", domain=[-0.05, 1.05], nice=False)
    mark = {"type": "point", "filled": True, "size": 25, "opacity": 0.5, "color": BLUE}
    dots: Spec = {"data": {"values": values}, "mark": mark}
    dots["encoding"] = {"x": x, "y": y}
    rule: Spec = {"data": {"values": [{}]}, "mark": STROKES}
    rule["encoding"] = {"x": {"datum": 1}}
    spec = framed_specification({"layer": [rule, dots]}, DESIGNS)
    title = f"{len(points)} certified designs for this model"
    return {"title": title, "note": settled_designs_sentence(points), "spec": spec}


def margins_and_settled_fractions(rows: pd.DataFrame) -> pd.DataFrame:
    """Stability margin and fraction of settled initial states, for each compared design that has
    both."""
    share = rows.get("stable_fraction")
    if share is None:
        share = rows["stable_count"] / rows["initial_conditions"]
    points = pd.DataFrame({"margin": rows["mismatch_margin"], "share": share}).dropna()
    return points[points["margin"] > 0]


def settled_designs_sentence(points: pd.DataFrame) -> str:
    """Sentence on how many designs with a stability margin above one, and below one, settle from
    all initial states."""
    is_above = points["margin"] > 1
    settles = points["share"] >= 1
    above = f"{int((is_above & settles).sum())} of {int(is_above.sum())}"
    below = f"{int((~is_above & settles).sum())} of {int((~is_above).sum())}"
    return f"Above margin one {above} bring every start to rest, at or below it {below}."
