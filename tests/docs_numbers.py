"""Outcomes printed in the docs beside what the program prints: the same words, nearly the same
numbers."""

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from rich.console import Console

from ssm_study.report.outcome import print_outcome
from ssm_study.report.run_facts import RunFacts

DOCS = Path(__file__).resolve().parents[1] / "docs"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
NEAR = 0.1  # share by which a number may differ on another processor
TEXT_BLOCK = re.compile(r"^```text\n(.*?)^```", re.M | re.S)


def printed_outcome(record: Mapping[str, Any], facts: RunFacts) -> str:
    """The outcome table of a run as plain text, without the figures."""
    stream = io.StringIO()
    console = Console(file=stream, width=80, no_color=True)
    print_outcome(record, (), console, facts)
    return stream.getvalue()


def text_blocks(page: str) -> list[str]:
    """Every block of program output on a page, in order."""
    text = (DOCS / page).read_text()
    return TEXT_BLOCK.findall(text)


def outcome_on_page(page: str, first_words: str) -> str:
    """The block of a page that begins with these words, without run name and figures."""
    (block,) = [block for block in text_blocks(page) if block.startswith(first_words)]
    lines = block.splitlines()
    return "\n".join(line for line in lines if not line.startswith(("Run ", "  res")))


def assert_outcome_holds(on_page: str, printed: str) -> None:
    """The block, as far as it goes, is a stretch of what the program prints.

    Words agree exactly; a number may differ by `NEAR` of itself.
    """
    text = " ".join(on_page.split())
    words = NUMBER.sub("#", text)
    begun = " ".join(printed.split())
    place = NUMBER.sub("#", begun).find(words)
    assert place >= 0, f"the program prints other words:\n{printed}"
    skipped = NUMBER.sub("#", begun)[:place].count("#")
    numbers = NUMBER.findall(on_page)
    stated = [float(number) for number in numbers]
    numbers = NUMBER.findall(printed)
    actual = [float(number) for number in numbers][skipped:]
    for number, other in zip(stated, actual, strict=False):
        assert number == pytest.approx(other, rel=NEAR), f"{number} on the page, {other} printed"


def table_on_page(page: str, column: str) -> pd.DataFrame:
    """The table of runs on a page whose headings name this column, between two spaces or more."""
    blocks = [block for block in text_blocks(page) if block.startswith("run  ")]
    (block,) = [block for block in blocks if f"  {column}  " in block.partition("\n")[0]]
    lines = block.partition("\n\n")[0].splitlines()
    heads, *rows = [re.split(r"\s{2,}", line.strip()) for line in lines]
    return pd.DataFrame(rows, columns=heads)
