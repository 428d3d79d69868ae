"""Text for results that may be missing in a record written by an earlier version."""

from collections.abc import Iterator, Mapping
from typing import Any

from ssm_study.engine.records import OK, VERSION

EARLIER = "not stated (made by an earlier version)"


def is_of_earlier_version(record: Mapping[str, Any]) -> bool:
    """Whether the record of a run with a design was written by an earlier version, whose records
    may lack columns."""
    is_older = int(record.get("record_version") or VERSION) < VERSION
    return is_older and record.get("status") == OK


def earlier_version_rows(record: Mapping[str, Any], label: str) -> Iterator[tuple[str, str, str]]:
    """Row of a printed outcome which says that an earlier version wrote the record, so that some
    results are not stated. Empty for other records."""
    if is_of_earlier_version(record):
        yield "record_version", label, EARLIER
