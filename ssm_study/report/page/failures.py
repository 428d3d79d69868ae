"""Unsuccessful runs of a study (not certified, or loop not settled), grouped by reason."""

import re
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ssm_study.report.page.first_screen import (
    REASONS,
    failure_reasons,
    record_verdict,
    row_as_record,
)
from ssm_study.report.words import IDENTIFIED, LOST, NO_FASTER, SETTLED, UNTRIED
from ssm_study.table.alike_sentences import NUMBER, hide_numbers, merge_number_ranges

MOST_REASONS = 40
MOST_DIGITS = 4  # of a number in a reason
MOST_RUNS = 12  # of a reason that are named
SEVERITY = ("failed", "certified", "not certified", "infeasible")
NEEDED = ("verdict", "stable_count", "initial_conditions", *REASONS)
GOOD = {SETTLED.word, NO_FASTER.word, IDENTIFIED.word}


@dataclass(frozen=True, kw_only=True)
class FailureGroup:
    """Group of runs that failed for the same reason. `places` are the row numbers of the first of
    them in the results table."""

    reason: str
    count: int
    places: tuple[int, ...]


def failure_groups(table: pd.DataFrame) -> list[FailureGroup]:
    """Groups of runs of a study that failed for the same reason, the worst group first."""
    groups: dict[str, list[tuple[int, str]]] = {}
    needed = table[[name for name in NEEDED if name in table]]
    for place, verdict in enumerate(table["verdict"]):
        if verdict in GOOD:
            continue
        record = row_as_record(needed.iloc[place])
        sentence = f"{record['verdict']}: {failure_reason(record)}"
        groups.setdefault(hide_numbers(sentence), []).append((place, sentence))
    worst_first = sorted(groups, key=lambda sentence: (failure_severity(sentence), sentence))
    return [make_failure_group(groups[sentence]) for sentence in worst_first]


def make_failure_group(runs: list[tuple[int, str]]) -> FailureGroup:
    """Make a group from runs that failed for the same reason, with an explanation."""
    reason = merge_number_ranges([shorten_numbers(sentence) for _, sentence in runs])
    places = tuple(place for place, _ in runs[:MOST_RUNS])
    return FailureGroup(reason=reason, count=len(runs), places=places)


def failure_severity(sentence: str) -> int:
    """Rank of a failure sentence by severity, for sorting groups of failed runs."""
    return next((k for k, word in enumerate(SEVERITY) if sentence.startswith(word)), -1)


def failure_reason(record: dict[str, Any]) -> str:
    """Sentence with the reason why a run counts as unsuccessful, from its record."""
    if record["verdict"] == UNTRIED.word:
        return record_verdict(record).sentence
    if record["verdict"] == LOST.word:
        settled_count = record.get("stable_count") or 0
        starts = record.get("initial_conditions") or 0
        return f"{settled_count:.0f} of {starts:.0f} starts settle"
    return " ".join(failure_reasons(record)) or "no reason was recorded"


def shorten_numbers(sentence: str) -> str:
    """Sentence whose decimal numbers are cut to four digits, but never before the decimal point.
    Whole numbers and those with an exponent are unchanged."""
    return NUMBER.sub(lambda number: shorten_number(number[0]), sentence)


def shorten_number(text: str) -> str:
    """Text of a decimal number, cut towards zero to four digits, but never before the decimal
    point. Whole numbers and those with an exponent are unchanged."""
    digits = re.sub(r"e.*|\D", "", text).lstrip("0")
    if len(digits) <= MOST_DIGITS or "." not in text or "e" in text:
        return text
    surplus = min(len(digits) - MOST_DIGITS, len(text.partition(".")[2]))
    return text[:-surplus].removesuffix(".")
