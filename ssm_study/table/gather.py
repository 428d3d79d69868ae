"""A thousand run folders, one tidy table: `runs.parquet` and `runs.csv`, one row per run, missing
is null."""

import io
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import pandas as pd
from pandas.api.types import infer_dtype

from ssm_study.columns import Column, Kind
from ssm_study.durable import (
    contents,
    sealed,
    sha256_of_file,
    unsealed,
    write_atomically,
    write_json_atomically,
)
from ssm_study.engine.records import LOST, RECORD, RUNNING, read_record
from ssm_study.refusal import require
from ssm_study.table.columns import BY_NAME, declared

PARQUET = "runs.parquet"
CSV = "runs.csv"
MARKS = ".gathered.json"
# Of a column that nobody declares, as pandas infers it; all else is text.
KINDS: dict[str, Kind] = {
    "boolean": "boolean", "integer": "Int64", "floating": "Float64",
    "mixed-integer-float": "Float64",
}  # fmt: skip
INFINITE = {"inf": float("inf"), "-inf": float("-inf")}  # as records have them
EXACT = {
    "string": str,
    "Int64": int,
    "Float64": float,
    "boolean": bool,
}  # no conversion is needed of these
NO_RUNS = pd.DataFrame({"run": [], "status": []})
FORMULA = r"^[=+\-@\t\r]"  # how a text begins that a spreadsheet would run instead of showing it


def gather(study: Path, anew: bool = False) -> pd.DataFrame:
    """Bring `runs.parquet` and `runs.csv` of the study folder up to date with its runs; returns the
    table.

    The declared columns come first, typed; whatever else the records hold follows by name. Runs are
    sorted by name, so that equal studies give equal tables. Only records that have changed since
    the last time are read again; all of them `anew`, whatever the last table says. Raises
    `BadRequest` for a folder without runs.
    """
    remedy = "give the folder that holds the run folders"
    require(study.is_dir(), "study", study, "no such study folder", remedy)
    marks = marks_of(study)
    require(bool(marks), "study", study, "there is no run in it", remedy)
    last, known = (NO_RUNS, {}) if anew else _gathered(study)
    ended = last["run"][~last["status"].isin([RUNNING, LOST])]
    same = {name for name in ended if name in marks and marks[name] == known.get(name)}
    if len(same) == len(last) == len(marks):  # nothing new, nothing gone, nothing changed
        return last
    kept = _records(last[last["run"].isin(same)])
    found = {name: kept.get(name) or read_record(study / name) for name in sorted(marks)}
    this = study.resolve().name
    table = table_of(
        record | {"study": this, "run": name}
        for name, record in found.items()
        if record is not None
    )
    parquet = io.BytesIO()
    table.to_parquet(parquet, index=False)
    write_atomically(study / PARQUET, parquet.getvalue())
    write_atomically(study / CSV, _harmless(table).to_csv(index=False).encode())
    sums = {name: sha256_of_file(study / name) for name in (PARQUET, CSV)}
    write_json_atomically(
        study / MARKS, sealed(sums | {"marks": marks})
    )  # last: it vouches for both
    return table


def marks_of(study: Path) -> dict[str, list[int]]:
    """Modification time, size and inode of every record below the study folder, by the name of its
    run."""
    marks = {}
    with os.scandir(study) as entries:
        names = [
            entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()
        ]
    for name in names:
        with suppress(OSError):  # a folder without a record, or one that another process deletes
            facts = (study / name / RECORD).stat()
            marks[name] = [
                facts.st_mtime_ns,
                facts.st_size,
                facts.st_ino,
            ]  # a record is replaced, so its inode changes
    return marks


def _gathered(study: Path) -> tuple[pd.DataFrame, dict[str, list[int]]]:
    """The last table and the marks it was made by; without rows where its files are not
    unharmed."""
    with suppress(OSError):
        index = unsealed(contents(study / MARKS))
        if index is not None and all(
            sha256_of_file(study / name) == index[name] for name in (PARQUET, CSV)
        ):
            return pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable"), index["marks"]
    return NO_RUNS, {}


def contradicted(study: Path, rows: pd.DataFrame) -> bool:
    """Whether a declared column of one of these rows is not what the record of its run says."""
    for run, row in _records(rows).items():
        record = (read_record(study / run) or {}) | {"study": row["study"], "run": run}
        kinds = {
            name: column.kind or cast(Kind, rows[name].dtype.name)
            for name in row
            if (column := declared(name))
        }
        if any(row[name] != _fitting(record.get(name), kind) for name, kind in kinds.items()):
            return True
    return False


def _records(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """The rows by run, as JSON has them: no NA of pandas."""
    columns = [values.astype(object).where(values.notna(), None) for _, values in rows.items()]
    made = (dict(zip(map(str, rows), row, strict=True)) for row in zip(*columns, strict=True))
    return {record["run"]: record for record in made}


def _harmless(table: pd.DataFrame) -> pd.DataFrame:
    """A text that a spreadsheet would take for a formula is quoted by an apostrophe, as
    spreadsheets do."""
    texts: pd.Index = table.select_dtypes("string").columns
    risky = [name for name in texts if table[name].str.match(FORMULA, na=False).any()]
    return table.assign(
        **{name: table[name].str.replace(FORMULA, r"'\g<0>", regex=True) for name in risky}
    )


def table_of(records: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The records as a table of typed, nullable columns; of the further ones those that hold a
    value somewhere."""
    records = list(records)
    names = {name for record in records for name, value in record.items() if value is not None}
    extra = sorted(name for name in names if name not in BY_NAME)
    return pd.DataFrame(
        {
            name: _typed([r.get(name) for r in records], declared(name))
            for name in (*BY_NAME, *extra)
        }
    )


def _typed(values: list[Any], column: Column | None) -> pd.Series:
    kind = column.kind if column else None
    kind = (
        kind
        or KINDS.get(infer_dtype([INFINITE.get(v, v) for v in values if v is not None]))
        or "string"
    )
    if (
        set(map(type, values)) <= {EXACT[kind], type(None)} and kind != "Int64"
    ):  # as records have them
        return pd.Series(values, dtype=kind)
    return pd.Series([_fitting(value, kind) for value in values], dtype=kind)


def _fitting(value: Any, kind: Kind) -> Any:
    """`value` as the column's kind, or None if it is of another: a text in a column of numbers is
    missing, not 0."""
    if kind == "string":
        return None if value is None else str(value)
    if isinstance(value, bool) or kind == "boolean":
        return value if isinstance(value, bool) and kind == "boolean" else None
    if not isinstance(value, int | float) and value not in INFINITE:
        return None
    if kind == "Float64":
        return float(value)
    return int(value) if isinstance(value, int) or float(value).is_integer() else None
