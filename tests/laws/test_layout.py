"""Rules that the import contracts of `pyproject.toml` cannot say: how long files and functions are,
and which names classes have."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "ssm_study"
FILES = sorted(p for p in ROOT.rglob("*.py") if p != ROOT / "__init__.py")


LONGEST_FILE = 500
LONGEST_FUNCTION = 70  # until every room is unpacked: then 400, 40


def lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of lines of a function's body, its docstring left out."""
    first = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (function.end_lineno or 0) - first[0].lineno + 1 if first else 0


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_functions_stay_short(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST_FILE
    functions = [
        n
        for n in ast.walk(ast.parse(text))
        if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    long = [function.name for function in functions if lines(function) > LONGEST_FUNCTION]
    assert not long, long


def test_a_class_has_its_name_alone() -> None:
    """`api.design.Design` is what `certificate.Design` is to users of the library; no other name
    stands for two things."""
    found = [
        node.name
        for path in ROOT.rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    ]
    assert {name for name in found if found.count(name) > 1} == {"Design"}
