"""A thousand run folders, one tidy table: `runs.parquet` and `runs.csv`, one row per run, missing is null."""

import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from ssm_study.refusal import require
from ssm_study.results.columns import BY_NAME, COLUMNS, Kind
from ssm_study.results.durable import sealed, sha256_of_file, unsealed, write_atomically, write_json_atomically
from ssm_study.results.records import LOST, RECORD, RUNNING, read_record

PARQUET, CSV, MARKS = "runs.parquet", "runs.csv", ".gathered.json"
Marks = dict[str, list[int]]


def gather(study: Path) -> pd.DataFrame:
    """Bring `runs.parquet` and `runs.csv` of the study folder up to date with its runs; returns the table.

    The agreed columns come first, typed; whatever else the records hold follows by name. Runs are sorted by name, so
    that equal studies give equal tables. Only records that have changed since the last time are read again.
    """
    require(study.is_dir(), "study", study, "no such study folder", "give the folder that holds the run folders")
    marks = marks_of(study)
    require(bool(marks), "study", study, "there is no run in it", "give the folder that holds the run folders")
    known = _gathered(study)
    kept = {name: row for name, row in known.items() if row["mark"] == marks.get(name)}
    if len(kept) == len(known) == len(marks):
        return pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable")
    records = (kept[name]["record"] if name in kept else _record(study, name) for name in sorted(marks))
    table = table_of(record for record in records if record is not None)
    _write(study, table, marks)
    return table


def marks_of(study: Path) -> Marks:
    """Modification time, size and inode of every record below the study folder, by the name of its run."""
    marks: Marks = {}
    with os.scandir(study) as entries:
        names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    for name in names:
        try:
            facts = (study / name / RECORD).stat()
        except OSError:
            continue
        marks[name] = [facts.st_mtime_ns, facts.st_size, facts.st_ino]
    return marks


def _record(study: Path, name: str) -> dict[str, Any] | None:
    record = read_record(study / name)
    return None if record is None else record | {"study": study.resolve().name, "run": name}


def _gathered(study: Path) -> dict[str, dict[str, Any]]:
    """The rows of the last table and their marks, if its files are unharmed; runs under way are left out."""
    try:
        index = unsealed((study / MARKS).read_bytes())
        if index is None or any(sha256_of_file(study / name) != index[name] for name in (PARQUET, CSV)):
            return {}
        rows = pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable").astype(object)
    except OSError:
        return {}
    records = rows.where(rows.notna(), None).to_dict("records")
    settled = [record for record in records if record["status"] not in (RUNNING, LOST)]
    return {record["run"]: {"record": record, "mark": index["marks"].get(record["run"])} for record in settled}


def _write(study: Path, table: pd.DataFrame, marks: Marks) -> None:
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    write_atomically(study / PARQUET, buffer.getvalue())
    write_atomically(study / CSV, table.to_csv(index=False).encode())
    sums = {name: sha256_of_file(study / name) for name in (PARQUET, CSV)}
    write_json_atomically(study / MARKS, sealed(sums | {"marks": marks}))


def table_of(records: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The records as a table of typed, nullable columns; of the further ones those that hold a value somewhere."""
    records = list(records)
    names = {name for record in records for name, value in record.items() if value is not None}
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
