"""CSV: comma separated, a header of names or none, declared number columns; all else is refused
with its line."""

import csv
import re
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv as arrow_csv

from ssm_study.data.readers.reader import Reader, Table, arrow_numbers, check_named
from ssm_study.refusal import BadRequest, require

HEADER_BYTES = 1 << 20
BAD_CELL = re.compile(r"In CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", re.DOTALL)
STATED_UNIT = re.compile(r"^\s*(.*?)\s*(?:\[([^\]]*)\])?\s*$", re.DOTALL)  # "speed [rad/s]"
DATE = re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.]+(Z|[-+][\d:]+)?$")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|nan|[-+]?inf(inity)?", re.IGNORECASE)


class CsvReader(Reader, names=(".csv",)):
    """The named columns; a header cell `speed [rad/s]` is column `speed` and states its unit.

    A first line of numbers is a row, and its columns go by their numbers from 0; but `0,1,2` are
    names that count.
    Where the first row has a date and time (ISO 8601), the column is seconds since then.
    """

    def read(self, path: Path, names: list[str]) -> Table:
        raw_names = _header(path)
        stated = [STATED_UNIT.findall(raw)[0] for raw in raw_names]
        plain, numbers = [name for name, _ in stated], list(map(str, range(len(raw_names))))
        bare = plain != numbers and all(map(NUMBER.fullmatch, plain))
        whole, remedy = "header", "name one of these"
        if bare:
            plain = raw_names = numbers
            whole, remedy = (
                "file without names",
                "count the columns from 0, or write names into the first line",
            )
        check_named(f"{path.name} (column)", names, plain, whole, remedy)
        raw, first_row = {name: raw_names[plain.index(name)] for name in names}, 1 if bare else 2
        columns = arrow_numbers(path, _parse(path, raw, plain, bare, {}), raw, "line", first_row)
        return Table(
            columns=columns,
            units={} if bare else dict(stated),
            row_word="line",
            first_row=first_row,
        )


def _header(path: Path) -> list[str]:
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    require(
        b"\0" not in start,
        "data.path",
        path,
        "contains NUL bytes, so it is no text",
        "export it as CSV",
    )
    try:
        first = next(csv.reader(start.decode("utf-8-sig", errors="strict").splitlines()[:1]))
    except (StopIteration, UnicodeDecodeError, csv.Error) as error:
        raise BadRequest(
            "data.path", path, "has no header line of readable text", "export it as UTF-8 CSV"
        ) from error
    remedy = "export it with commas between columns and points in numbers"
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        commas = len(first) > 1 or mark not in "".join(first)
        require(
            commas, f"{path.name} (header)", "".join(first), f"looks separated by {name}", remedy
        )
    return first


def _parse(
    path: Path, raw: dict[str, str], plain: list[str], bare: bool, dated: dict[str, Any]
) -> pa.Table:
    """Every row must have as many cells as the first; those of a wanted column must be numbers, or
    all dates."""
    kinds = dict.fromkeys(raw.values(), pa.float64()) | dated
    options = arrow_csv.ConvertOptions(
        column_types=kinds, include_columns=list(kinds), null_values=[""]
    )
    # One thread, so that errors name their row.
    one_thread = arrow_csv.ReadOptions(use_threads=False, column_names=plain if bare else None)
    try:
        return arrow_csv.read_csv(path, read_options=one_thread, convert_options=options)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        cell = BAD_CELL.search(str(error))
        if cell is None or int(cell[1]) >= len(plain):
            raise BadRequest(
                path.name, error, "a row that does not fit", "correct the file there"
            ) from error
        name, line = plain[int(cell[1])], cell[2]
        if (
            (date := DATE.match(cell[3]))
            and line == ("1" if bare else "2")
            and raw[name] not in dated
        ):
            return _parse(
                path, raw, plain, bare, dated | {raw[name]: pa.timestamp("ns", date[1] and "UTC")}
            )
        problem = "no date and time as 2026-01-31 12:00:00.5" if raw[name] in dated else "no number"
        where = f"{path.name}, column {name}, line {line}"
        raise BadRequest(where, cell[3], problem, "correct the file there") from error
