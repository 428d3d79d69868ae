"""Detection of a text file's layout: encoding, separator, decimal mark, comments, column names,
units.

All of it is found in the text itself, and any of it may be stated instead (`TextSettings`). The
rows of numbers decide: a separator and a decimal mark fit if they cut the rows into equally many
cells that are numbers, dates or missing. What stands above the first such row is names, units or
prose.
"""

import re
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

from ssm_study.data.mixed_decimals import describe_mixed_decimals
from ssm_study.data.text_cells import MISSING, is_number, is_value, split_cells
from ssm_study.data.text_encoding import decode_text
from ssm_study.data.text_header import (
    NumberedLine,
    can_be_header,
    count_phrase,
    numbered_column_names,
    parse_names_in_comment,
    refuse_shifted_names,
    remove_prose_below_table,
    remove_repeated_header_lines,
    split_names_and_units,
)
from ssm_study.refusal import BadRequest, require, require_one_of

SAMPLED_ROWS = 120
SEPARATORS = ("\t", ";", "|", ",", " ")  # tried in this order: the first of equals is taken
SPACES_GAIN = 0.05  # of the score, more than the bonus for columns, by which spaces must be better
WORDS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "spaces"}
BY_WORD = {word: mark for mark, word in WORDS.items()} | {r"\t": "\t"}
COMMENTS = ("#", "%", "//", '"#')
EXPORT = "export it as CSV with a line of names and rows of numbers"
SETTINGS_HELP = "data.separator and data.decimal say what stands between and in numbers"


@dataclass(frozen=True, kw_only=True)
class TextSettings:
    """Format of a text file as stated by the user: separator, decimal mark and header, each None
    where it is detected. Settings that are None are detected from the file.

    `separator` is a mark or its name (tabs, semicolons, commas, bars, spaces); `decimal` is "." or
    ","; `header` is whether the first row of cells holds names.
    """

    separator: str | None = None
    decimal: str | None = None
    header: bool | None = None

    def __post_init__(self) -> None:
        if self.separator is not None:
            is_known = self.separator in SEPARATORS or self.separator in BY_WORD
            names = ", ".join(BY_WORD)
            problem = "unknown"
            remedy = f"use one of {names}"
            require(is_known, "data.separator", self.separator, problem, remedy)
        if self.decimal is not None:
            require_one_of((".", ","), "data.decimal", self.decimal)

    @property
    def separator_character(self) -> str | None:
        """Separator of the cells in a text file, as a single character."""
        return BY_WORD.get(self.separator or "", self.separator)


@dataclass(frozen=True, kw_only=True)
class TextLayout:
    """Detected format of a text file: encoding, separator, decimal mark, column names and units,
    with the rows as text.

    `names` are the header's cells, None where the file has none; `units` those of a row of units.
    """

    separator: str
    decimal: str
    encoding: str
    names: list[str] | None
    units: list[str]
    rows: list[str]
    line_numbers: list[int]
    columns: int
    remarks: list[str] = field(default_factory=list)

    def describe(self) -> str:
        """Describe the detected format of a text file in one line."""
        decimal = ", decimal comma" if self.decimal == "," else ""
        encoding = "" if self.encoding.startswith("utf-8") else f", encoding {self.encoding}"
        header = "no names" if self.names is None else "a line of names"
        marks = "one column" if self.columns == 1 else f"separated by {WORDS[self.separator]}"
        parts = [f"{marks}{decimal}{encoding}", header, *self.remarks]
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class SampledCells:
    """Cells of the first lines of a text file, and of further lines sampled from the whole file.

    `columns` is the usual number of cells of a line; `numeric` says which of them hold values.
    """

    first: list[list[str]]
    spread: list[list[str]]
    decimal: str
    columns: int
    numeric: list[bool]

    @classmethod
    def from_lines(cls, lines: list[str], separator: str, decimal: str) -> "SampledCells":
        """Split sampled lines of a text file into cells, and find which columns contain values."""
        first = [split_cells(line, separator) for line in lines[:SAMPLED_ROWS]]
        spread = [split_cells(line, separator) for line in sample_lines(lines)]
        lengths = Counter(map(len, spread))
        columns = lengths.most_common(1)[0][0]
        numeric = numeric_column_mask(spread, columns, decimal)
        return cls(first=first, spread=spread, decimal=decimal, columns=columns, numeric=numeric)

    def header_line_count(self) -> int | None:
        """Number of lines above the first row of numbers in a text file; None if there is no such
        row."""
        first = first_value_row(self.first, self.columns, self.numeric, self.decimal)
        if first is None or not any(self.numeric):
            return None
        # A row of numbers with a cell that is none is refused where it is read.
        above = self.first[first - 1] if first > 1 else []
        has_number = any(is_number(cell, self.decimal) for cell in above)
        return first - 1 if has_number else first


@dataclass(frozen=True, kw_only=True)
class Header:
    """Header of a text file: names and units of the columns, and the number of lines above the
    numbers."""

    names: list[str] | None
    units: list[str]
    lines: int
    remarks: list[str]


def detect_layout(path: Path, content: bytes, settings: TextSettings) -> TextLayout:
    """Detect the format of a text file: encoding, separator, decimal mark, column names and units.

    Raises `BadRequest` where no row of numbers is found.
    """
    text, encoding = decode_text(path, content)
    body, comments = separate_comments(text)
    problem = "has no header and no rows"
    require(body, "data.path", path, problem, EXPORT)
    separator, decimal = find_separators([line for _, line in body], settings)
    body, repeats = remove_repeated_header_lines(body)
    cells = SampledCells.from_lines([line for _, line in body], separator, decimal)
    length = cells.header_line_count()
    if length is None:
        raise no_numbers_error(path, body)
    header = read_header(path, cells, length, settings.header)
    if header.names is None and comments and length == 0:
        names = parse_names_in_comment(comments, separator, cells.columns, decimal)
        header = replace(header, names=names)
    header = numbered_header(header, cells, settings.header)
    remarks = [count_phrase(len(comments), "comment line")] if comments else []
    if repeats:
        remarks.append(f"the line of names {count_phrase(repeats, 'time')} more")
    rows, prose = remove_prose_below_table(body[header.lines :], separator, decimal, cells.columns)
    below = [f"{count_phrase(prose, 'line')} of prose below"] if prose else []
    return TextLayout(
        separator=separator,
        decimal=decimal,
        encoding=encoding,
        names=header.names,
        units=header.units,
        rows=[line for _, line in rows],
        line_numbers=[number for number, _ in rows],
        columns=cells.columns,
        remarks=remarks + header.remarks + below,
    )


def no_numbers_error(path: Path, body: list[NumberedLine]) -> BadRequest:
    """Error for a text file without a table of numbers; the message names the row where the decimal
    mark changes, if one does."""
    mixed = describe_mixed_decimals(body)
    if mixed:
        problem = f"numbers are written in two ways: {mixed}"
        remedy = "write all of them alike, with a point or with a comma"
        return BadRequest("data.path", path, problem, remedy)
    remedy = f"{EXPORT}; {SETTINGS_HELP}"
    return BadRequest("data.path", path, "has no rows of numbers", remedy)


def separate_comments(text: str) -> tuple[list[NumberedLine], list[str]]:
    """Separate the comment lines of a text file from all other lines, which keep their line
    numbers."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    body = []
    comments = []
    for number, line in enumerate(lines, start=1):
        bare = line.strip()
        if bare.startswith(COMMENTS):
            comments.append(line)
        elif bare:
            body.append((number, line))
    return body, comments


def read_header(path: Path, cells: SampledCells, length: int, has_header: bool | None) -> Header:
    """Read column names and units from the lines above the numbers of a text file. Raises
    `BadRequest` for names where none are stated."""
    above = cells.first[:length]
    titles = [row for row in above if can_be_header(row, cells.columns, cells.spread)]
    refuse_shifted_names(path, above, titles, cells.columns)
    names, units = split_names_and_units(titles)
    if names is not None and has_header is False:
        problem = "the first line does not hold numbers"
        remedy = "leave data.header out"
        raise BadRequest("data.header", False, problem, remedy)
    prose = length - len(titles)
    remarks = [f"{count_phrase(prose, 'line')} of prose above"] if prose else []
    if units:
        remarks.append("a row of units")
    return Header(names=names, units=units, lines=length, remarks=remarks)


def numbered_header(header: Header, cells: SampledCells, has_header: bool | None) -> Header:
    """Header with column numbers as names, for a text file whose first row numbers the columns."""
    if header.names is not None:
        return header
    names, skipped = numbered_column_names(cells.first, cells.columns, has_header)
    remarks = [*header.remarks, "names that count"] if skipped else header.remarks
    return replace(header, names=names, lines=header.lines + skipped, remarks=remarks)


def sample_lines(lines: list[str]) -> list[str]:
    """Evenly spaced lines of a text file, without those at its beginning."""
    later = lines[min(len(lines) // 2, 20) :]
    stride = max(len(later) // SAMPLED_ROWS, 1)
    return later[::stride][:SAMPLED_ROWS]


def find_separators(lines: list[str], settings: TextSettings) -> tuple[str, str]:
    """Find the separator and the decimal mark with which the lines of a text file form the best
    table of numbers."""
    separators = (
        SEPARATORS if settings.separator_character is None else (settings.separator_character,)
    )
    decimals = (".", ",") if settings.decimal is None else (settings.decimal,)
    rows = sample_lines(lines)
    is_quoted = any('"' in row for row in rows)  # then a comma may stand in and between numbers
    best = (",", ".")
    best_score = -1.0
    for separator in separators:
        for decimal in decimals:
            if separator == decimal and not is_quoted:
                continue
            score = table_score([split_cells(row, separator) for row in rows], decimal)
            # A space between date and time is no separator where another mark divides as well.
            needed = SPACES_GAIN if separator == " " else 1e-9
            if score > best_score + needed:
                best = (separator, decimal)
                best_score = score
    return best


def table_score(rows: list[list[str]], decimal: str) -> float:
    """Score between 0 and 1 of how well lines that were split into cells form a table of numbers.
    It is the share of rows with the usual length, times the share of values.

    Of two readings that are both perfect, the one with more columns scores more. Cells as `05`
    are the digits behind a decimal comma, not whole numbers.
    """
    length, count = Counter(map(len, rows)).most_common(1)[0]
    regular = [row for row in rows if len(row) == length]
    cells = [cell for row in regular for cell in row]
    filled = [cell for cell in cells if cell.lower() not in MISSING]
    values = sum(is_value(cell, decimal) for cell in filled)
    padded = sum(bool(re.fullmatch(r"0\d+", cell)) for cell in filled)
    share = (values - padded) / max(len(filled), 1)
    return count / len(rows) * share + 1e-3 * min(length, 20) * (share > 0.99)


def numeric_column_mask(rows: list[list[str]], columns: int, decimal: str) -> list[bool]:
    """For each column of a text file, whether at least nine in ten sampled cells contain a value. A
    column of missing values does not count."""
    regular = [row for row in rows if len(row) == columns]
    numeric = []
    for j in range(columns):
        filled = [row[j] for row in regular if row[j].lower() not in MISSING]
        values = sum(is_value(cell, decimal) for cell in filled)
        numeric.append(bool(filled) and values >= 0.9 * len(filled))
    return numeric


def first_value_row(
    cells: list[list[str]], columns: int, numeric: list[bool], decimal: str
) -> int | None:
    """Index of the first row with a value in every numeric column; None if there is no such row."""
    for k, row in enumerate(cells):
        if len(row) != columns:
            continue
        pairs = zip(row, numeric, strict=True)
        values = [cell for cell, is_numeric in pairs if is_numeric]
        filled = [cell for cell in values if cell.lower() not in MISSING]
        if filled and all(is_value(cell, decimal) for cell in values):
            return k
    return None
