"""Rules that the import contracts of `pyproject.toml` cannot say: which names classes have, and
that the groups of test files in `conftest.py` name files.

How long files and functions may be is in `test_code_shape.py`.
"""

import ast
from pathlib import Path

from conftest import DRAWING, LONG, WHOLE_RUNS

TESTS = Path(__file__).resolve().parents[1]
ROOT = Path(__file__).resolve().parents[2] / "ssm_study"


def test_a_class_has_its_name_alone() -> None:
    """`api.design.Design` is what `certificate.Design` is to users of the library; no other name
    stands for two things."""
    names = []
    for path in ROOT.rglob("*.py"):
        text = path.read_text()
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef):
                names.append(node.name)
    assert {name for name in names if names.count(name) > 1} == {"Design"}


def test_groups_of_test_files_name_files() -> None:
    """A file that is renamed would leave its group in silence: `make test` would run it."""
    files = {path.stem for path in TESTS.rglob("test_*.py")}
    assert files >= LONG
    assert files >= WHOLE_RUNS
    assert DRAWING <= WHOLE_RUNS
