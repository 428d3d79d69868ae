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
QUANTITIES_TITLE = "## One name per quantity"
# Written by the page as words of a file's content, of a command or of a formula.
PATH = re.compile(r"[a-z_0-9/*]+(?:\.py|\.yaml|/[a-z_]*)")


def quantity_rows() -> list[list[str]]:
    """Cells of the table of quantities, without its head."""
    _, section, *_ = PAGE.split(QUANTITIES_TITLE)
    text = section.split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = []
    for line in lines[2:]:
        cells = line.strip("|").split("|")
        rows.append([cell.strip() for cell in cells])
    return rows


def name_in_body(part: ast.stmt) -> str | None:
    """The name that a statement of a class body gives to a method or to an annotated field."""
    if isinstance(part, ast.FunctionDef):
        return part.name
    if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
        return part.target.id
    return None


def defined_names() -> dict[str, set[str]]:
    """Names in the body of each class of the package, by the name of the class."""
    names: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        module = ast.parse(path.read_text())
        for node in ast.walk(module):
            if isinstance(node, ast.ClassDef):
                body = names.setdefault(node.name, set())
                in_body = [name_in_body(part) for part in node.body]
                body.update(name for name in in_body if name is not None)
    return names


WORDS = set(CODE.findall(PAGE))
PATHS = sorted(word for word in WORDS if PATH.fullmatch(word))
COLUMN_CELLS = " ".join(row[3] for row in quantity_rows())
COLUMNS = sorted(set(CODE.findall(COLUMN_CELLS)))
ATTRIBUTES = re.findall(r"`([A-Z]\w+)\.([a-z]\w+)`", PAGE)


@pytest.mark.parametrize("path", PATHS)
def test_every_path_exists(path: str) -> None:
    pattern = path.strip("/")
    in_package = list(PACKAGE.glob(pattern))
    in_root = list(ROOT.glob(pattern))
    assert in_package or in_root


@pytest.mark.parametrize("name", COLUMNS)
def test_every_column_is_declared(name: str) -> None:
    assert find_declaration(name) is not None


def test_every_class_has_what_the_page_names() -> None:
    names = defined_names()
    absent = []
    for kind, name in ATTRIBUTES:
        if name not in names.get(kind, set()):
            absent.append(f"{kind}.{name}")
    assert ATTRIBUTES
    assert absent == []


def test_a_quantity_has_a_name_in_the_code() -> None:
    rows = quantity_rows()
    assert len(rows) >= 12
    for row in rows:
        assert len(row) == 4
        assert CODE.search(row[1])


def test_as_many_decisions_as_the_title_says() -> None:
    title = re.search(r"^## (\w+) decisions$", PAGE, re.MULTILINE)
    assert title is not None
    number = title[1].lower()
    decisions = re.findall(r"^\*\*(\d+)\. ", PAGE, re.MULTILINE)
    numbers = [int(decision) for decision in decisions]
    count = NUMBERS[number]
    assert numbers == list(range(1, count + 1))
    introduction = PAGE.split("\n## ")[0]
    assert f"{number} decisions" in introduction
