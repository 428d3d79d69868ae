"""Record of a run in `record.json`: settings and results as one JSON object with a SHA-256 digest.
All tables and figures are made from records."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.durable import (
    add_digest,
    is_locked,
    read_json_with_digest,
    read_limited_bytes,
    write_json_atomically,
)
from ssm_study.refusal import BadRequest
from ssm_study.renamed import add_renamed_columns

RECORD = "record.json"
# Of what is written: a record of version 3 holds every column that its files give.
VERSION = 3
READABLE = (1, 2, 3)  # 1: before version 0.2.0; any other is not ours to interpret
OF_THE_FILE = ("record_version", "sha256")  # written anew each time
LOCK = ".lock"
LARGEST = 2**22  # bytes of a record: a real one has 5,000
# What `status` may be in the file; readers see two more: `lost` (says running, but nobody holds the
# lock) and `corrupt` (the file is not what was written).
RUNNING = "running"
OK = "ok"
INFEASIBLE = "infeasible"
FAILED = "failed"
LOST = "lost"
CORRUPT = "corrupt"
FINAL = (OK, INFEASIBLE, FAILED)  # no process is at work on it, nor was one stopped


def write_record(folder: Path, record: Mapping[str, Any], durable: bool = True) -> None:
    """Write the record of a run into its folder in one step, so that no reader sees half of it. NaN
    becomes null, infinities become the texts `inf` and `-inf`."""
    columns = {str(name): value for name, value in record.items() if name not in OF_THE_FILE}
    flat = {name: storable_value(name, value) for name, value in columns.items()}
    body = {"record_version": VERSION} | add_renamed_columns(flat)
    write_json_atomically(folder / RECORD, add_digest(body), durable)


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read the record of a run, with the run's present status; None if there is no record. The
    status may be `lost` or `corrupt`."""
    try:
        content = read_limited_bytes(folder / RECORD, LARGEST)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:  # no plain file, or one that no run wrote
        content = b""
    record = parse_record(content)
    # The lock decides, never a process number: after a restart, or on another machine, that may be
    # somebody else's.
    if record.get("status") == RUNNING and not is_locked(folder / LOCK):
        record["status"] = LOST
    return record


def parse_record(content: bytes) -> dict[str, Any]:
    """Parse the record of a run from the bytes of its file. Bytes that are not exactly a sealed
    record give only `status = corrupt`."""
    record = read_json_with_digest(content)
    version = None if record is None else record.get("record_version")
    if type(version) is not int or version not in READABLE:
        return {"status": CORRUPT}
    if (
        record is None
        or not isinstance(record.get("status"), str)
        or not _fit_in_64_bits(*record.values())
    ):
        return {"status": CORRUPT}
    return add_renamed_columns(record)


def _fit_in_64_bits(*values: Any) -> bool:
    """Whether all whole numbers among given values have at most 64 bits, as table columns
    require."""
    whole = [value for value in values if type(value) is int]
    return all(-(1 << 63) < value < 1 << 63 for value in whole)


def storable_value(key: str, value: Any) -> bool | int | float | str | None:
    """Convert a value to the form in which the record of a run stores it. Raises `BadRequest` for
    anything but a single number, text or truth value."""
    if isinstance(value, np.generic):  # a scalar of NumPy is written as Python's
        value = value.item()
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    if value is None or (isinstance(value, (bool, int, float, str)) and _fit_in_64_bits(value)):
        return value
    if isinstance(value, Path):
        return str(value)
    problem = f"a {type(value).__name__} does not fit a flat record"
    raise BadRequest(key, value, problem, "store a number or a text")
