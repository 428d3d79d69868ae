"""Writing of a stage's JSON files."""

import json
from pathlib import Path
from typing import Any


def write_json(path: Path, content: Any) -> None:
    """Write a value into a file as readable JSON. Raises `ValueError` for NaN and infinity."""
    text = json.dumps(content, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
