"""CSV: comma separated, a header of names, declared number columns; all else is refused with its line."""

import csv
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from ssm_study.data.table import INTERPOLATE, Table
from ssm_study.refusal import BadRequest, require

HEADER_BYTES = 1 << 20
BAD_CELL = re.compile(r"In CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", re.DOTALL)
STATED_UNIT = re.compile(r"^(.*?)\s*\[([^\]]*)\]$")  # "speed [rad/s]"


def read_csv(path: Path, names: list[str]) -> Table:
    """The named columns; a header cell `speed [rad/s]` is column `speed` and states its unit."""
    raw_names = _header(path)
    plain = [_plain(raw) for raw in raw_names]
    remedy = "write the names into the first line" if all(map(_is_number, plain)) else "name one of these"
    for name in names:
        found = plain.count(name)
        require(found > 0, f"{path.name} (column)", name, f"the header has {_listing(plain)}", remedy)
        require(found == 1, f"{path.name} (column)", name, f"the header has it {found} times", "rename the others")
    raw = {name: raw_names[plain.index(name)] for name in names}
    table = _parse(path, list(raw.values()))
    columns = {name: _numbers(path, name, table.column(raw[name])) for name in names}
    units = {name: match[2] for name in names if (match := STATED_UNIT.match(raw[name].strip()))}
    return Table(columns=columns, units=units, row_word="line", first_row=2)


def _header(path: Path) -> list[str]:
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    require(b"\0" not in start, "data.path", path, "contains NUL bytes, so it is no text", "export it as CSV")
    try:
        first = next(csv.reader(start.decode("utf-8-sig", errors="strict").splitlines()[:1]))
    except (StopIteration, UnicodeDecodeError, csv.Error) as error:
        raise BadRequest("data.path", path, "has no header line of readable text", "export it as UTF-8 CSV") from error
    require(
        len(first) > 1 or ";" not in "".join(first),
        f"{path.name} (header)",
        first[0] if first else "",
        "looks separated by semicolons",
        "export it with commas between columns and points in numbers",
    )
    return first


def _plain(raw: str) -> str:
    match = STATED_UNIT.match(raw.strip())
    return match[1] if match else raw.strip()


def _is_number(name: str) -> bool:
    try:
        float(name)
    except ValueError:
        return False
    return True


def _listing(names: list[str]) -> str:
    shown = [name for name in names if name][:12]
    return ", ".join(shown) + (" ..." if len(names) > len(shown) + 1 else "")


def _parse(path: Path, raw_names: list[str]) -> pa.Table:
    """Every row must have as many cells as the header; cells of the wanted columns must be numbers."""
    try:
        return arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(use_threads=False),  # one thread, so that errors name their row
            convert_options=arrow_csv.ConvertOptions(
                column_types={raw: pa.float64() for raw in raw_names}, include_columns=raw_names, null_values=[""]
            ),
        )
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        cell, header = BAD_CELL.search(str(error)), _header(path)
        if cell and int(cell[1]) < len(header):
            name = _plain(header[int(cell[1])])
            where = f"{path.name}, column {name}, line {cell[2]}"
            raise BadRequest(where, cell[3], "no number", "correct the file there") from error
        raise BadRequest(path.name, reason, "a row that does not fit", "correct the file there") from error


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> np.ndarray:
    values = column.to_numpy()
    if column.null_count:
        line = 2 + int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise BadRequest(f"{path.name}, column {name}, line {line}", "(empty)", "no number", INTERPOLATE)
    return np.ascontiguousarray(values, dtype=np.float64)
