"""A thousand run folders, one tidy table: `runs.parquet` and `runs.csv`, one row per run, missing is null."""

import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from ssm_study.refusal import require
from ssm_study.results.columns import BY_NAME, COLUMNS, Kind
from ssm_study.results.durable import write_atomically
from ssm_study.results.records import read_record

PARQUET, CSV = "runs.parquet", "runs.csv"


def gather(study: Path) -> pd.DataFrame:
    """Read every run of the study folder and (re)write its `runs.parquet` and `runs.csv`; returns the table.

    The CONTRACT's columns come first, typed; whatever else the records hold follows by name. Runs are sorted by name,
    so that equal studies give equal tables.
    """
    records = read_runs(study)
    require(bool(records), "study", study, "there is no run in it", "give the folder that holds the run folders")
    table = table_of(records)
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    write_atomically(study / PARQUET, buffer.getvalue())
    write_atomically(study / CSV, table.to_csv(index=False).encode())
    return table


def read_runs(study: Path) -> list[dict[str, Any]]:
    """One record per run folder, with `study` and `run` as the folders say; unreadable ones have `status = corrupt`."""
    require(study.is_dir(), "study", study, "no such study folder", "give the folder that holds the run folders")
    with os.scandir(study) as entries:
        names = sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
    found = ((name, read_record(study / name)) for name in names)
    return [record | {"study": study.resolve().name, "run": name} for name, record in found if record is not None]


def table_of(records: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The records as a table of typed, nullable columns."""
    records = list(records)
    names = {name: None for record in records for name in record}
    extra = sorted(name for name in names if name not in BY_NAME)
    columns = {column.name: _typed([r.get(column.name) for r in records], column.kind) for column in COLUMNS}
    columns |= {name: _typed(values, _kind_of(values)) for name in extra for values in [[r.get(name) for r in records]]}
    return pd.DataFrame(columns)


def _typed(values: list[Any], kind: Kind) -> pd.Series:
    return pd.Series([_fitting(value, kind) for value in values], dtype=kind)


def _fitting(value: Any, kind: Kind) -> Any:
    """`value` as the column's kind, or None if it is of another: a text in a column of numbers is missing, not 0."""
    if kind == "string":
        return None if value is None else str(value)
    if kind == "boolean":
        return value if isinstance(value, bool) else None
    if isinstance(value, bool) or value is None:
        return None
    if kind == "Float64":
        return float(value) if isinstance(value, (int, float)) or value in ("inf", "-inf") else None
    return int(value) if isinstance(value, (int, float)) and value == int(value) else None


def _kind_of(values: list[Any]) -> Kind:
    present = [value for value in values if value is not None]
    if present and all(isinstance(value, bool) for value in present):
        return "boolean"
    if present and all(isinstance(value, int) and not isinstance(value, bool) for value in present):
        return "Int64" if all(abs(value) < 2**63 for value in present) else "string"
    if present and all(_is_number(value) for value in present):
        return "Float64"
    return "string"


def _is_number(value: Any) -> bool:
    return (isinstance(value, (int, float)) and not isinstance(value, bool)) or value in ("inf", "-inf")
