"""Reader of text files with any suffix. Separator, decimal mark, encoding, names and units are
found in the file."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from pyarrow import csv as arrow_csv

from ssm_study.data.dates import AmbiguousDatesError, dates_to_seconds, is_date
from ssm_study.data.readers.reader import Reader, Table, require_column_index
from ssm_study.data.text_cells import MISSING
from ssm_study.data.text_layout import TextLayout, TextSettings, detect_layout
from ssm_study.data.whole_files import read_whole_file
from ssm_study.data.written_numbers import AMBIGUOUS, normalise_numbers
from ssm_study.refusal import BadRequest

ColumnValues = Float[np.ndarray, "T"]

# A title and its unit in brackets of either kind.
STATED_UNIT = re.compile(r"^\s*(.*?)\s*(?:\[([^\]]*)\]|\(([^()]*)\))?\s*$", re.DOTALL)
MOST_BYTES = 1 << 30  # of a text that is read at once
MOSTLY = 0.5  # share of numbers, from which on a column's first other cell is named
NUMBER = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
DATE_ALONE = r"^\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}$"
TIME_ALONE = r"^\d{1,2}:\d\d(:\d\d([.,]\d+)?)?(\s*[AaPp]\.?\s?[Mm]\.?)?$"
INFINITE = r"^[-+]?(inf|infinity)$"


class TextReader(Reader, names=(".csv", ".txt", ".tsv", ".dat", ".asc", ".log", ".prn", "")):
    """Reader of delimited text files, such as CSV, whose format is detected. Columns have the names
    in the first line, or numbers from 0.

    A header cell `speed [rad/s]` or `speed (rad/s)` is also column `speed`, and states its unit; so
    does a row of units below the names. Dates and times become seconds since the first. An empty
    cell, NaN and the like are missing: NaN in the table.
    """

    _parsed: tuple[Path, TextLayout, pa.Table] | None = None

    @classmethod
    def from_text(cls, path: Path, text: str, settings: TextSettings) -> "TextReader":
        """Make a reader that reads a given text in place of a file, such as the sheet of a
        spreadsheet."""
        reader = cls()
        reader.settings = settings
        layout = detect_layout(path, text.encode(), settings)
        reader._parsed = (path, layout, parse_rows(path, layout))
        return reader

    def read_columns(self, path: Path, names: list[str]) -> Table:
        layout, table = self._parse_file(path)
        titles = blank_duplicate_titles(column_titles(layout), table)
        places = {
            name: require_column_index(path, name, titles, self.settings.header) for name in names
        }
        columns = {}
        for name, place in places.items():
            values, problem = parse_column(table.column(place), layout)
            if values is None:
                raise unreadable_cell_error(path, name, table.column(place), layout, problem)
            columns[name] = values
        units = column_units(layout)
        own_units = {name: units[place] for name, place in places.items()}
        return Table(
            columns=columns,
            units=own_units,
            row_word="line",
            row_numbers=layout.line_numbers,
            remark=layout.describe(),
            dated=date_column_names(table, places),
        )

    def read_all_columns(self, path: Path) -> Table:
        layout, table = self._parse_file(path)
        titles = column_titles(layout)
        units = column_units(layout)
        places = {title: place for place, title in enumerate(titles)}
        columns = {}
        skipped = {}
        for title, place in places.items():
            values, problem = parse_column(table.column(place), layout)
            if values is None:
                where = describe_first_unread_cell(table.column(place), layout)
                skipped[title] = f"{problem}{where}"
            else:
                columns[title] = values
        drop_empty_last_column(columns, titles[-1], layout.names is None)
        dated = date_column_names(table, places)
        of_day = find_time_of_day_column(table)
        if of_day is not None:
            title = titles[of_day[0]]
            columns[title] = of_day[1]
            dated = dated | {title}
            skipped.pop(title, None)
        in_order = {title: columns[title] for title in titles if title in columns}
        own_units = {title: units[places[title]] for title in columns}
        return Table(
            columns=in_order,
            units=own_units,
            row_word="line",
            row_numbers=layout.line_numbers,
            remark=layout.describe(),
            skipped=skipped,
            dated=dated,
            nameless=layout.names is None,
        )

    def _parse_file(self, path: Path) -> tuple[TextLayout, pa.Table]:
        """Detected layout and parsed cells of a text file, computed once and then cached."""
        if self._parsed is None or self._parsed[0] != path:
            remedy = "split it, or convert it to Parquet"
            content = read_whole_file(path, MOST_BYTES, "data.path", remedy)
            layout = detect_layout(path, content, self.settings)
            self._parsed = (path, layout, parse_rows(path, layout))
        return self._parsed[1:]


def blank_duplicate_titles(titles: list[str], table: pa.Table) -> list[str]:
    """Titles of all columns, empty for a column that repeats an earlier one in title and values."""
    unique_titles = list(titles)
    for place, title in enumerate(titles):
        first = titles.index(title)
        if first == place:
            continue
        if table.column(first).equals(table.column(place)):
            unique_titles[place] = ""
    return unique_titles


def drop_empty_last_column(columns: dict[str, Any], title: str, nameless: bool) -> None:
    """Remove the empty last column that results from a separator at the end of every row."""
    is_nameless = title == "" or nameless
    is_last = is_nameless and len(columns) > 1 and title in columns
    if is_last and not np.isfinite(columns[title]).any():
        del columns[title]


def column_titles(layout: TextLayout) -> list[str]:
    """Titles of the columns of a text file, or the column numbers 0, 1, 2, ... where the file has
    no titles."""
    if layout.names is None:
        return [str(j) for j in range(layout.columns)]
    names = layout.names[: layout.columns]
    titles = [name.strip() for name in names]
    missing = layout.columns - len(titles)
    return titles + [""] * missing


def column_units(layout: TextLayout) -> list[str]:
    """Units of the columns of a text file, from the titles or from a row of units; empty where none
    is stated."""
    if layout.units:
        padded = layout.units + [""] * layout.columns
        return padded[: layout.columns]
    matches = [STATED_UNIT.match(title) for title in column_titles(layout)]
    return [(match[2] or match[3] or "") if match else "" for match in matches]


def parse_rows(path: Path, layout: TextLayout) -> pa.Table:
    """Split the rows of a text file into columns of text. Raises `BadRequest` if the rows have
    different numbers of cells."""
    separator = layout.separator
    rows = layout.rows
    if separator == " ":
        separator = "\t"
        rows = ["\t".join(row.split()) for row in rows]
    places = [str(j) for j in range(layout.columns)]
    misfits: list[arrow_csv.InvalidRow] = []

    def collect_misfit_row(row: arrow_csv.InvalidRow) -> str:
        """Store a row with a wrong number of cells for the error message, and tell the CSV parser
        to skip the row."""
        misfits.append(row)
        return "skip"

    read = arrow_csv.ReadOptions(use_threads=False, column_names=places)
    parse = arrow_csv.ParseOptions(delimiter=separator, invalid_row_handler=collect_misfit_row)
    kinds = dict.fromkeys(places, pa.string())
    convert = arrow_csv.ConvertOptions(column_types=kinds, strings_can_be_null=False)
    text = "\n".join(rows)
    content = pa.BufferReader(text.encode("utf-8", errors="replace"))
    try:
        table = arrow_csv.read_csv(
            content, read_options=read, parse_options=parse, convert_options=convert
        )
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        problem = "this row has another number of cells"
        remedy = "correct the file there"
        raise BadRequest(path.name, error, problem, remedy) from error
    for row in misfits:
        line = layout.line_numbers[row.number - 1]
        misfit = f"Row #{line}: Expected {row.expected_columns} columns, got {row.actual_columns}"
        raise BadRequest(
            path.name, misfit, "this row has another number of cells", "correct the file there"
        )
    if table.num_rows != len(rows):
        problem = "an opening quotation mark has no closing one"
        remedy = "correct the file"
        raise BadRequest("data.path", path, problem, remedy)
    return table


def strip_cells(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Remove the spaces around the text in every cell of a column."""
    return pc.utf8_trim_whitespace(column)


def missing_cell_mask(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """For each cell of a column, whether its text stands for a missing value."""
    words = pa.array(sorted(MISSING))
    return pc.is_in(pc.utf8_lower(cells), value_set=words)


def parse_column(column: pa.ChunkedArray, layout: TextLayout) -> tuple[ColumnValues | None, str]:
    """Parse a column of text to numbers, or dates to seconds; for other texts, return None and a
    description of them. For a column of other texts, return None and a description of the texts."""
    cells = strip_cells(column)
    missing = missing_cell_mask(cells)
    plain = cells
    has_groups = False
    if layout.decimal == ",":
        plain = pc.replace_substring(cells, ",", ".")
        has_points = pc.match_substring(cells, ".")
        has_groups = pc.any(has_points).as_py()
    if has_groups or not are_numbers(plain, missing):
        plain, ambiguity = normalise_numbers(cells, missing, layout.decimal)
        if ambiguity:
            return None, ambiguity
        if not are_numbers(plain, missing):
            return parse_dates(cells, missing)
    infinite = pc.match_substring_regex(plain, INFINITE, ignore_case=True)
    bare = pc.replace_substring_regex(plain, r"^\+", "")
    bare = pc.if_else(missing, None, bare)
    bare = pc.if_else(infinite, "inf", bare)
    values = pc.cast(bare, pa.float64()).to_numpy()
    return np.array(values, dtype=np.float64), ""


def are_numbers(cells: pa.ChunkedArray, missing: pa.ChunkedArray) -> bool:
    """Whether every cell of a column is a number, infinite or missing."""
    number = pc.match_substring_regex(cells, NUMBER)
    infinite = pc.match_substring_regex(cells, INFINITE, ignore_case=True)
    is_finite = pc.or_(missing, number)
    is_good = pc.or_(is_finite, infinite)
    return bool(pc.all(is_good).as_py())


def parse_dates(
    cells: pa.ChunkedArray, missing: pa.ChunkedArray
) -> tuple[ColumnValues | None, str]:
    """Convert cells with dates to seconds since the first date, or return None and the reason why
    they cannot be read."""
    filled = pc.filter(cells, pc.invert(missing))
    first = filled.slice(0, 1).to_pylist()
    if not first or not is_date(first[0]):
        return None, "no number"
    try:
        seconds = dates_to_seconds(cells.to_pylist())
    except AmbiguousDatesError:
        return None, "days and months cannot be told apart"
    unread = ~np.isfinite(seconds) & ~missing.to_numpy()
    if unread.any():
        return None, "no date and time as 2026-01-31 12:00:00.5"
    return seconds, ""


def find_time_of_day_column(table: pa.Table) -> tuple[int, ColumnValues] | None:
    """Find a column of times of day beside a column of dates, and combine both to seconds since the
    first row."""
    for place in range(table.num_columns):
        if not all_cells_match(table.column(place), TIME_ALONE):
            continue
        for other in (place - 1, place + 1):
            if 0 <= other < table.num_columns and all_cells_match(table.column(other), DATE_ALONE):
                dates = strip_cells(table.column(other)).to_pylist()
                times = strip_cells(table.column(place)).to_pylist()
                pairs = zip(dates, times, strict=True)
                cells = [f"{date} {time}" for date, time in pairs]
                try:
                    return place, dates_to_seconds(cells)
                except AmbiguousDatesError:
                    return None
    return None


def all_cells_match(column: pa.ChunkedArray, form: str) -> bool:
    """Whether every cell of a column matches a regular expression."""
    matches = pc.match_substring_regex(strip_cells(column), form)
    return bool(pc.all(matches).as_py())


def date_column_names(table: pa.Table, places: dict[str, int]) -> frozenset[str]:
    """Names of the columns of a text table that contain dates."""
    dated = set()
    for name, place in places.items():
        first = table.column(place).slice(0, 50)
        cells = strip_cells(first).to_pylist()
        filled = [cell for cell in cells if cell.lower() not in MISSING]
        if filled and is_date(filled[0]):
            dated.add(name)
    return frozenset(dated)


def describe_first_unread_cell(column: pa.ChunkedArray, layout: TextLayout) -> str:
    """Text that quotes the first cell of a column that should be a number but is not."""
    cells = strip_cells(column)
    plain = normalise_numbers(cells, missing_cell_mask(cells), layout.decimal)[0]
    is_number = pc.match_substring_regex(plain, NUMBER)
    share = pc.mean(is_number.cast(pa.float64())).as_py()
    if share < MOSTLY:
        return ""
    row = pc.index(is_number, False).as_py()
    return f" in line {layout.line_numbers[row]}: {cells[row].as_py()}"


def unreadable_cell_error(
    path: Path, name: str, column: pa.ChunkedArray, layout: TextLayout, problem: str
) -> BadRequest:
    """Error that quotes the first cell of a column that is neither a number nor a date."""
    cells = strip_cells(column)
    where = f"{path.name}, column {name}"
    texts = cells.to_pylist()
    if problem == AMBIGUOUS:
        mark = "," if layout.decimal == "." else "."
        cell = next(text for text in texts if mark in text)
        remedy = f"write {cell.replace(mark, '')} or {cell.replace(mark, layout.decimal)}"
        return BadRequest(where, cell, problem, f"{remedy}, whichever is meant")
    dated = problem.startswith("no date")
    plain = normalise_numbers(cells, missing_cell_mask(cells), layout.decimal)[0].to_pylist()
    for text, number, line in zip(texts, plain, layout.line_numbers, strict=True):
        good = is_date(text) if dated else re.match(NUMBER, number)
        if not good and text.lower() not in MISSING:
            return BadRequest(f"{where}, line {line}", text, problem, "correct the file there")
    return BadRequest(where, texts[0], problem, "write dates as 2026-01-31 12:00:00")
