"""Log files that are read into memory as a whole, with a limit on their size."""

from pathlib import Path

from ssm_study.durable import read_limited_bytes
from ssm_study.refusal import require

MIB = 2**20


def read_whole_file(path: Path, most_bytes: int, field: str, remedy: str) -> bytes:
    """Read a log file as bytes. Raises `BadRequest` for a larger file, before any of it is read;
    `field` is the setting that names the file."""
    size = path.stat().st_size
    size_mib = -(-size // MIB)  # rounded up
    problem = f"has {size_mib} MiB, more than the {most_bytes // MIB} MiB that are read"
    require(size <= most_bytes, field, path, problem, remedy)
    return read_limited_bytes(path, most_bytes)
