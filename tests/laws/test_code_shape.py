"""Shape of the code: limits that hold in every room of the package and in the tests.

A statement with many tokens holds several ideas; `benchmarks/code_shape.py` counts them. The
counter only warns; what is readable, a reader judges.
"""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ssm_study"
MOST_TOKENS = 10.6  # a statement, on average
MOST_LONG_PERCENT = 4.0  # of statements with 30 tokens or more
LONGEST_FILE = 400  # lines
LONGEST_BODY = 40  # lines of a function, its docstring left out
MOST_PACKED = 250  # assignments of several values to several names


def load_counter() -> ModuleType:
    """The counter, which is a script and in no package."""
    name = "code_shape"
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


code_shape = load_counter()
ROOMS = sorted(path.parent for path in PACKAGE.glob("*/__init__.py"))
FOLDERS = [*ROOMS, ROOT / "tests"]


@cache
def read_all_sources() -> list[Any]:
    """Every file of the package and of the tests, read and parsed once: no worker needs them but
    the one that runs these tests."""
    return [*code_shape.read_sources(PACKAGE), *code_shape.read_sources(ROOT / "tests")]


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("folder", FOLDERS, ids=name_of)
def test_no_room_is_dense(folder: Path) -> None:
    sources = [source for source in read_all_sources() if folder in source.path.parents]
    facts = code_shape.density_facts(sources)
    assert facts["tokens_a_statement"] <= MOST_TOKENS
    assert facts["long_statements_percent"] <= MOST_LONG_PERCENT


def test_files_are_short() -> None:
    lengths = {name_of(source.path): len(source.text.splitlines()) for source in read_all_sources()}
    long = {name for name, length in lengths.items() if length > LONGEST_FILE}
    assert long == set()


def test_functions_are_short() -> None:
    long = set()
    for source in read_all_sources():
        for function in source.functions:
            if code_shape.count_body_lines(function) > LONGEST_BODY:
                long.add(f"{name_of(source.path)}: {function.name}")
    assert long == set()


def test_assignments_are_not_packed() -> None:
    packed = [
        node for source in read_all_sources() for node in source.nodes if code_shape.is_packed(node)
    ]
    assert len(packed) <= MOST_PACKED


def test_no_line_is_wide_and_no_docstring_opens_with_a_riddle() -> None:
    wide = [
        name_of(source.path) for source in read_all_sources() if code_shape.count_wide_lines(source)
    ]
    assert wide == []
    riddles = [
        name_of(source.path)
        for source in read_all_sources()
        if any(code_shape.opens_with_a_riddle(node) for node in source.documented)
    ]
    assert riddles == []


def test_the_counter_sees_what_is_dense() -> None:
    """A text that breaks the limits is counted as one that does."""
    text = "def f(x):\n    a, b = x, 1\n    return [(y, z) for y in x for z in (a, b, y)]\n"
    density = code_shape.Density.of(text)
    expected = [6, 7, 22]
    assert density.statement_sizes == expected
    source = code_shape.Source(path=PACKAGE, text=text, nodes=[])
    actual = code_shape.count_wide_lines(source)
    assert actual == 0
