"""Who computed a number, with what, where: git commit and dirtiness, versions, machine, threads."""

import os
import platform
import subprocess
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

LIBRARIES = ("torch", "lightning", "numpy", "scipy", "cvxpy", "clarabel", "python-flint", "hydra-core", "ssm-study")


@lru_cache(maxsize=1)
def provenance() -> dict[str, Any]:
    """Flat facts for a record; `git_commit` and `git_dirty` are None when the package does not lie in a repository."""
    return _git() | _versions() | _machine()


def _git() -> dict[str, Any]:
    commit = _ask_git("rev-parse", "HEAD")
    changes = _ask_git("status", "--porcelain", "--untracked-files=no")
    return {"git_commit": commit or None, "git_dirty": None if commit is None or changes is None else bool(changes)}


def _ask_git(*question: str) -> str | None:
    """git's answer about the repository that tracks this very file, else None."""
    here = Path(__file__).resolve()
    try:
        for arguments in (("ls-files", "--error-unmatch", here.name), question):
            answer = subprocess.run(
                ["git", "-C", str(here.parent), *arguments], capture_output=True, text=True, timeout=20, check=True
            )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _versions() -> dict[str, Any]:
    versions = {"version_python": platform.python_version()}
    for library in LIBRARIES:
        try:
            versions[f"version_{library.replace('-', '_')}"] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _machine() -> dict[str, Any]:
    return {
        "machine": platform.node(),
        "machine_system": platform.platform(),
        "machine_processor": _processor(),
        "machine_cores": len(os.sched_getaffinity(0)),
        "threads": int(os.environ.get("OMP_NUM_THREADS", 0)) or None,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
