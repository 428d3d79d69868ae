"""The page on the architecture speaks of the tree as it is: every path, class and column exists."""

import ast
import re
from pathlib import Path

import pytest

from ssm_study.table.columns import find_declaration

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ssm_study"
PAGE = (ROOT / "docs" / "architecture.md").read_text()
CODE = re.compile(r"`([^`\n]+)`")
NUMBERS = {"eleven": 11, "twelve": 12, "thirteen": 13, "fourteen": 14}
# Written by the page as words of a file's content, of a command or of a formula.
PATH = re.compile(r"[a-z_0-9/*]+(?:\.py|\.yaml|/[a-z_]*)")


def quantity_rows() -> list[list[str]]:
    """Cells of the table of quantities, without its head."""
    section = PAGE.split("## One name per quantity")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def defined_names() -> dict[str, set[str]]:
    """Names in the body of each class of the package, by the name of the class."""
    names: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ClassDef):
                continue
            body = names.setdefault(node.name, set())
            for part in node.body:
                if isinstance(part, ast.FunctionDef):
                    body.add(part.name)
                elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                    body.add(part.target.id)
    return names


PATHS = sorted({word for word in CODE.findall(PAGE) if PATH.fullmatch(word)})
COLUMNS = sorted({name for row in quantity_rows() for name in CODE.findall(row[3])})
ATTRIBUTES = re.findall(r"`([A-Z]\w+)\.([a-z]\w+)`", PAGE)


@pytest.mark.parametrize("path", PATHS)
def test_every_path_exists(path: str) -> None:
    found = [*PACKAGE.glob(path.strip("/")), *ROOT.glob(path.strip("/"))]
    assert found


@pytest.mark.parametrize("name", COLUMNS)
def test_every_column_is_declared(name: str) -> None:
    assert find_declaration(name) is not None


def test_every_class_has_what_the_page_names() -> None:
    names = defined_names()
    absent = [f"{kind}.{name}" for kind, name in ATTRIBUTES if name not in names.get(kind, set())]
    assert ATTRIBUTES
    assert absent == []


def test_a_quantity_has_a_name_in_the_code() -> None:
    rows = quantity_rows()
    assert len(rows) >= 12
    assert all(len(row) == 4 and CODE.search(row[1]) for row in rows)


def test_as_many_decisions_as_the_title_says() -> None:
    title = re.search(r"^## (\w+) decisions$", PAGE, re.MULTILINE)
    assert title is not None
    numbers = [int(number) for number in re.findall(r"^\*\*(\d+)\. ", PAGE, re.MULTILINE)]
    assert numbers == list(range(1, NUMBERS[title[1].lower()] + 1))
    assert f"{title[1].lower()} decisions" in PAGE.split("\n## ")[0]
