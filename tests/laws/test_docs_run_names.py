"""A run that a page names is one that a command on the page makes today: the name holds a hash of
all settings, so a new default changes it."""

import ast
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from docs_commands import SHELL, composed
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
DIGITS = re.compile(r"\b(?=\d*[a-f])(?=[a-f]*\d)[0-9a-f]{10}\b")
EXAMPLE = "1a2b3c4d5e"  # of docs/engine.md, which explains what a name is made of
# The lists in a notebook that hold the words of its commands.
WORDS = ("COMMAND", "FIRST", "SWEEP")
LOG = "results/Gewächshaus.txt"
PAPER = [["experiment=paper"]]


@cache
def run_digits(*words: str) -> str:
    config = composed(list(words))
    name = str(config.run)
    _, _, digits = name.rpartition("-")
    return digits


def digits_of_command(words: list[str]) -> set[str]:
    """Last digits of the names of all runs that a command makes, one or a whole sweep."""
    settings = [word for word in words if "=" in word]
    parser = OverridesParser.create()
    overrides = parser.parse_overrides(settings)
    (jobs,) = BasicSweeper.split_arguments(overrides, max_batch_size=None)
    return {run_digits(*job) for job in jobs}


def commands_of_notebook(name: str) -> list[list[str]]:
    """Words of the commands of a notebook; its lists of words are computed, nothing else is."""
    path = ROOT / "experiments" / f"{name}.py"
    source = path.read_text()
    tree = ast.parse(source)
    lists: dict[str, list[str]] = {}
    constants = {"LOG": LOG, "RESULTS": "results"}
    for node in tree.body:
        target = getattr(node, "target", None) or getattr(node, "targets", [None])[0]
        if getattr(target, "id", "") in WORDS:
            module = ast.Module([node], [])
            code = compile(module, name, "exec")
            exec(code, constants, lists)
    if name == "strange_log":
        first = lists["COMMAND"] + lists["FIRST"]
        return [first, [*first, "data.disturbance='Außen'"]]
    return [["experiment=paper", *lists["SWEEP"]]] if lists else PAPER


def commands_of_page(page: Path) -> list[list[str]]:
    """Words of the commands that begin a run, in the console blocks of a page."""
    text = page.read_text()
    blocks = SHELL.findall(text)
    lines = "\n".join(blocks).splitlines()
    return [shlex.split(line) for line in lines if line.startswith("ssm-study run ")]


PAGES = [*sorted(DOCS.rglob("*.md")), ROOT / "README.md"]
NAMING = [page for page in PAGES if set(DIGITS.findall(page.read_text())) - {EXAMPLE}]


def test_some_pages_name_runs() -> None:
    assert {page.stem for page in NAMING} >= {"tutorial", "the_paper", "reading_a_sweep"}


@pytest.mark.parametrize("page", NAMING, ids=lambda page: page.stem)
def test_the_runs_that_a_page_names_are_those_of_its_commands(page: Path) -> None:
    is_notebook = page.parent.name == "notebooks"
    commands = commands_of_notebook(page.stem) if is_notebook else commands_of_page(page)
    made = {digits for words in commands for digits in digits_of_command(words)}
    text = page.read_text()
    named = set(DIGITS.findall(text)) - {EXAMPLE}
    assert named <= made
