"""A rule that the import contracts of `pyproject.toml` cannot say: which names classes have.

How long files and functions may be is in `test_code_shape.py`.
"""

import ast
from pathlib import Path

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
