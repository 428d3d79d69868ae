"""Provenance of a result: git commit and uncommitted changes, versions, machine, threads."""

import os
import platform
import subprocess
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any


@cache
def provenance_columns(libraries: tuple[str, ...], source: Path) -> dict[str, Any]:
    """Columns of a record that say how a result was made: commit, versions, machine and threads.
    `git_commit` and `git_dirty` are None where no repository tracks the file `source`."""
    source = source.resolve()
    commit = _git_output(source, "rev-parse", "HEAD")
    changes = _git_output(source, "status", "--porcelain", "--untracked-files=no")
    is_tracked = commit is not None and changes is not None
    facts: dict[str, Any] = {
        "git_commit": commit or None,
        "git_dirty": bool(changes) if is_tracked else None,
        "version_python": platform.python_version(),
    }
    for library in libraries:
        with suppress(metadata.PackageNotFoundError):
            facts[f"version_{library.replace('-', '_')}"] = metadata.version(library)
    facts["machine"] = platform.node()
    facts["machine_system"] = platform.platform()
    facts["machine_processor"] = _processor_name()
    facts["machine_cores"] = len(os.sched_getaffinity(0))
    facts["threads"] = int(os.environ.get("OMP_NUM_THREADS", 0)) or None
    return facts


def _git_output(path: Path, *git_arguments: str) -> str | None:
    """Output of a git command in the repository that tracks a file; None if no repository tracks
    it."""
    with suppress(OSError, subprocess.SubprocessError):
        for arguments in (("ls-files", "--error-unmatch", path.name), git_arguments):
            command = ["git", "-C", str(path.parent), *arguments]
            answer = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
        return answer.stdout.strip()
    return None


def _processor_name() -> str:
    """Model name of this machine's processor."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        named = next(line for line in lines if line.startswith("model name"))
        return named.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
