"""Comparisons of controllers on the model and plant of one run: by situation, or of many certified
designs."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from ssm_study.report.page.chart_looks import STROKES, framed, quantitative
from ssm_study.report.words import choice_label
from ssm_study.style import BLUE

HEADS = ("Settled", "Mean settling (s)", "Worst (s)", "Peak input", "Mismatch margin", "Certified")
NUMBERS = ("settling_time_mean_s", "settling_time_worst_s", "input_peak_v", "mismatch_margin")
NOT_SETTLED = "rgb(179 89 0 / {:.0f}%)"  # the fewer settle the darker; the number says it too
MISSING = "–"


@dataclass(frozen=True, kw_only=True)
class ComparedTable:
    """Table of compared controllers: its caption, headings, and cells with or without a
    background."""

    caption: str
    heads: tuple[str, ...]
    rows: list[tuple[str, list[tuple[str, str]]]]


def comparison_json(rows: pd.DataFrame) -> dict[str, Any]:
    """Comparison of controllers in a run, as JSON values for a table or a chart."""
    rows = rows.dropna(axis="columns", how="all")
    if "controller" in rows:
        return {"table": table_html(controllers_table(rows))}
    return {"chart": designs_chart(rows)}


def controllers_table(rows: pd.DataFrame) -> ComparedTable:
    """Table with one row per controller. Its columns are the numbers of a single situation, or all
    situations."""
    situations = list(dict.fromkeys(rows["situation"]))
    first = [
        (choice_label(name), own.iloc[0]) for name, own in rows.groupby("controller", sort=False)
    ]
    if len(situations) == 1:
        return ComparedTable(
            caption="Controllers on this run's plant, from the same starts",
            heads=HEADS,
            rows=[(name, number_cells(row)) for name, row in first],
        )
    controllers = list(dict.fromkeys(rows["controller"]))
    tried: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows.to_dict("records"):
        key = (str(row["controller"]), str(row["situation"]))
        tried.setdefault(key, {str(name): value for name, value in row.items()})
    cells = {
        name: [settled_cell(tried.get((name, situation), {})) for situation in situations]
        for name in controllers
    }
    return ComparedTable(
        caption="Controllers on this run's plant: share settled, mean settling time of those",
        heads=tuple(choice_label(situation) for situation in situations),
        rows=[(choice_label(name), own) for name, own in cells.items()],
    )


def number_cells(row: "pd.Series[Any]") -> list[tuple[str, str]]:
    """Table cells with the numbers of a controller in a single situation."""
    settled = percent(row.get("stable_fraction"))
    texts = [settled, *(number(row.get(name)) for name in NUMBERS)]
    certified = "yes" if row.get("certified") is True or row.get("certified") == 1 else MISSING
    return [(text, "") for text in [*texts, certified]]


def settled_cell(row: dict[str, Any]) -> tuple[str, str]:
    """Table cell with the share that settles and the mean settling time, shaded where some do not
    settle."""
    if pd.isna(row.get("stable_fraction", np.nan)):
        return MISSING, ""
    time_s = row.get("settling_time_mean_s")
    words = "" if time_s is None or pd.isna(time_s) else f" {time_s:.3g} s"
    share = float(row["stable_fraction"])
    return f"{percent(share)}{words}", NOT_SETTLED.format(45 * (1 - share))


def percent(share: Any) -> str:
    """Format a share in per cent."""
    return MISSING if pd.isna(share) else f"{100 * share:.0f} %"


def number(value: Any) -> str:
    """Format a number to four digits."""
    return MISSING if pd.isna(value) else f"{value:.4g}"


def table_html(table: ComparedTable) -> str:
    """HTML of a table of compared controllers. All texts are escaped."""
    caption = escape(table.caption)
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in table.heads)
    rows = "".join(row_html(name, cells) for name, cells in table.rows)
    return (
        f"<figure><figcaption>{caption}</figcaption>"
        f'<div class="scroll compared" tabindex="0" role="region" aria-label="{caption}"><table>'
        f'<thead><tr><th scope="col" class="text">Controller</th>{heads}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></figure>"
    )


def row_html(name: str, cells: list[tuple[str, str]]) -> str:
    """Row of an HTML table."""
    printed = "".join(
        f'<td style="background: {shade}">{escape(text)}</td>'
        if shade
        else f"<td>{escape(text)}</td>"
        for text, shade in cells
    )
    return f'<tr><th scope="row">{escape(name)}</th>{printed}</tr>'


def designs_chart(rows: pd.DataFrame) -> dict[str, Any]:
    """Chart of certified designs, one point for each, of the stability margin against the behaviour
    on the plant."""
    share = rows.get("stable_fraction")
    if share is None:
        share = rows["stable_count"] / rows["initial_conditions"]
    points = pd.DataFrame({"margin": rows["mismatch_margin"], "share": share}).dropna()
    points = points[points["margin"] > 0]
    above = points["margin"] > 1
    settles = points["share"] >= 1
    note = (
        f"Above margin one {int((above & settles).sum())} of {int(above.sum())} bring every start "
        f"to rest, at or below it {int((~above & settles).sum())} of {int((~above).sum())}."
    )
    values = [{name: float(f"{v:.4g}") for name, v in row.items()} for _, row in points.iterrows()]
    encoding = {
        "x": quantitative("margin", "Mismatch margin (–)", type="log"),
        "y": quantitative("share", "Starts settled (share)", domain=[-0.05, 1.05], nice=False),
    }
    mark = {"type": "point", "filled": True, "size": 25, "opacity": 0.5, "color": BLUE}
    rule = {"data": {"values": [{}]}, "mark": STROKES, "encoding": {"x": {"datum": 1}}}
    layer = [rule, {"data": {"values": values}, "mark": mark, "encoding": encoding}]
    words = (
        "Share of starts settled on the plant against mismatch margin, one point per certified "
        "design"
    )
    title = f"{len(points)} certified designs for this model"
    return {"title": title, "note": note, "spec": framed({"layer": layer}, words)}
