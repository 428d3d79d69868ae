"""Printing of the table of a study, 80 columns wide: best run first, failures counted and
explained."""

import re
import textwrap
from math import fsum
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from ssm_study.engine.plan import format_duration
from ssm_study.refusal import escape_control_characters
from ssm_study.table.alike_sentences import hide_numbers, merge_number_ranges
from ssm_study.table.columns import (
    BY_NAME,
    RESULTS,
    describe_columns,
    requested_values,
    setting_columns,
    setting_path,
    text_column,
)
from ssm_study.table.doubts import row_count_warnings
from ssm_study.table.filters import filter_rows as filtered
from ssm_study.table.gather import gather, rows_differ_from_records
from ssm_study.table.over_seeds import seed_statistics_lines
from ssm_study.table.rank import rank_runs

WIDTH = 80  # of a pipe, and the least of a terminal
# rows that are compared with their records: a screen of them; all of 20,000 would take seconds
COMPARED = 40
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
REASONS_BY_STATUS = {"lost": "stopped before it ended", "corrupt": "record.json is damaged"}
RUN_AGAIN = "; the same command runs it again"
STATUSES = ("ok", "infeasible", "failed", "lost", "corrupt", "running")
SUMMARY_LINES = textwrap.TextWrapper(
    WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
)
REASONS = ("error_message", "infeasible_reason", "uncertified_reason")


def show_table(
    study: Path,
    by: str | None = None,
    where: str | None = None,
    cost: bool = False,
    columns: bool = False,
) -> pd.DataFrame:
    """Gather and print the results table of a study, the best run first. The whole table is
    returned.

    `where` filters, `by` sorts. With `cost`: instead of it what was computed and what reused, stage
    by stage. With `columns`: which columns hold values, what they are called, which way is better
    and whether `verify` checks them.
    """
    table, rows = gather_rows(study, by, where)
    if columns or cost:
        lines = column_description_lines(table) if columns else computing_time_lines(rows)
        print("\n".join(lines))
        return table
    print_rows(rows, by)
    for line in seed_statistics_lines(rows):
        print(line)
    shown_count = len(rows)
    for line in [
        *status_summary_lines(table, printed_count=shown_count),
        *row_count_warnings(study, table),
    ]:
        print(SUMMARY_LINES.fill(line))
    return table


def print_rows(rows: pd.DataFrame, by: str | None) -> None:
    """Print rows of a results table, coloured by status in a terminal."""
    console = Console(force_jupyter=False)
    width = max(WIDTH, console.width) if console.is_terminal else WIDTH
    text = render_table(rows, by, width)
    lines = text.splitlines()
    row_statuses = map(str, rows["status"])
    statuses = ["", *row_statuses]
    for line, status in zip(lines, statuses, strict=True):
        style = COLOURS.get(status, "")
        text_line = Text(line, style=style)  # no colour in a pipe
        console.print(text_line, soft_wrap=True)


def gather_rows(
    study: Path, by: str | None, where: str | None, anew: bool = False
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Results table of a study, and the selected rows to be printed.

    A table whose first rows contradict the runs' records is made anew: its seal vouches for its
    bytes, not for who wrote them.
    """
    table = gather(study, anew, must_write=False)  # a full disk can be looked at, too
    selected = filtered(table, where) if where else table
    rows = rank_runs(selected, by)
    if not anew and rows_differ_from_records(study, rows.head(COMPARED)):
        return gather_rows(study, by, where, anew=True)
    return table, rows


def column_description_lines(table: pd.DataFrame) -> list[str]:
    """Text lines that describe the columns of a results table that have values."""
    head = ("column", "what it is (unit)", "better", "checked by verify unless said")
    rows = [head, *describe_columns(table)]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = []
    for row in rows:
        padded = [f"{row[i]:<{widths[i]}}  " for i in range(3)]
        line = "".join([*padded, row[3]])
        lines.append(line.rstrip())
    return lines


def stage_computing_times(table: pd.DataFrame) -> pd.DataFrame:
    """Table of the computing time of each step (stage) of a study, the longest first.

    Each distinct one counts once, here or in an earlier study: how many runs needed it, how many
    distinct ones, what these took, and what reuse saved.
    """
    rows: dict[str, tuple[float, ...]] = {}
    for name in map(str, table):
        match = re.fullmatch(r"stage_(\w+)_key", name)
        if match is None:
            continue
        seconds = f"stage_{match[1]}_seconds"
        stage_columns = [name, seconds]
        uses = table[stage_columns].dropna()
        distinct = uses.drop_duplicates(name)  # the store computes what has this key once
        spent = distinct[seconds].sum()
        spent_s = float(spent)
        all_seconds = uses[seconds].sum()
        saved_s = float(all_seconds) - spent_s
        use_count = len(uses)
        distinct_count = len(distinct)
        rows[match[1]] = (use_count, distinct_count, spent_s, saved_s)
    names = ["runs", "distinct", "spent_s", "saved_s"]
    costs = pd.DataFrame.from_dict(rows, orient="index", columns=names)
    return costs.sort_values("spent_s", ascending=False, kind="stable")


def computing_time_lines(table: pd.DataFrame) -> list[str]:
    """Text lines with the computing time of each step (stage) of a study.

    Stage, runs, how many are distinct, how many reused, time of each, of all, time saved.
    """
    costs = stage_computing_times(table)
    counts_head = f"{'stage':<14}{'runs':>7}{'distinct':>10}{'reused':>8}"
    lines = [f"{counts_head}{'each':>10}{'cost':>10}{'saved':>10}"]
    for name, runs, distinct, spent_s, saved_s in costs.itertuples(name=None):
        counts = f"{name:<14}{runs:>7}{distinct:>10}{runs - distinct:>8}"
        each_s = spent_s / max(distinct, 1)
        lines.append(
            f"{counts}{each_s:>8.2f} s{format_duration(spent_s):>10}{format_duration(saved_s):>10}"
        )
    spent = format_duration(fsum(costs["spent_s"]))
    saved = format_duration(fsum(costs["saved_s"]))
    return [*lines, f"{'together':<14}{'':>35}{spent:>10}{saved:>10}"]


def short_run_names(names: pd.Series) -> pd.Series:
    """Short name of each run of a study: the digits at the end of its name if they are unique.

    Every command takes them for the run.
    """
    name_parts = names.str.rsplit("-", n=1)
    digits = name_parts.str[-1]
    return digits if digits.is_unique else names


def render_table(table: pd.DataFrame, by: str | None = None, width: int = WIDTH) -> str:
    """Text of a results table in columns of fixed width, with as many columns as fit the terminal.

    Run, status, `by`, the settings that vary (which row is which?), then the outcomes that are
    known; where the width is short, a setting that follows from those before it gives way to the
    outcomes. Of each run's name only its digits, both certificates in one word, and how many starts
    settled of how many.
    """
    settled_text = table["stable_count"].astype("string")
    case_count = table["initial_conditions"].astype("string")
    settled_text = settled_text + "/" + case_count
    varied, telling = _varied_settings(table)
    run = short_run_names(table["run"])
    certified_words = certificate_verdicts(table)
    prediction = prediction_verdicts(table)
    table = table.assign(
        run=run, certified=certified_words, settled=settled_text, predicted_stable=prediction
    )
    first = ["run", "status"] if by is None else ["run", by, "status"]
    outcomes = [name for name in OUTCOMES if table[name].notna().any()]
    columns: dict[str, list[str]] = {}
    used_width = 0
    names_by_importance = [*first, *telling, *outcomes, *varied]
    by_importance = dict.fromkeys(names_by_importance)  # each name once
    for name in by_importance:
        head = short_column_heading(name)
        values_as_text = map(format_cell, table[name])
        cells = [head, *values_as_text]
        room = max(map(len, cells))
        if used_width + room + 2 > width and columns:  # a narrower one may still fit
            continue
        is_left = name in ("run", "status")
        columns[name] = [text.ljust(room) if is_left else text.rjust(room) for text in cells]
        used_width += room + 2
    names_in_order = [*first, *varied, *outcomes]
    order = dict.fromkeys(names_in_order)
    fitting_columns = [columns[name] for name in order if name in columns]
    table_lines = zip(*fitting_columns, strict=True)
    lines = ["  ".join(line).rstrip() for line in table_lines]
    return "\n".join(lines)


def certificate_verdicts(table: pd.DataFrame) -> pd.Series:
    """Verdict on the certificates of each run of a table, in one word; missing for a run without
    certificates."""
    controller = table["controller_certified"]
    observer = table["observer_certified"]
    controller_holds = controller.fillna(False)
    observer_holds = observer.fillna(False)
    pairs = zip(controller_holds, observer_holds, strict=True)
    words = [CERTIFIED[bool(ours), bool(theirs)] for ours, theirs in pairs]
    certified = pd.Series(words, table.index, dtype="string")
    has_controller_verdict = controller.notna()
    has_observer_verdict = observer.notna()
    return certified.where(has_controller_verdict | has_observer_verdict)


def short_column_heading(name: str) -> str:
    """Short heading of a table column, such as `step_s` for the column `plant__step_s`."""
    short = "cert" if name == "certified" else ""
    if name in BY_NAME:
        short = BY_NAME[name].head
    return short or name.rpartition("__")[-1]


def prediction_verdicts(table: pd.DataFrame) -> pd.Series:
    """Prediction of stability of each run as a word, marked where the evidence is doubtful."""
    words_of_verdicts = {True: "yes", False: "no"}
    words = table["predicted_stable"].map(words_of_verdicts).astype("string")
    evidence = text_column(table, "evidence")
    is_doubtful = (evidence == "doubt") & (words == "yes")
    words = words.mask(is_doubtful, "yes, doubt")
    return words.mask(evidence == "cannot judge", "cannot judge")


def _varied_settings(table: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Names of all settings in which the runs of a table differ, and of a few that suffice to tell
    the runs apart."""
    settings = setting_columns(table)
    values = {name: requested_values(table, name) for name in settings}
    varied = [name for name in values if values[name].nunique(dropna=False) > 1]
    telling: list[str] = []
    # A number for each group of runs that are not told apart yet.
    alike = pd.Series(0, index=table.index)
    for name in varied:
        now = values[name].astype("string")
        groupings = {"before": alike, "now": now}
        finer = pd.DataFrame(groupings)
        both_groupings = ["before", "now"]
        groups = finer.groupby(both_groupings, dropna=False).ngroup()
        if groups.nunique() > alike.nunique():
            telling = [*telling, name]
            alike = groups
    return varied, telling


def format_cell(value: object) -> str:
    """Text of a table cell: four digits for numbers, yes or no for truth values, `-` for a missing
    value."""
    if value is None or value is pd.NA:
        return "-"
    truth_types = (bool, np.bool_)
    if isinstance(value, truth_types):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else escape_control_characters(str(value))


def status_summary_lines(table: pd.DataFrame, printed_count: int) -> list[str]:
    """Text lines with the number of a study's runs of each status, and with the reasons why
    runs failed or were not certified."""
    run = short_run_names(table["run"])
    table = table.assign(run=run)
    counts = table["status"].value_counts()
    words = [f"{counts[status]} {status}" for status in STATUSES if status in counts]
    total = "1 run" if len(table) == 1 else f"{len(table)} runs"
    if printed_count < len(table):
        total = f"{total} ({printed_count} shown)"
    uncertified = table[:0]
    if "uncertified_reason" in table:
        has_reason = table["uncertified_reason"].notna()
        uncertified = table[has_reason]
    printed_statuses = ("failed", "infeasible", "lost", "corrupt")
    parts = {status: table[table["status"] == status] for status in printed_statuses}
    fold_lines = fold_statistics_lines(table)
    lines = ["", f"{total}: {', '.join(words)}", *fold_lines]
    lines += _reason_lines("failed", parts["failed"])
    lines += _reason_lines("infeasible", parts["infeasible"])
    lines += _reason_lines("not certified", uncertified)
    lines += _reason_lines("lost", parts["lost"])
    return lines + _reason_lines("corrupt", parts["corrupt"])


def fold_statistics_lines(table: pd.DataFrame) -> list[str]:
    """Text lines with the mean and standard deviation of the fit over cross-validation folds, for
    each combination of model settings."""
    if "fold" not in table or table["fold"].nunique() < 2:
        return []
    varied = []
    for name in setting_columns(table):
        path = setting_path(name)
        other_parts = ("synthesis", "data.fold")
        is_of_the_model = not path.startswith(other_parts)
        if is_of_the_model and table[name].nunique(dropna=False) > 1:
            varied.append(name)
    groups = table.groupby(varied, dropna=False) if varied else [((), table)]
    lines = []
    for values, runs in groups:
        fit_test_percent = runs.groupby("fold")["fit_test_percent"]
        fits = fit_test_percent.mean().dropna()
        pairs = zip(varied, values, strict=True)
        pair_texts = (f", {name} {format_cell(value)}" for name, value in pairs)
        which = "".join(pair_texts)
        mean = f"mean test fit {format_cell(fits.mean())} %"
        lines.append(f"  {len(fits)} folds: {mean}, deviation {format_cell(fits.std())} %{which}")
    return lines


def _reason_lines(status: str, rows: pd.DataFrame, limit: int = 20) -> list[str]:
    """Text lines with the reasons why runs failed, are infeasible or are not certified. Reasons
    that differ only in numbers are merged; a run that the same command runs again is marked."""
    named_columns = ("run", *REASONS, "failure_transient")
    columns = [name for name in named_columns if name in rows]
    runs: dict[str, list[tuple[str, str]]] = {}
    for row in rows[columns].to_dict("records"):
        recorded = (str(row[name]) for name in REASONS if not pd.isna(row.get(name)))
        reason = REASONS_BY_STATUS.get(status) or next(recorded, "no reason was recorded")
        if status in REASONS_BY_STATUS or row.get("failure_transient") is True:
            reason = f"{reason}{RUN_AGAIN}"
        reason = escape_control_characters(reason)
        without_numbers = hide_numbers(reason)
        run = str(row["run"])
        alike_runs = runs.setdefault(without_numbers, [])
        run_and_reason = (run, reason)
        alike_runs.append(run_and_reason)
    lines = []
    groups = runs.values()
    for alike in list(groups)[:limit]:
        first_five = alike[:5]
        names = ", ".join(name for name, _ in first_five)
        if len(alike) > 5:
            names = f"{names} and {len(alike) - 5} more"
        sentences = [reason for _, reason in alike]
        sentence = merge_number_ranges(sentences)
        lines.append(f"  {status} {names}: {sentence}")
    if len(runs) > limit:
        lines.append(f"  ... {status} for {len(runs) - limit} more reasons")
    return lines
