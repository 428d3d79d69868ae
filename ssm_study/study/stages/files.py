"""The JSON files of a stage."""

import json
from pathlib import Path
from typing import Any

from ssm_study.durable import contents


def read_json(path: Path) -> Any:
    """The content of a file of the stage."""
    return json.loads(contents(path))


def write_json(path: Path, content: Any) -> None:
    """Readable JSON; refuses numbers that JSON does not have (`ValueError`)."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
