"""Words for what the record of an earlier version need not state."""

from collections.abc import Iterator, Mapping
from typing import Any

from ssm_study.engine.records import OK, VERSION

EARLIER = "not stated (made by an earlier version)"


def is_of_earlier_version(record: Mapping[str, Any]) -> bool:
    """Whether a record of a design is of a version that need not state every column."""
    is_older = int(record.get("record_version") or VERSION) < VERSION
    return is_older and record.get("status") == OK


def unstated_rows(record: Mapping[str, Any], label: str) -> Iterator[tuple[str, str, str]]:
    """Row of the outcome that says of an older record what it does not state; empty of others."""
    if is_of_earlier_version(record):
        yield "record_version", label, EARLIER
