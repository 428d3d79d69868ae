"""The table of a study as a person reads it: best first, failures counted and explained, 80 columns
wide."""

import re
import textwrap
from math import fsum
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from ssm_study.engine.plan import duration
from ssm_study.refusal import printable
from ssm_study.table.columns import BY_NAME, RESULTS, listed, requested, setting_of, settings, text
from ssm_study.table.filters import where as filtered
from ssm_study.table.gather import contradicted, gather
from ssm_study.table.rank import ranked

WIDTH = 80  # of a pipe, and the least of a terminal
# rows that are compared with their records: a screen of them; all of 20,000 would take seconds
COMPARED = 40
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]*\w)")  # not the 2 of S_u2
OUTCOMES = ("settled", "certified", *(column.name for column in RESULTS if column.shown))
CERTIFIED = {(True, True): "both", (True, False): "ctl", (False, True): "obs", (False, False): "no"}
COLOURS = {
    "": "bold",
    "failed": "red",
    "lost": "red",
    "corrupt": "red",
    "infeasible": "yellow",
    "running": "cyan",
}
AGAIN = {
    "lost": "stopped before it ended; the same command runs it again",
    "corrupt": "record.json is damaged; the same command runs it again",
}
REASONS = ("error_message", "infeasible_reason", "uncertified_reason")


def show(
    study: Path,
    by: str | None = None,
    where: str | None = None,
    cost: bool = False,
    columns: bool = False,
) -> pd.DataFrame:
    """Print the study's table, best first, brought up to date; `where` filters, `by` sorts. Returns
    the whole table.

    With `cost`: instead of it what was computed and what reused, stage by stage. With `columns`:
    which columns hold values, what they are called, which way is better and whether `verify` checks
    them.
    """
    table, rows = gathered_rows(study, by, where)
    if columns or cost:
        print("\n".join(column_lines(table) if columns else cost_lines(rows)))
        return table
    console = Console(force_jupyter=False)
    lines = plain_table(
        rows, by, max(WIDTH, console.width) if console.is_terminal else WIDTH
    ).splitlines()
    for line, status in zip(lines, ["", *rows["status"]], strict=True):
        console.print(
            Text(line, style=COLOURS.get(str(status), "")), soft_wrap=True
        )  # no colour in a pipe
    for line in summary(table, shown=len(rows)):
        print(
            textwrap.fill(
                line,
                WIDTH,
                subsequent_indent="    ",
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
    return table


def gathered_rows(
    study: Path, by: str | None, where: str | None, anew: bool = False
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The study's table and its rows to show. A table whose first rows contradict the runs' records
    is made anew: its seal vouches for its bytes, not for who wrote them."""
    table = gather(study, anew)
    rows = ranked(filtered(table, where) if where else table, by)
    if not anew and contradicted(study, rows.head(COMPARED)):
        return gathered_rows(study, by, where, anew=True)
    return table, rows


def column_lines(table: pd.DataFrame) -> list[str]:
    """The columns of the table that hold values as text, one a line."""
    rows = [
        ("column", "what it is (unit)", "better", "checked by verify unless said"),
        *listed(table),
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = ["".join(f"{row[i]:<{widths[i]}}  " for i in range(3)) + row[3] for row in rows]
    return [line.rstrip() for line in lines]


def stage_costs(table: pd.DataFrame) -> pd.DataFrame:
    """A row per stage that the records name, the costliest first: each distinct one counts once,
    here or in an earlier study. How many runs needed it, how many distinct ones, what these took,
    and what reuse saved."""
    rows: dict[str, tuple[float, ...]] = {}
    for match in filter(None, (re.fullmatch(r"stage_(\w+)_key", str(column)) for column in table)):
        key = match[0]
        seconds = f"stage_{match[1]}_seconds"
        uses = table[[key, seconds]].dropna()
        once = uses.drop_duplicates(key)  # the store computes what has this key once
        spent_s = float(once[seconds].sum())
        rows[match[1]] = (len(uses), len(once), spent_s, float(uses[seconds].sum()) - spent_s)
    costs = pd.DataFrame.from_dict(
        rows, orient="index", columns=["runs", "distinct", "spent_s", "saved_s"]
    )
    return costs.sort_values("spent_s", ascending=False, kind="stable")


def cost_lines(table: pd.DataFrame) -> list[str]:
    """The costs as text: stage, runs, how many are distinct, how many reused, time of each, of all,
    time saved."""
    costs = stage_costs(table)
    lines = [
        f"{'stage':<14}{'runs':>7}{'distinct':>10}{'reused':>8}{'each':>10}{'cost':>10}{'saved':>10}"
    ]
    for name, runs, distinct, spent_s, saved_s in costs.itertuples(name=None):
        each = f"{spent_s / max(distinct, 1):>8.2f} s{duration(spent_s):>10}{duration(saved_s):>10}"
        lines.append(f"{name:<14}{runs:>7}{distinct:>10}{runs - distinct:>8}{each}")
    spent_s, saved_s = (fsum(costs[name]) for name in ("spent_s", "saved_s"))
    return [*lines, f"{'together':<14}{'':>35}{duration(spent_s):>10}{duration(saved_s):>10}"]


def short_names(names: pd.Series) -> pd.Series:
    """The digits that end a run's name, which every command takes for it, where no two runs share
    them."""
    digits = names.str.rsplit("-", n=1).str[-1]
    return digits if digits.is_unique else names


def plain_table(table: pd.DataFrame, by: str | None = None, width: int = WIDTH) -> str:
    """Fixed-width text with as many columns as fit: what pipes and files get.

    Run, status, `by`, the settings that vary (which row is which?), then the outcomes that are
    known; where the width is short, a setting that follows from those before it gives way to the
    outcomes. Of each run's name only its digits, both certificates in one word, and how many starts
    settled of how many.
    """
    controller = table["controller_certified"]
    observer = table["observer_certified"]
    pairs = zip(controller.fillna(False), observer.fillna(False), strict=True)
    certified = pd.Series(
        [CERTIFIED[bool(one), bool(other)] for one, other in pairs], table.index, dtype="string"
    )
    certified = certified.where(controller.notna() | observer.notna())
    settled = (
        table["stable_count"].astype("string") + "/" + table["initial_conditions"].astype("string")
    )
    varied, telling = _varied_settings(table)
    table = table.assign(run=short_names(table["run"]), certified=certified, settled=settled)
    table = table.assign(predicted_stable=predictions(table))
    first = ["run", *([by] if by else []), "status"]
    outcomes = [n for n in OUTCOMES if table[n].notna().any()]
    columns = dict[str, list[str]]()
    taken = 0
    for name in dict.fromkeys(
        [*first, *telling, *outcomes, *varied]
    ):  # what the table is sorted by stands once
        short = BY_NAME[name].head if name in BY_NAME else {"certified": "cert"}.get(name, "")
        head = short or name.rpartition("__")[-1]  # of `plant__step_s` the last word
        cells = [head, *map(cell, table[name])]
        room = max(map(len, cells))
        if taken + room + 2 > width and columns:  # a narrower one may still fit
            continue
        columns[name] = [
            text.ljust(room) if name in ("run", "status") else text.rjust(room) for text in cells
        ]
        taken += room + 2
    shown = [
        columns[name] for name in dict.fromkeys([*first, *varied, *outcomes]) if name in columns
    ]
    return "\n".join("  ".join(line).rstrip() for line in zip(*shown, strict=True))


def predictions(table: pd.DataFrame) -> pd.Series:
    """The prediction of each run as a word, never without the doubt of its evidence."""
    words = table["predicted_stable"].map({True: "yes", False: "no"}).astype("string")
    evidence = text(table, "evidence")
    words = words.mask((evidence == "doubt") & (words == "yes"), "yes, doubt")
    return words.mask(evidence == "cannot judge", "cannot judge")


def _varied_settings(table: pd.DataFrame) -> tuple[list[str], list[str]]:
    """The settings in which the runs differ, and those of them that tell runs apart which the ones
    before do not."""
    values = {name: requested(table, name) for name in settings(table)}
    varied = [name for name in values if values[name].nunique(dropna=False) > 1]
    telling: list[str] = []
    alike = pd.Series(
        0, index=table.index
    )  # a number for each group of runs that are not told apart yet
    for name in varied:
        finer = pd.DataFrame({"before": alike, "now": values[name].astype("string")})
        groups = finer.groupby(["before", "now"], dropna=False).ngroup()
        if groups.nunique() > alike.nunique():
            telling = [*telling, name]
            alike = groups
    return varied, telling


def cell(value: object) -> str:
    """Four digits, yes or no; `-` for what is missing."""
    if value is None or value is pd.NA:
        return "-"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else printable(str(value))


def summary(table: pd.DataFrame, shown: int) -> list[str]:
    """Counts by status, then the runs that did not end `ok`, or without a certificate: each reason
    once."""
    table = table.assign(run=short_names(table["run"]))
    counts = table["status"].value_counts()
    order = [
        status
        for status in ("ok", "infeasible", "failed", "lost", "corrupt", "running")
        if status in counts
    ]
    found = f"{len(table)} run{'s' if len(table) != 1 else ''}" + (
        f" ({shown} shown)" if shown < len(table) else ""
    )
    uncertified = (
        table[table["uncertified_reason"].notna()] if "uncertified_reason" in table else table[:0]
    )
    parts = [
        (status, table[table["status"] == status])
        for status in ("failed", "infeasible", "lost", "corrupt")
    ]
    parts.insert(2, ("not certified", uncertified))
    told = [
        *over_folds(table),
        *(line for status, rows in parts for line in _reasons(status, rows)),
    ]
    return ["", f"{found}: " + ", ".join(f"{counts[status]} {status}" for status in order), *told]


def over_folds(table: pd.DataFrame) -> list[str]:
    """Lines with mean and standard deviation of the fit on the held-out folds, for each model's
    settings."""
    if "fold" not in table or table["fold"].nunique() < 2:
        return []
    others = [
        name
        for name in settings(table)
        if not setting_of(name).startswith(("synthesis", "data.fold"))
    ]
    varied = [name for name in others if table[name].nunique(dropna=False) > 1]
    lines = []
    for values, runs in table.groupby(varied, dropna=False) if varied else [((), table)]:
        fits = runs.groupby("fold")["fit_test_percent"].mean().dropna()
        which = "".join(
            f", {name} {cell(value)}" for name, value in zip(varied, values, strict=True)
        )
        lines.append(
            f"  {len(fits)} folds: mean test fit {cell(fits.mean())} %, deviation "
            f"{cell(fits.std())} %{which}"
        )
    return lines


def _reasons(status: str, rows: pd.DataFrame, limit: int = 20) -> list[str]:
    """A line per reason; reasons that differ in numbers alone are one."""
    runs: dict[str, list[tuple[str, str]]] = {}
    for row in rows[[name for name in ("run", *REASONS) if name in rows]].to_dict("records"):
        known = (str(row[name]) for name in REASONS if not pd.isna(row.get(name)))
        why = printable(AGAIN.get(status) or next(known, "no reason was recorded"))
        runs.setdefault(NUMBER.sub("#", why), []).append((str(row["run"]), why))
    lines = []
    for alike in list(runs.values())[:limit]:
        names = ", ".join(name for name, _ in alike[:5]) + (
            f" and {len(alike) - 5} more" if len(alike) > 5 else ""
        )
        lines.append(f"  {status} {names}: {ranged([why for _, why in alike])}")
    return lines + (
        [f"  ... {status} for {len(runs) - limit} more reasons"] if len(runs) > limit else []
    )


def ranged(sentences: list[str]) -> str:
    """Sentences that differ in numbers alone as one, each number that varies as its range: `rate
    0.4 to 0.9`."""
    found = [NUMBER.findall(sentence) for sentence in sentences]
    columns = [sorted(set(column), key=float) for column in zip(*found, strict=True)]
    said = iter(
        column[0] if len(column) == 1 else f"{column[0]} to {column[-1]}" for column in columns
    )
    return NUMBER.sub(lambda _: next(said), sentences[0])
