"""Table of a study with one row per run, gathered from its run folders: `runs.parquet` and
`runs.csv`."""

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
    add_digest,
    read_json_with_digest,
    read_limited_bytes,
    sha256_of_file,
    write_atomically,
    write_json_atomically,
)
from ssm_study.engine.records import LOST, RECORD, RUNNING, read_record
from ssm_study.refusal import require
from ssm_study.table.columns import BY_NAME, find_declaration

PARQUET = "runs.parquet"
CSV = "runs.csv"
MARKS = ".gathered.json"
FileStates = dict[str, list[int]]
# Kind of a column that nobody declares, by what pandas infers; all else is text.
KINDS: dict[str, Kind] = {
    "boolean": "boolean",
    "integer": "Int64",
    "floating": "Float64",
    "mixed-integer-float": "Float64",
}
INFINITE = {"inf": float("inf"), "-inf": float("-inf")}  # as records have them
# Types that need no conversion.
EXACT = {"string": str, "Int64": int, "Float64": float, "boolean": bool}
NO_RUNS = pd.DataFrame({"run": [], "status": []})
FORMULA = r"^[=+\-@\t\r]"  # how a text begins that a spreadsheet would run instead of showing it


def gather(study: Path, anew: bool = False, must_write: bool = True) -> pd.DataFrame:
    """Bring the table files `runs.parquet` and `runs.csv` of a study up to date with its runs.

    Returns the table. The declared columns come first, typed; whatever else the records hold
    follows by name. Runs are sorted by name, so that equal studies give equal tables. Only records
    that have changed since the last time are read again; all of them `anew`, whatever the last
    table says. Raises `BadRequest` for a folder without runs, and `OSError` for one that cannot be
    written to, unless the table need not be written (`must_write`).
    """
    remedy = "give the folder that holds the run folders"
    is_folder = study.is_dir()
    require(is_folder, "study", study, "no such study folder", remedy)
    marks = record_file_states(study)
    has_runs = bool(marks)
    require(has_runs, "study", study, "there is no run in it", remedy)
    last_table, last_marks = (NO_RUNS, {}) if anew else _read_last_table(study)
    unfinished = [RUNNING, LOST]
    has_ended = ~last_table["status"].isin(unfinished)
    names = last_table["run"][has_ended]
    ended = [name for name in names if name in marks]
    unchanged = {name for name in ended if marks[name] == last_marks.get(name)}
    if len(unchanged) == len(last_table) == len(marks):  # no run is new, gone or changed
        return last_table
    is_unchanged = last_table["run"].isin(unchanged)
    rows = last_table[is_unchanged]
    old_records = _rows_by_run(rows)
    study_name = study.resolve().name
    records = []
    for name in sorted(marks):
        record = old_records.get(name) or read_record(study / name)
        if record is not None:
            identity = {"study": study_name, "run": name}
            records.append(record | identity)
    table = table_from_records(records)
    try:
        _write_table(study, table, marks)
    except OSError:
        if must_write:
            raise
    return table


def _write_table(study: Path, table: pd.DataFrame, marks: FileStates) -> None:
    """Write a study's results table to its files, with the states of the record files, by which
    later changes are noticed."""
    parquet = io.BytesIO()
    table.to_parquet(parquet, index=False)
    safe_table = _escape_formulas(table)
    csv = safe_table.to_csv(index=False)
    write_atomically(study / PARQUET, parquet.getvalue())
    write_atomically(study / CSV, csv.encode())
    names = (PARQUET, CSV)
    checksums = {name: sha256_of_file(study / name) for name in names}
    body = checksums | {"marks": marks}
    write_json_atomically(study / MARKS, add_digest(body))


def record_file_states(study: Path) -> FileStates:
    """Modification time, size and inode of each run's record file, by the name of the run."""
    with os.scandir(study) as entries:
        visible = [entry for entry in entries if not entry.name.startswith(".")]
        names = [entry.name for entry in visible if entry.is_dir()]
    marks = {}
    for name in names:
        with suppress(OSError):  # a folder without a record, or one that another process deletes
            record_file = study / name / RECORD
            facts = record_file.stat()
            # A record is replaced, so its inode changes.
            marks[name] = [facts.st_mtime_ns, facts.st_size, facts.st_ino]
    return marks


def _read_last_table(study: Path) -> tuple[pd.DataFrame, FileStates]:
    """Read the results table as it was last gathered, with the file states of its records; empty if
    its files were changed."""
    with suppress(OSError):
        index = read_json_with_digest(read_limited_bytes(study / MARKS))
        if index is not None:
            files = (PARQUET, CSV)
            if all(sha256_of_file(study / name) == index[name] for name in files):
                table = pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable")
                return table, index["marks"]
    return NO_RUNS, {}


def rows_differ_from_records(study: Path, rows: pd.DataFrame) -> bool:
    """Whether any row of a results table differs from the record of its run. Declared columns are
    compared."""
    records = _rows_by_run(rows)
    for run, row in records.items():
        identity = {"study": row["study"], "run": run}
        record = (read_record(study / run) or {}) | identity
        for name, shown_value in row.items():
            column = find_declaration(name)
            if column is None:
                continue
            kind = column.kind or cast(Kind, rows[name].dtype.name)
            stored_value = record.get(name)
            if shown_value != _value_of_kind(stored_value, kind):
                return True
    return False


def table_file_defects(study: Path) -> list[str]:
    """Sentences that say where the table files of a study differ from the records of its runs. Rows
    of runs that had not ended when the table was written are not compared."""
    try:
        table = pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable")
        rows = {str(row.run): table.iloc[[place]] for place, row in enumerate(table.itertuples())}
        has_ended = ~table["status"].isin([RUNNING, LOST])
        ended = [str(name) for name in table["run"][has_ended]]
        wrong = [name for name in ended if rows_differ_from_records(study, rows[name])]
        expected_csv = _escape_formulas(table).to_csv(index=False).encode()
    except (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        return [f"{PARQUET} cannot be read ({type(error).__name__})"]
    defects = []
    if wrong:
        defects.append(f"{PARQUET} differs from the record of {', '.join(wrong[:3])}")
    with suppress(OSError):
        content = read_limited_bytes(study / CSV)
        if content != expected_csv:
            defects.append(f"{CSV} differs from {PARQUET}")
    return defects


def _rows_by_run(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Rows of a results table as dictionaries, by the name of the run, with None for missing
    values."""
    columns = [values.astype(object).where(values.notna(), None) for _, values in rows.items()]
    names = [str(name) for name in rows]
    records = {}
    for row in zip(*columns, strict=True):
        cells = zip(names, row, strict=True)
        record = dict(cells)
        records[record["run"]] = record
    return records


def _escape_formulas(table: pd.DataFrame) -> pd.DataFrame:
    """Copy of a table with an apostrophe before texts that a spreadsheet would run as formulas."""
    text_table: pd.DataFrame = table.select_dtypes("string")
    texts: pd.Index = text_table.columns
    quoted = {}
    for name in texts:
        values = table[name]
        if values.str.match(FORMULA, na=False).any():
            quoted[name] = values.str.replace(FORMULA, r"'\g<0>", regex=True)
    return table.assign(**quoted)


def table_from_records(records: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Build a table with typed columns that allow missing values from the records of runs.

    All declared columns, and the further ones that hold a value somewhere.
    """
    records = list(records)
    names = {name for record in records for name, value in record.items() if value is not None}
    undeclared = sorted(name for name in names if name not in BY_NAME)
    columns = {}
    for name in (*BY_NAME, *undeclared):
        values = [record.get(name) for record in records]
        declaration = find_declaration(name)
        columns[name] = _typed_column(values, declaration)
    return pd.DataFrame(columns)


def _typed_column(values: list[Any], column: Column | None) -> pd.Series:
    """Convert values to a table column of the declared type, or else of their own type, in which
    values may be missing."""
    kind = column.kind if column else None
    if kind is None:
        present = [INFINITE.get(value, value) for value in values if value is not None]
        inferred = infer_dtype(present)
        kind = KINDS.get(inferred, "string")
    types = set(map(type, values))
    exact_types = {EXACT[kind], type(None)}
    is_exact = types <= exact_types
    if is_exact and kind != "Int64":  # as records have them
        return pd.Series(values, dtype=kind)
    typed_values = [_value_of_kind(value, kind) for value in values]
    return pd.Series(typed_values, dtype=kind)


def _value_of_kind(value: Any, kind: Kind) -> Any:
    """Convert a value to the type of its table column; None for a value of another type.

    A text in a column of numbers is missing, not 0.
    """
    if kind == "string":
        return None if value is None else str(value)
    if isinstance(value, bool) or kind == "boolean":
        return value if isinstance(value, bool) and kind == "boolean" else None
    if not isinstance(value, int | float) and value not in INFINITE:
        return None
    if kind == "Float64":
        return float(value)
    return int(value) if isinstance(value, int) or float(value).is_integer() else None
