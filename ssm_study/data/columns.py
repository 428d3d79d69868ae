"""Named columns of numbers from a file, whatever its format; the format is told by the file's suffix."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.csv_columns import read_csv
from ssm_study.data.mat_columns import read_mat
from ssm_study.data.mcap_columns import read_mcap_columns
from ssm_study.data.parquet_columns import read_parquet
from ssm_study.data.table import INTERPOLATE, Table
from ssm_study.refusal import BadRequest, require

READERS: dict[str, Callable[[Path, list[str]], Table]] = {
    ".csv": read_csv,
    ".mat": read_mat,
    ".parquet": read_parquet,
    ".mcap": read_mcap_columns,
}


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Columns asked of a file, and the units they are believed to be in ("" where nothing is claimed)."""

    names: tuple[str, ...]
    units: tuple[str, ...]


def read_table(path: Path, wanted: Wanted) -> Table:
    """The wanted columns, finite and of one length.

    Raises `BadRequest` for a suffix that is not `.csv`, `.mat`, `.parquet` or `.mcap`, a missing or malformed file, a
    missing column, values that are no finite numbers, unequal lengths, or a unit that the file contradicts.
    """
    require(path.is_file(), "data.path", path, "no such file", "check the spelling")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise BadRequest("data.path", path, f"the suffix is none of {', '.join(READERS)}", "convert the file")
    names = list(dict.fromkeys(wanted.names))
    table = reader(path, names)
    _check(path, table, names)
    for name, unit in zip(wanted.names, wanted.units, strict=True):
        stated = table.units.get(name, "")
        require(
            not unit or not stated or unit == stated,
            f"unit of {name}",
            unit,
            f"{path.name} states {stated}",
            "declare the unit the file is in",
        )
    return table


def _check(path: Path, table: Table, names: list[str]) -> None:
    lengths = {name: len(table.columns[name]) for name in names}
    require(
        len(set(lengths.values())) == 1, f"{path.name} (lengths)", lengths, "columns differ in length", "cut them alike"
    )
    for name in names:
        _check_finite(path, table, name, table.columns[name])


def _check_finite(path: Path, table: Table, name: str, values: Float[np.ndarray, "T"]) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        where = f"{path.name}, column {name}, {table.row_word} {bad[0] + table.first_row}"
        raise BadRequest(where, values[bad[0]], "not a finite number", INTERPOLATE)
