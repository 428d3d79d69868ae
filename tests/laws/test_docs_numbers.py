"""Numbers that the docs print are those that the program prints today."""

import json
from pathlib import Path

import pytest
from docs_numbers import assert_outcome_holds, outcome_on_page, printed_outcome

from ssm_study.report.run_facts import RunFacts

FACTS = RunFacts(step_s=0.01)


def test_the_tutorials_first_outcome_holds(smoke_run: Path) -> None:
    text = (smoke_run / "record.json").read_text()
    record = json.loads(text)
    on_page = outcome_on_page("tutorial.md", "Run                          smoke/")
    assert_outcome_holds(on_page, printed_outcome(record, RunFacts.from_run_folder(smoke_run)))


def test_another_number_or_word_is_noticed(smoke_run: Path) -> None:
    text = (smoke_run / "record.json").read_text()
    record = json.loads(text)
    printed = printed_outcome(record, FACTS)
    resolved_margin = 1.5 * record["resolved_margin"]
    other = printed_outcome(record | {"resolved_margin": resolved_margin}, FACTS)
    with pytest.raises(AssertionError, match="on the page"):
        assert_outcome_holds(other, printed)
    on_page = printed.replace("settled", "rested")
    with pytest.raises(AssertionError, match="other words"):
        assert_outcome_holds(on_page, printed)
