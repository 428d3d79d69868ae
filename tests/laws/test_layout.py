"""The layout is a picture of the data flow: imports point upstream, and each third-party library stays in its room."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "ssm_study"
FLOW = [
    "refusal",
    "signals",
    "systems",
    "plants",
    "data",
    "models",
    "training",
    "bounds",
    "synthesis",
    "loop",
    "results",
    "report",
    "sweeps",
    "specification",
    "stages",
    "members",
    "study",
    "advice",
    "cli",
]
ROOMS = {
    "lightning": {"training", "sweeps"},  # sweeps: the server of jobs preloads it
    "torch": {"models", "training", "sweeps", "report"},  # report: ONNX export needs a torch cell
    "cvxpy": {"bounds", "synthesis"},
    "flint": {"synthesis"},
    "matplotlib": {"report"},
    "seaborn": {"report"},
    "hydra": {"sweeps", "specification", "study", "advice", "cli"},
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
    here = FLOW.index(room(path))
    for name in imports(path):
        if name.startswith("ssm_study."):
            there = name.split(".")[1]
            assert FLOW.index(there) <= here, f"{path.name} in {room(path)} imports {name}, which lies downstream"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_third_party_libraries_stay_in_their_rooms(path: Path) -> None:
    for name in imports(path):
        library = name.split(".")[0]
        assert room(path) in ROOMS.get(library, {room(path)}), f"{library} is imported in {room(path)}"
