"""The table of a study as a person reads it: best first, failures counted and explained, 80 columns wide."""

import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from ssm_study.refusal import require
from ssm_study.results.columns import BY_NAME, RANKING
from ssm_study.results.cost import cost_lines
from ssm_study.results.filters import where as filtered
from ssm_study.results.gather import gather

WIDTH = 80
SETTINGS = (
    "plant",
    "seed",
    "order",
    "hidden_width",
    "slope_lower",
    "slope_upper",
    "scaffold_in",
    "excitation",
    "rate_controller",
    "rate_observer",
    "synthesis_method",
)
OUTCOMES = (
    "settled",
    "settling_time_mean_s",
    "fit_test_percent",
    "certified",
    "resolved_margin",
    "predicted_stable",
)
CERTIFIED = {(True, True): "both", (True, False): "ctl", (False, True): "obs", (False, False): "no"}
REASONS = ("error_message", "infeasible_reason", "uncertified_reason")


def show(study: Path, by: str | None = None, where: str | None = None, cost: bool = False) -> None:
    """Print the study's table, best first, after gathering it anew; `where` filters, `by` sorts.

    With `cost`: instead of it what was computed and what reused, stage by stage.
    """
    table = gather(study)
    if cost:
        print("\n".join(cost_lines(filtered(table, where) if where else table)))
        return
    rows = ranked(filtered(table, where) if where else table, by)
    if sys.stdout.isatty():
        console = Console(width=max(WIDTH, Console().width))
        console.print(rich_table(rows, by, console.width))
    else:
        print(plain_table(rows, by))
    for line in summary(table, shown=len(rows)):
        print(textwrap.fill(line, WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False))


def ranked(table: pd.DataFrame, by: str | None = None) -> pd.DataFrame:
    """Best first: by `by` in its better direction, else by stability, settling time and fit; missing values last."""
    require(by is None or by in table.columns, "by", by, "no such column", f"choose among {', '.join(table.columns)}")
    keys = [by] if by else list(RANKING)
    low = [BY_NAME[key].better != "high" if key in BY_NAME else True for key in keys]
    return table.sort_values(keys, ascending=low, na_position="last", kind="stable", ignore_index=True)


def chosen_columns(table: pd.DataFrame, by: str | None = None) -> list[str]:
    """Run, status, `by`, the settings that vary (which row is which?), then the outcomes that are known."""
    varying = [name for name in SETTINGS if name in table and table[name].nunique(dropna=False) > 1]
    known = [name for name in OUTCOMES if table[name].notna().any()]
    extra = [by] if by and by not in [*known, "run", "status"] else []
    return ["run", "status", *extra, *(name for name in varying if name != by), *known]


def shortened(table: pd.DataFrame) -> pd.DataFrame:
    """Only the digits of each run's name (the settings are columns of their own), both certificates in one word, and
    how many starts settled of how many."""
    controller, observer = table["controller_certified"], table["observer_certified"]
    pairs = zip(controller.fillna(False), observer.fillna(False), strict=True)
    words = [CERTIFIED[bool(first), bool(second)] for first, second in pairs]
    certified = pd.Series(words, index=table.index, dtype="string").where(controller.notna() | observer.notna())
    settled = table["stable_count"].astype("string") + "/" + table["initial_conditions"].astype("string")
    return table.assign(run=short_names(table["run"]), certified=certified, settled=settled)


def short_names(names: pd.Series) -> pd.Series:
    """The digits that end a run's name, which every command takes for it, where no two runs share them."""
    digits = names.str.rsplit("-", n=1).str[-1]
    return digits if digits.is_unique else names


def plain_table(table: pd.DataFrame, by: str | None = None, width: int = WIDTH) -> str:
    """Fixed-width text with as many columns as fit: what pipes and files get."""
    columns: list[list[str]] = []
    table, taken = shortened(table), 0
    for name in chosen_columns(table, by):
        cells = [heading(name), *(cell(value) for value in table[name])]
        room = max(len(text) for text in cells)
        if taken + room + 2 > width and columns:
            continue
        columns.append([text.ljust(room) if name in ("run", "status") else text.rjust(room) for text in cells])
        taken += room + 2
    return "\n".join("  ".join(line).rstrip() for line in zip(*columns, strict=True))


def rich_table(table: pd.DataFrame, by: str | None = None, width: int = WIDTH) -> Table:
    """`plain_table` with a colour for each status that is not ok."""
    text = plain_table(table, by, width).splitlines()
    result = Table.grid()
    result.add_row(text[0], style="bold")
    colour = {"failed": "red", "lost": "red", "corrupt": "red", "infeasible": "yellow", "running": "cyan"}
    for line, status in zip(text[1:], table["status"], strict=True):
        result.add_row(line, style=colour.get(str(status), ""))
    return result


def heading(name: str) -> str:
    """What stands above a column: its short name, if it has one."""
    return (BY_NAME[name].head if name in BY_NAME else {"certified": "cert"}.get(name, "")) or name


def cell(value: object) -> str:
    """Four digits, yes or no; `-` for what is missing."""
    if value is None or value is pd.NA:
        return "-"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def summary(table: pd.DataFrame, shown: int) -> list[str]:
    """Counts by status, then the runs that did not end `ok`, or without a certificate: each reason once."""
    table = table.assign(run=short_names(table["run"]))
    counts = table["status"].value_counts()
    order = [status for status in ("ok", "infeasible", "failed", "lost", "corrupt", "running") if status in counts]
    found = f"{len(table)} run{'s' if len(table) != 1 else ''}" + (f" ({shown} shown)" if shown < len(table) else "")
    lines = ["", f"{found}: " + ", ".join(f"{counts[status]} {status}" for status in order)]
    lines += _listed(table, "failed", lambda row: _reason(row) or "no message recorded")
    lines += _listed(table, "infeasible", lambda row: _reason(row) or _infeasible_parts(row))
    if "uncertified_reason" in table:
        uncertified = table[table["uncertified_reason"].notna()].assign(status="not certified")
        lines += _listed(uncertified, "not certified", _reason)
    lines += _listed(table, "lost", lambda _: "stopped before it ended; the same command runs it again")
    lines += _listed(table, "corrupt", lambda _: "record.json is damaged; the same command runs it again")
    return lines


def _listed(table: pd.DataFrame, status: str, reason: Callable[[pd.Series], str], limit: int = 20) -> list[str]:
    runs: dict[str, list[str]] = {}
    for _, row in table[table["status"] == status].iterrows():
        runs.setdefault(reason(row), []).append(str(row["run"]))
    lines = [f"  {status} {_some(names)}: {why}" for why, names in list(runs.items())[:limit]]
    return lines + ([f"  ... {status} for {len(runs) - limit} more reasons"] if len(runs) > limit else [])


def _some(names: list[str], limit: int = 5) -> str:
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def _reason(row: pd.Series) -> str:
    return next((str(row[name]) for name in REASONS if name in row and not pd.isna(row[name])), "")


def _infeasible_parts(row: pd.Series) -> str:
    parts = []
    for part, rate in (("controller", "rate_controller"), ("observer", "rate_observer")):
        if not pd.isna(row[f"{part}_feasible"]) and not row[f"{part}_feasible"]:
            parts.append(f"{part} at rate {cell(row[rate])}, limit {cell(row[f'{part}_rate_limit'])}")
    return "; ".join(parts) or "no reason recorded"
