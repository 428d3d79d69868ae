"""Texts on drawn records, of every combination of outcomes, are the recorded ones."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import report_tables
from recorded import assert_as_recorded
from rich.console import Console

from ssm_study.report.outcome import print_outcome
from ssm_study.report.page.failures import failure_groups
from ssm_study.report.page.first_screen import outcome_cards, outcome_remarks
from ssm_study.report.page.proof_card import RecordedLoopFacts
from ssm_study.report.run_facts import RunFacts
from ssm_study.report.run_record import record_table
from ssm_study.report.words import VERDICTS, verdict_counts, verdict_words
from ssm_study.table.over_seeds import seed_statistics_lines
from ssm_study.table.rank import outcome_class, rank_runs, settling_ratio, sort_best_first
from ssm_study.table.show import column_description_lines, render_table, status_summary_lines

VALUES_FILE = Path(__file__).parents[1] / "outcome_values.json"
TEXT = VALUES_FILE.read_text(encoding="utf-8")
VALUES: dict[str, list[Any]] = json.loads(TEXT)
STARTS = np.array([[-0.9], [-0.3], [0.2], [0.8]])
INPUT_RANGE = (-5.5, 4.0)
UNITS = {"input_unit": "V", "output_unit": "rad/s"}
REST = {"output_at_rest": 0.1, "settling_band": 0.5}
FACTS_OF_LOOP: dict[str, Any] = {"step_s": 0.01, "input_range": INPUT_RANGE, **UNITS, **REST}
LOOP = RecordedLoopFacts(initial_outputs=STARTS, **FACTS_OF_LOOP)
FACTS = RunFacts(step_s=0.01, input_unit=" V", output_unit=" rad/s", no_set_points_reason="none")
WORDS = [verdict.word for verdict in VERDICTS]


def drawn_record(seed: int) -> dict[str, Any]:
    """A record whose every value is drawn."""
    rng = np.random.default_rng(seed)
    record = {name: choices[rng.integers(len(choices))] for name, choices in VALUES.items()}
    record["verdict"] = WORDS[rng.integers(len(WORDS))]
    return {name: value for name, value in record.items() if value is not None}


def result_or_error(function: Callable[[], Any]) -> Any:
    """Result of a function, or the name of its error: no study has every combination."""
    try:
        return function()
    except Exception as error:
        return type(error).__name__


def printed(*parts: Any) -> list[str]:
    """Lines of tables in a terminal."""
    console = Console(width=120, file=io.StringIO())
    console.print(*parts)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def printed_outcome(record: dict[str, Any], facts: RunFacts) -> list[str]:
    console = Console(width=120, file=io.StringIO())
    print_outcome(record, (), console, facts)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_a_record_is_printed_as_recorded() -> None:
    outcomes = {}
    for seed in range(40):
        record = drawn_record(seed)
        facts = FACTS if seed % 2 else RunFacts()
        outcomes[seed] = result_or_error(lambda: printed_outcome(record, facts))  # noqa: B023
    outcomes["all"] = printed(record_table(drawn_record(1)))
    assert_as_recorded("outcomes", outcomes)


def test_the_first_screen_says_of_a_record_what_was_recorded() -> None:
    screens = {}
    for seed in range(60):
        record = drawn_record(seed)
        loop = LOOP if seed % 3 else None
        cards = result_or_error(lambda: outcome_cards(record, loop))  # noqa: B023
        remarks = result_or_error(lambda: list(outcome_remarks(record)))  # noqa: B023
        screens[seed] = [cards, remarks]
    assert_as_recorded("first_screens", screens)


def drawn_table() -> pd.DataFrame:
    """Rows of made-up runs of every kind, with drawn outcomes in half of them."""
    table = report_tables.table(60)
    drawn = pd.DataFrame([drawn_record(seed) for seed in range(60)])
    names = ["evidence", "sine_margin", "coverage", "coverage_needed", "uncertified_reason"]
    table[names] = drawn[names]
    return table


def test_a_table_is_ranked_and_shown_as_recorded() -> None:
    table = drawn_table()
    verdicts = verdict_words(table)
    judged = table.assign(verdict=verdicts)
    best = sort_best_first(table)
    by_overshoot = rank_runs(table, "overshoot_worst")
    shown: dict[str, Any] = {}
    shown["verdicts"] = [list(verdicts), verdict_counts(table)]
    shown["classes"] = outcome_class(table).tolist()
    ratios = settling_ratio(table)
    shown["ratios"] = ratios.to_numpy(dtype=float)
    shown["best"] = list(best["run"])
    shown["by"] = list(by_overshoot["run"])
    shown["rows"] = render_table(best.head(25)).splitlines()
    shown["summary"] = status_summary_lines(table, 25)
    shown["seeds"] = seed_statistics_lines(table)
    shown["columns"] = column_description_lines(table)
    shown["failures"] = failure_groups(judged)
    assert_as_recorded("tables", shown)
