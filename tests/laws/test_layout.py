"""The layout is a picture of the data flow: imports point upstream, and each third-party library
stays in its room."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "ssm_study"
FLOW = [
    "refusal",
    "columns",
    "extensions",
    "family",
    "construction",
    "engine",
    "signals",
    "systems",
    "plants",
    "data",
    "bounds",
    "models",
    "training",
    "synthesis",
    "evidence",
    "loop",
    "table",
    "export",
    "study",
    "report",
    "cli",
    "library",
    "conformance",
]
SPLIT = {"certificates": "synthesis", "robustness": "synthesis"}  # one level until they are untied
ROOMS = {
    "lightning": {"training"},
    "torch": {"models", "training", "export"},  # export: ONNX needs a torch cell
    "cvxpy": {"bounds", "certificates", "synthesis"},
    "flint": {"certificates"},
    "matplotlib": {"report"},
    "seaborn": {"report"},
    "hydra": {"engine", "study", "cli", "library", "conformance"},
    "foxglove": {"data"},
    "mcap": {"data"},
}


def imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def room(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


FILES = sorted(p for p in ROOT.rglob("*.py") if p != ROOT / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_upstream(path: Path) -> None:
    here = FLOW.index(SPLIT.get(room(path), room(path)))
    for name in imports(path):
        if name.startswith("ssm_study."):
            there = name.split(".")[1]
            assert FLOW.index(SPLIT.get(there, there)) <= here, (
                f"{path.name} in {room(path)} imports {name}, which lies downstream"
            )


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_third_party_libraries_stay_in_their_rooms(path: Path) -> None:
    for name in imports(path):
        library = name.split(".")[0]
        assert room(path) in ROOMS.get(library, {room(path)}), (
            f"{library} is imported in {room(path)}"
        )


LONGEST_FILE, LONGEST_FUNCTION = 500, 70  # until every room is unpacked: then 400, 40


def lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Of the body, its docstring left out."""
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
    """`library.Design` is what `certificate.Design` is to users of the library; no other name
    stands for two things."""
    found = [
        node.name
        for path in ROOT.rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    ]
    assert {name for name in found if found.count(name) > 1} == {"Design"}
