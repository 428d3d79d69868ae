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

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
NEAR = 0.1  # share by which a number may differ on another processor
FLAGS = re.M | re.S
TEXT_BLOCK = re.compile(r"^```text\n(.*?)^```", FLAGS)


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
    page_words = on_page.split()
    text = " ".join(page_words)
    words = NUMBER.sub("#", text)
    printed_words = printed.split()
    begun = " ".join(printed_words)
    printed_pattern = NUMBER.sub("#", begun)
    place = printed_pattern.find(words)
    assert place >= 0, f"the program prints other words:\n{printed}"
    skipped_words = printed_pattern[:place]
    skipped = skipped_words.count("#")
    numbers = NUMBER.findall(on_page)
    stated = [float(number) for number in numbers]
    numbers = NUMBER.findall(printed)
    all_printed = [float(number) for number in numbers]
    actual = all_printed[skipped:]
    pairs = zip(stated, actual, strict=False)
    for number, other in pairs:
        near = pytest.approx(other, rel=NEAR)
        assert number == near, f"{number} on the page, {other} printed"


def table_on_page(page: str, column: str) -> pd.DataFrame:
    """The table of runs on a page whose headings name this column, between two spaces or more."""
    blocks = [block for block in text_blocks(page) if block.startswith("run  ")]
    headings = {block: block.partition("\n")[0] for block in blocks}
    (block,) = [block for block in blocks if f"  {column}  " in headings[block]]
    parts_of_block = block.partition("\n\n")
    first_part = parts_of_block[0]
    lines = first_part.splitlines()
    heads, *rows = [re.split(r"\s{2,}", line.strip()) for line in lines]
    return pd.DataFrame(rows, columns=heads)
