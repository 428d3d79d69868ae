"""Reading and writing of a stage's JSON files."""

import json
from pathlib import Path
from typing import Any

from ssm_study.durable import read_limited_bytes


def read_json(path: Path) -> Any:
    """Read the content of a JSON file."""
    return json.loads(read_limited_bytes(path))


def write_json(path: Path, content: Any) -> None:
    """Write a value into a file as readable JSON. Raises `ValueError` for NaN and infinity."""
    text = json.dumps(content, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
