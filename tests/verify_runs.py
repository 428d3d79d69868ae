"""Runs whose parts are given objects, for the checks of `verify` that read no file."""

from pathlib import Path
from typing import Any

from ssm_study.study.run_files import RunFiles


def run_of(folder: Path = Path("run"), record: Any = None, **parts: Any) -> RunFiles:
    """Run whose parts are these objects; no file is read."""
    run = RunFiles(path=folder, record=record or {})
    vars(run).update(parts)
    return run
