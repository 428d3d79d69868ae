"""Reader of text files of any suffix. Separator, decimal mark, encoding, names and units are found
in the file."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from pyarrow import csv as arrow_csv

from ssm_study.data.dates import AmbiguousDates, is_date, seconds_since_first
from ssm_study.data.readers.reader import Reader, Table, place_of
from ssm_study.data.text_layout import MISSING, TextLayout, TextSettings, find_layout
from ssm_study.refusal import BadRequest

# A title and its unit in brackets of either kind.
STATED_UNIT = re.compile(r"^\s*(.*?)\s*(?:\[([^\]]*)\]|\(([^()]*)\))?\s*$", re.DOTALL)
NUMBER = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
INFINITE = r"^[-+]?(inf|infinity)$"


class TextReader(Reader, names=(".csv", ".txt", ".tsv", ".dat", ".asc", ".log", ".prn", "")):
    """Reader of delimited text files. Columns by the names of the first line, or by their numbers
    from 0.

    A header cell `speed [rad/s]` or `speed (rad/s)` is also column `speed`, and states its unit; so
    does a row of units below the names. Dates and times become seconds since the first. An empty
    cell, NaN and the like are missing: NaN in the table.
    """

    _parsed: tuple[Path, TextLayout, pa.Table] | None = None

    @classmethod
    def of_text(cls, path: Path, text: str, settings: TextSettings) -> "TextReader":
        """Make a reader of a text that stands for the file at `path`, such as a sheet."""
        reader = cls()
        reader.settings = settings
        layout = find_layout(path, text.encode(), settings)
        reader._parsed = (path, layout, parse_rows(path, layout))
        return reader

    def read(self, path: Path, names: list[str]) -> Table:
        layout, table = self._table(path)
        titles = without_copies(titles_of(layout), table)
        places = {name: place_of(path, name, titles, self.settings.header) for name in names}
        columns = {}
        for name, place in places.items():
            values, problem = column_values(table.column(place), layout)
            if values is None:
                raise not_a_number(path, name, table.column(place), layout, problem)
            columns[name] = values
        units = units_of(layout)
        return Table(
            columns=columns,
            units={name: units[place] for name, place in places.items()},
            row_word="line",
            row_numbers=layout.line_numbers,
            remark=layout.describe(),
            dated=dated_columns(table, places),
        )

    def contents(self, path: Path) -> Table:
        layout, table = self._table(path)
        titles = titles_of(layout)
        units = units_of(layout)
        places = {title: place for place, title in enumerate(titles)}
        columns = {}
        skipped = {}
        for title, place in places.items():
            values, problem = column_values(table.column(place), layout)
            if values is None:
                skipped[title] = problem
            else:
                columns[title] = values
        drop_empty_end(columns, titles[-1], layout.names is None)
        return Table(
            columns=columns,
            units={title: units[places[title]] for title in columns},
            row_word="line",
            row_numbers=layout.line_numbers,
            remark=layout.describe(),
            skipped=skipped,
            dated=dated_columns(table, places),
            nameless=layout.names is None,
        )

    def _table(self, path: Path) -> tuple[TextLayout, pa.Table]:
        """Layout and cells of a text file, parsed once for each reader."""
        if self._parsed is None or self._parsed[0] != path:
            layout = find_layout(path, path.read_bytes(), self.settings)
            self._parsed = (path, layout, parse_rows(path, layout))
        return self._parsed[1:]


def without_copies(titles: list[str], table: pa.Table) -> list[str]:
    """Remove the titles of columns that repeat an earlier column under the same name."""
    kept = list(titles)
    for place, title in enumerate(titles):
        first = titles.index(title)
        if first < place and table.column(first).equals(table.column(place)):
            kept[place] = ""
    return kept


def drop_empty_end(columns: dict[str, Any], title: str, nameless: bool) -> None:
    """Remove the empty last column that a separator at the end of every row makes."""
    is_last = (title == "" or nameless) and len(columns) > 1 and title in columns
    if is_last and not np.isfinite(columns[title]).any():
        del columns[title]


def titles_of(layout: TextLayout) -> list[str]:
    """The names of the columns, or their numbers from 0."""
    if layout.names is None:
        return [str(j) for j in range(layout.columns)]
    titles = [name.strip() for name in layout.names][: layout.columns]
    return titles + [""] * (layout.columns - len(titles))


def units_of(layout: TextLayout) -> list[str]:
    """Unit of each column, stated in its name or in a row of units. Empty where none is stated."""
    if layout.units:
        return (layout.units + [""] * layout.columns)[: layout.columns]
    matches = [STATED_UNIT.match(title) for title in titles_of(layout)]
    return [(match[2] or match[3] or "") if match else "" for match in matches]


def parse_rows(path: Path, layout: TextLayout) -> pa.Table:
    """Parse the rows to columns of text. Raises `BadRequest` where a row has not as many cells as
    the others."""
    separator = layout.separator
    rows = layout.rows
    if separator == " ":
        separator = "\t"
        rows = ["\t".join(row.split()) for row in rows]
    places = [str(j) for j in range(layout.columns)]
    misfits: list[arrow_csv.InvalidRow] = []

    def note_misfit(row: arrow_csv.InvalidRow) -> str:
        misfits.append(row)
        return "skip"

    read = arrow_csv.ReadOptions(use_threads=False, column_names=places)
    parse = arrow_csv.ParseOptions(delimiter=separator, invalid_row_handler=note_misfit)
    kinds = dict.fromkeys(places, pa.string())
    convert = arrow_csv.ConvertOptions(column_types=kinds, strings_can_be_null=False)
    content = pa.BufferReader("\n".join(rows).encode("utf-8", errors="replace"))
    try:
        table = arrow_csv.read_csv(
            content, read_options=read, parse_options=parse, convert_options=convert
        )
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        problem = "a row that does not fit"
        remedy = "correct the file there"
        raise BadRequest(path.name, error, problem, remedy) from error
    for row in misfits:
        line = layout.line_numbers[row.number - 1]
        misfit = f"Row #{line}: Expected {row.expected_columns} columns, got {row.actual_columns}"
        raise BadRequest(path.name, misfit, "a row that does not fit", "correct the file there")
    if table.num_rows != len(rows):
        problem = "quotation marks that open and do not close"
        remedy = "correct the file"
        raise BadRequest("data.path", path, problem, remedy)
    return table


def trimmed(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Strip the spaces around the cells of a column."""
    return pc.utf8_trim_whitespace(column)


def is_missing(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Mark the cells that state a missing value."""
    return pc.is_in(pc.utf8_lower(cells), value_set=pa.array(sorted(MISSING)))


def column_values(
    column: pa.ChunkedArray, layout: TextLayout
) -> tuple[Float[np.ndarray, "T"] | None, str]:
    """Numbers of a column. For a column without numbers, None and what it holds instead."""
    cells = trimmed(column)
    missing = is_missing(cells)
    plain = pc.replace_substring(cells, ",", ".") if layout.decimal == "," else cells
    number = pc.match_substring_regex(plain, NUMBER)
    infinite = pc.match_substring_regex(plain, INFINITE, ignore_case=True)
    if not pc.all(pc.or_(pc.or_(missing, number), infinite)).as_py():
        return date_values(cells, missing)
    bare = pc.replace_substring_regex(plain, r"^\+", "")
    bare = pc.if_else(infinite, "inf", pc.if_else(missing, None, bare))
    values = pc.cast(bare, pa.float64()).to_numpy()
    return np.array(values, dtype=np.float64), ""


def date_values(
    cells: pa.ChunkedArray, missing: pa.ChunkedArray
) -> tuple[Float[np.ndarray, "T"] | None, str]:
    """Convert dates to seconds since the first, or return None and the obstacle."""
    first = pc.filter(cells, pc.invert(missing)).slice(0, 1).to_pylist()
    if not first or not is_date(first[0]):
        return None, "no number"
    try:
        seconds = seconds_since_first(cells.to_pylist())
    except AmbiguousDates:
        return None, "days and months cannot be told apart"
    unread = ~np.isfinite(seconds) & ~missing.to_numpy()
    if unread.any():
        return None, "no date and time as 2026-01-31 12:00:00.5"
    return seconds, ""


def dated_columns(table: pa.Table, places: dict[str, int]) -> frozenset[str]:
    """Names of the columns that hold dates."""
    dated = set()
    for name, place in places.items():
        cells = trimmed(table.column(place)).slice(0, 50).to_pylist()
        filled = [cell for cell in cells if cell.lower() not in MISSING]
        if filled and is_date(filled[0]):
            dated.add(name)
    return frozenset(dated)


def not_a_number(
    path: Path, name: str, column: pa.ChunkedArray, layout: TextLayout, problem: str
) -> BadRequest:
    """Construct the refusal of a column, at its first cell that is no number (or no date among
    dates)."""
    cells = trimmed(column).to_pylist()
    dated = problem.startswith("no date")
    for cell, line in zip(cells, layout.line_numbers, strict=True):
        plain = cell.replace(",", ".") if layout.decimal == "," else cell
        good = is_date(cell) if dated else re.match(NUMBER, plain)
        if not good and cell.lower() not in MISSING:
            where = f"{path.name}, column {name}, line {line}"
            return BadRequest(where, cell, problem, "correct the file there")
    where = f"{path.name}, column {name}"
    return BadRequest(where, cells[0], problem, "write dates as 2026-01-31 12:00:00")
