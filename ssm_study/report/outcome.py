"""What a run came to, on one screen: the claim, the numbers that bear it, and where the figures lie."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ssm_study.report import verdict

WIDTH = 80
STYLES = {
    verdict.SETTLED.word: "bold green",
    verdict.LOST.word: "bold yellow",
    verdict.UNCERTIFIED.word: "bold yellow",
    verdict.IDENTIFIED.word: "bold cyan",
    verdict.INFEASIBLE.word: "bold magenta",
    verdict.FAILED.word: "bold red",
}
MISSING = "–"
SCORE_UNITS = {"emps": " mm", "cascaded_tanks": " V", "ced": " ticks/s"}  # as the benchmarks publish them


def print_outcome(
    record: Mapping[str, Any], figures: Sequence[Path] = (), console: Console | None = None, drawn: str | None = None
) -> None:
    """The end-of-run table, 80 columns wide: coloured on a terminal, plain text in a pipe (and under `NO_COLOR`).

    The figures show the run `drawn`; where that is another one of the study, a line says so.
    """
    console = console or Console()
    console = (
        console
        if console.is_terminal
        else Console(file=console.file, width=WIDTH, color_system=None, force_jupyter=False)
    )
    console.print(outcome_table(record), width=min(WIDTH, console.width))
    for reason in _reasons(record):
        console.print(Text(reason), soft_wrap=False, width=WIDTH)
    if figures and drawn not in (None, record.get("run")):
        console.print(Text(f"The study's best run, which its figures show, is {drawn}:"), soft_wrap=True)
    for path in figures:
        console.print(Text(f"  {_nearest(path)}"), soft_wrap=True, highlight=False)  # a path is never broken


def outcome_table(record: Mapping[str, Any]) -> Table:
    """The numbers of `record.json` in the order of the argument: model, certificate, plant."""
    word = str(verdict.verdicts(pd.DataFrame([dict(record)])).iloc[0])
    table = Table(show_header=False, box=None, pad_edge=False, width=WIDTH)
    table.add_column(width=27, no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("Run", Text(f"{record.get('study', MISSING)}/{record.get('run', MISSING)}"))
    table.add_row("Outcome", Text(f"{word}: {verdict.BY_WORD[word].sentence}", style=STYLES[word]))
    for column, label, value in _rows(record):
        if record.get(column) is not None:
            table.add_row(label, Text(value))
    return table


def _rows(record: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Column that must be known for the line to make sense, label, value."""

    def number(name: str, form: str = ".3g", unit: str = "") -> str:
        value = record.get(name)
        return MISSING if value is None else f"{value:{form}}{unit}" if isinstance(value, (int, float)) else str(value)

    yield "fit_test_percent", "Fit on the test record", number("fit_test_percent", ".1f", " %")
    for name in sorted(key for key in record if key.startswith("score_test_")):
        unit = SCORE_UNITS.get(str(record.get("benchmark")), "")
        yield name, f"Benchmark score, record {name.removeprefix('score_test_')}", number(name, ".4g", unit)
    interval = f"[{number('input_slope_lower')}, {number('input_slope_upper')}]"
    yield "input_slope_lower", "Slopes of S_u", f"{interval} ({number('bound_method')})"
    for side in ("controller", "observer"):
        shown = f"{number(f'rate_{side}')} asked, at most {number(f'{side}_rate_limit')}: {_certified(record, side)}"
        yield f"rate_{side}", f"{side.capitalize()} rate", shown
    yield _prediction(record)
    yield "loop_on", "Closed loop on", _where(record)
    settled = f"{number('stable_count', '.0f')} of {number('initial_conditions', '.0f')}"
    yield "stable_count", "Initial conditions settled", settled
    controlled, alone = number("settling_time_mean_s", ".3f", " s"), number("settling_time_open_loop_s", ".3f", " s")
    yield "settling_time_open_loop_s", "Mean settling time", f"{controlled}, uncontrolled {alone}{_ratio(record)}"


def _prediction(record: Mapping[str, Any]) -> tuple[str, str, str]:
    """What model and validation record say of the plant; of an older record the margin alone."""
    if record.get("predicted_stable") is None:
        said = f"{record.get('mismatch_margin') or 0:.3g} (above 1 predicts a stable plant)"
        return "mismatch_margin", "Mismatch margin", said
    margin, radius = record.get("resolved_margin"), record.get("controller_radius")
    said = "stays stable" if record["predicted_stable"] else "not sure to stay stable"
    told = f"margin {margin:.3g} by frequency, " if margin is not None else ""
    told += f"controller's own radius {radius:.3g}" if radius is not None else ""
    return "predicted_stable", "Prediction for the plant", f"{said} ({told})"


def _certified(record: Mapping[str, Any], side: str) -> str:
    if record.get(f"{side}_certified"):
        return "certified"
    feasible = record.get(f"{side}_feasible")
    return "not reached" if feasible is None else "not certified" if feasible else "infeasible"


def _where(record: Mapping[str, Any]) -> str:
    """A loop on the identified model shows what the certificate promises, not what the plant does."""
    where = str(record.get("loop_on"))
    return "the true plant" if where == "plant" else f"the {where}; no plant was there to try it on"


def _ratio(record: Mapping[str, Any]) -> str:
    controlled, alone = record.get("settling_time_mean_s"), record.get("settling_time_open_loop_s")
    return f" (ratio {controlled / alone:.2f})" if controlled is not None and alone else ""


def _reasons(record: Mapping[str, Any]) -> Iterator[str]:
    """Whatever the record says about why a run is infeasible, not certified or failed."""
    for name in ("infeasible_reason", "uncertified_reason", "error_message"):
        if record.get(name):
            yield f"{name.replace('_', ' ')}: {record[name]}"


def _nearest(path: Path) -> Path:
    """Relative to where the user stands, if it lies below."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_absolute() and path.is_relative_to(here) else path
