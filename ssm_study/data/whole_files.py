"""Log files that are read into memory as a whole, with a limit on their size."""

from pathlib import Path

from ssm_study.durable import open_regular_file
from ssm_study.refusal import require

MIB = 2**20


def read_whole_file(path: Path, most_bytes: int, remedy: str) -> bytes:
    """Read a log file as bytes. Raises `BadRequest` for a larger file, before any of it is read."""
    with open_regular_file(path) as stream:
        size = path.stat().st_size
        problem = (
            f"has {size / MIB:.0f} MiB, more than the {most_bytes / MIB:.0f} MiB that are read"
        )
        require(size <= most_bytes, "data.path", path, problem, remedy)
        return stream.read()
