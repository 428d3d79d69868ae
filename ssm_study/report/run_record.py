"""Printing of a single run: its outcome, then all recorded values, grouped by part of the study."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ssm_study.api.rest_design import holds_rest_design, refuse_foreign_files
from ssm_study.engine.records import read_record
from ssm_study.report.outcome import WIDTH, print_outcome
from ssm_study.report.run_facts import RunFacts
from ssm_study.report.words import format_beside_bound, printed_column_name
from ssm_study.table.columns import group_by_part


def print_run(run_folder: Path, console: Console) -> None:
    """Print the outcome of a run, and below it the whole record. Raises `BadRequest` where the
    record lies beside a saved bilinear design, which has none."""
    if holds_rest_design(run_folder):
        refuse_foreign_files(run_folder)
    record = read_record(run_folder) or {}
    print_outcome(record, (), console, RunFacts.from_run_folder(run_folder))
    console.print()
    console.print(record_table(record), width=min(WIDTH, console.width))


def record_table(record: Mapping[str, Any]) -> Table:
    """Table of every value in a run's record with its printed name, in blocks and without missing
    values."""
    table = Table(show_header=False, box=None, pad_edge=False, width=WIDTH)
    table.add_column(ratio=3)
    table.add_column(ratio=2, overflow="fold")
    recorded = [name for name, value in record.items() if value is not None]
    for title, names in group_by_part(recorded).items():
        if names:
            table.add_row(Text(title.upper(), style="bold"), "")
        for name in names:
            table.add_row(Text(f"  {printed_column_name(name)}"), Text(format_value(record[name])))
    return table


def format_value(value: Any) -> str:
    """Text of a recorded value, rounded so that a number above or below one is never printed as
    one."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return format_beside_bound(value) if isinstance(value, float) else str(value)
