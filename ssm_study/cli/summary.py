"""Summary at the end of a run or a sweep: results are gathered in a table, drawn and printed."""

import io
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.text import Text

from ssm_study import __version__
from ssm_study.cli.paper_figures import PAPER_FIGURES
from ssm_study.durable import refuse_symbolic_link, write_atomically
from ssm_study.engine.records import (
    CORRUPT,
    FAILED,
    INFEASIBLE,
    LOST,
    OK,
    RECORD,
    RUNNING,
    read_record,
)
from ssm_study.refusal import BadRequest
from ssm_study.study.line import study_folder

RUN_FIGURES = PAPER_FIGURES
ELSEWHERE = (
    "another process is at this run, so nothing was done here; when it is through, the same "
    "command prints the outcome"
)
RETRY = (
    "a failed run is not tried again by the same command; once its cause is mended, add "
    "--retry-failed"
)
TRANSIENT = "the machine was at fault, not the run; the same command runs it again"
WIDTH = 80  # of the outcome, where a terminal is not narrower


def print_run_summary(config: DictConfig) -> bool:
    """Update the study's table, draw the figures of one run and print its outcome; return whether
    the run failed. A run of another process counts as failed, and with `strict` one that cannot be
    judged."""
    study = study_folder(config)
    console = Console()
    record = read_record(study / str(config.run)) or {}
    if record.get("status") == RUNNING:  # with its lock held: this command left the run alone
        print(f"{study.name}/{config.run}: {ELSEWHERE}")
        return True
    width = min(WIDTH, console.width) if console.is_terminal else WIDTH
    # A baseline closes no loop.
    drawn = RUN_FIGURES if "stable_count" in record else RUN_FIGURES[:1]
    figures = [study / "figures" / f"{name}.{kind}" for name in drawn for kind in ("png", "pdf")]
    # What was told of a study that has not changed is told again: reading it takes pandas, half a
    # second to import.
    stored_text_path = study / ".told" / f"{config.run}.json"
    about = [__version__, str(Path.cwd()), str(study), width]
    stored_text = _read_cached_list(
        stored_text_path, study, [*figures, study / "runs.parquet", study / "runs.csv"]
    )
    if stored_text[:-1] != about or record.get("status") != OK:
        with suppress(OSError):  # first, because it changes the time of the study's folder
            stored_text_path.parent.mkdir(exist_ok=True)
        stored_text = [*about, _outcome_text(study, record, drawn, figures, width)]
        with suppress(OSError, BadRequest):  # a study that may only be read
            refuse_symbolic_link(stored_text_path.parent)
            # Last: it vouches for tables and figures.
            write_atomically(stored_text_path, json.dumps(stored_text).encode(), durable=False)
    console.print(Text.from_ansi(stored_text[-1]), soft_wrap=True)
    if record.get("status") == FAILED:
        print(TRANSIENT if record.get("failure_transient") else RETRY)
    return record.get("status") not in (OK, INFEASIBLE) or (
        config.strict and record.get("evidence") == "cannot judge"
    )


def _read_cached_list(cache_file: Path, study: Path, files: Sequence[Path]) -> list[Any]:
    """Read a cached JSON list; empty if a record of the study or a given file is newer than the
    cache.

    Figures that are younger show another run of the study.
    """
    with suppress(OSError, ValueError):
        changed = max(
            path.stat().st_mtime_ns for path in (study, *study.glob(f"*/{RECORD}"), *files)
        )
        if cache_file.stat().st_mtime_ns > changed:
            return list(json.loads(cache_file.read_text(encoding="utf-8")))
    return []


def _outcome_text(
    study: Path,
    record: dict[str, Any],
    figure_names: Sequence[str],
    figures: list[Path],
    width: int,
) -> str:
    """Text on the outcome of a run, coloured for a terminal of a given width. The table and the
    figures of its study are brought up to date first."""
    from ssm_study.report.figures import draw_figures  # here: a sweep and its jobs draw nothing
    from ssm_study.report.outcome import print_outcome
    from ssm_study.report.run_facts import RunFacts
    from ssm_study.table.gather import gather

    gather(study, must_write=False)  # the run is through, whatever the disk holds
    printed_figures = figures if record.get("status") == OK else []
    if printed_figures:
        draw_figures(figure_names, study, run=record["run"])
    page = Console(
        file=io.StringIO(),
        width=width,
        force_terminal=True,
        color_system="standard",
        no_color=False,
    )
    with page.capture() as captured:
        drawn_figures = [path for path in printed_figures if path.is_file()]
        facts = RunFacts.from_run_folder(study / str(record.get("run")))
        print_outcome(record, drawn_figures, page, facts)
    return captured.get().rstrip("\n")


def print_sweep_summary(config: DictConfig) -> bool:
    """Update and print the results table of a study after a sweep; return whether a run failed."""
    from ssm_study.evidence.finding import CANNOT_JUDGE
    from ssm_study.table.doubts import RUNS_IN_SENTENCE
    from ssm_study.table.folders import abbreviate_names
    from ssm_study.table.show import short_run_names, show_table

    table = show_table(study_folder(config))
    withheld = config.strict and "evidence" in table and (table["evidence"] == CANNOT_JUDGE).any()
    failed = table[table["status"] == FAILED]
    machine_at_fault = failed.get("failure_transient", failed["status"])
    if any(flag is not True for flag in machine_at_fault):
        print(RETRY)
    is_unfinished = table["status"].isin([FAILED, LOST, CORRUPT])
    if is_unfinished.any():
        unfinished = short_run_names(table["run"])[is_unfinished]
        names = abbreviate_names(unfinished, RUNS_IN_SENTENCE)
        print(f"exit status 1 because of {names}: every run of the study counts, older ones, too")
    return bool(is_unfinished.any() or withheld)
