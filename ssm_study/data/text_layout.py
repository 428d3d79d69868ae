"""Detection of a text file's layout: encoding, separator, decimal mark, comments, column names,
units.

All of it is found in the text itself, and any of it may be stated instead (`TextSettings`). The
rows of numbers decide: a separator and a decimal mark fit if they cut the rows into equally many
cells that are numbers, dates or missing. What stands above the first such row is names, units or
prose.
"""

import codecs
import csv
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from ssm_study.refusal import BadRequest, require, require_one_of

SAMPLED_ROWS = 120
SEPARATORS = ("\t", ";", "|", ",", " ")  # tried in this order: the first of equals is taken
SPACES_GAIN = 0.05  # of the score, more than the bonus for columns, by which spaces must be better
WORDS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "spaces"}
BY_WORD = {word: mark for mark, word in WORDS.items()} | {r"\t": "\t"}
COMMENTS = ("#", "%", "//", '"#')
MISSING_WORDS = "nan na n/a #n/a n.a. #nv null none - -- --- ---- ? nat -nan 1.#qnan missing"
MISSING = frozenset(["", *MISSING_WORDS.split()])
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?|[-+]?inf(inity)?", re.IGNORECASE)
COMMA_NUMBER = re.compile(
    r"[-+]?(\d+(,\d+)?|,\d+)([eEdD][-+]?\d+)?|[-+]?inf(inity)?", re.IGNORECASE
)
DATE = re.compile(
    r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}([T ]+\d{1,2}:\d\d(:\d\d([.,]\d+)?)?\s*([AaPp][Mm])?\s*"
    r"(Z|UTC|[-+]\d\d:?\d\d)?)?|\d{1,2}:\d\d:\d\d([.,]\d+)?"
)
UNIT = re.compile(r"[A-Za-zµμ°%Ωω·*/^²³\-\d. ]{1,12}|\([^()]{1,12}\)|\[[^\[\]]{1,12}\]")
BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
FIRST_LINES = 5  # lines among which the names of the columns are looked for again further down
# Titles of clocks that are no units: of two rows of words, that with such a title holds names.
CLOCK_WORDS = ("time", "timestamp", "date", "datetime", "zeit", "datum", "temps", "times",
               "zeitstempel", "tiempo", "clock", "elapsed", "timems")  # fmt: skip
PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"BZh": "bzip2", b"\xfd7zXZ": "xz",
          b"7z\xbc\xaf": "7z", b"Rar!": "rar", b"(\xb5/\xfd": "zstd"}  # fmt: skip
MOSTLY_ZERO = 0.4  # share of every second byte, from which on a text is one of two bytes a letter


@dataclass(frozen=True, kw_only=True)
class TextSettings:
    """Layout of a text file as the user states it. Settings that are None are detected from the
    file.

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
            require(is_known, "data.separator", self.separator, "unknown", f"use one of {names}")
        if self.decimal is not None:
            require_one_of((".", ","), "data.decimal", self.decimal)

    @property
    def separator_mark(self) -> str | None:
        """Separator of the cells as a character."""
        return BY_WORD.get(self.separator or "", self.separator)


@dataclass(frozen=True, kw_only=True)
class TextLayout:
    """Detected layout of a text file, with its rows as text and their `line_numbers`.

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
        """Describe the detected layout of a text file in one line."""
        decimal = ", decimal comma" if self.decimal == "," else ""
        encoding = "" if self.encoding.startswith("utf-8") else f", encoding {self.encoding}"
        header = "no names" if self.names is None else "a line of names"
        marks = "one column" if self.columns == 1 else f"separated by {WORDS[self.separator]}"
        parts = [f"{marks}{decimal}{encoding}", header, *self.remarks]
        return ", ".join(parts)


def decode_text(path: Path, content: bytes) -> tuple[str, str]:
    """Decode the bytes of a text file, and name the encoding. Raises `BadRequest` for bytes that
    are no text."""
    for mark, encoding in BYTE_ORDER_MARKS:
        if content.startswith(mark):
            try:
                return content.decode(encoding), encoding
            except UnicodeDecodeError as error:
                problem = "has no readable text"
                remedy = "export it as UTF-8 CSV"
                raise BadRequest("data.path", path, problem, remedy) from error
    packed = next((word for mark, word in PACKED.items() if content.startswith(mark)), "")
    require(not packed, "data.path", path, f"is packed ({packed})", "unpack it first")
    content = content.rstrip(b"\0\x1a")  # a logger's unwritten end, and that of old DOS
    encoding = detect_wide_encoding(content)
    if encoding:
        whole = content + b"\0" * (len(content) % 2)
        return whole.decode(encoding, errors="replace"), encoding
    is_text = b"\0" not in content
    problem = "contains NUL bytes, so it is no text"
    require(is_text, "data.path", path, problem, "export it as CSV")
    try:
        return content.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        # Numbers are ASCII; the code page only spells the names.
        return content.decode("cp1252", errors="replace"), "cp1252"


def detect_wide_encoding(content: bytes) -> str:
    """Encoding of a text that has two bytes for each letter and no byte order mark; empty for any
    other text."""
    halves = {"utf-16-le": content[1::2], "utf-16-be": content[::2]}
    zeros = {name: half.count(0) / max(len(half), 1) for name, half in halves.items()}
    wide = [name for name, share in zeros.items() if share > MOSTLY_ZERO]
    has_rows = content.count(b"\n") > 1
    return wide[0] if len(wide) == 1 and min(zeros.values()) == 0 and has_rows else ""


def detect_layout(path: Path, content: bytes, settings: TextSettings) -> TextLayout:
    """Detect the layout of a text file: encoding, separator, decimal mark, header and units. Raises
    `BadRequest` if no row of numbers is found."""
    text, encoding = decode_text(path, content)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    numbered = [(k, line) for k, line in enumerate(lines, start=1) if line.strip()]
    is_comment = [line.lstrip().startswith(COMMENTS) for _, line in numbered]
    body = [pair for pair, comment in zip(numbered, is_comment, strict=True) if not comment]
    comments = [line for (_, line), comment in zip(numbered, is_comment, strict=True) if comment]
    remedy = "export it as CSV with a line of names and rows of numbers"
    require(body, "data.path", path, "has no header and no rows", remedy)
    separator, decimal = find_separators([line for _, line in body], settings)
    body, repeats = remove_repeated_header_lines(body)
    cells = [split_cells(line, separator) for _, line in body[:SAMPLED_ROWS]]
    sample = [split_cells(line, separator) for line in sample_lines([line for _, line in body])]
    columns = Counter(map(len, sample)).most_common(1)[0][0]
    numeric = find_numeric_columns(sample, columns, decimal)
    first = first_value_row(cells, columns, numeric, decimal)
    remedy = f"{remedy}; data.separator and data.decimal say what stands between and in numbers"
    if not any(numeric) or first is None:
        raise BadRequest("data.path", path, "has no rows of numbers", remedy)
    if first > 1 and any(is_number(cell, decimal) for cell in cells[first - 1]):
        first -= 1  # a row of numbers with a cell that is none: it is refused where it is read
    above = [row for row in cells[:first] if fits_header(row, columns, sample)]
    refuse_shifted_names(path, cells[:first], above, columns)
    remarks = [number_with_noun(len(comments), "comment line")] if comments else []
    names, units = split_names_and_units(above)
    if repeats:
        remarks.append(f"the line of names {number_with_noun(repeats, 'time')} more")
    if len(above) < first and first:
        remarks.append(f"{number_with_noun(first - len(above), 'line')} of prose above")
    if names is None and comments and first == 0:
        names = parse_names_in_comment(comments, separator, columns, decimal)
    if units:
        remarks.append("a row of units")
    if names is None:
        names, skip = numbered_column_names(cells, columns, settings.header)
        first += skip
        if skip:
            remarks.append("names that count")
    elif settings.header is False:
        problem = "the first line is no numbers"
        raise BadRequest("data.header", False, problem, "leave data.header out")
    return TextLayout(
        separator=separator,
        decimal=decimal,
        encoding=encoding,
        names=names,
        units=units,
        rows=[line for _, line in body[first:]],
        line_numbers=[number for number, _ in body[first:]],
        columns=columns,
        remarks=remarks,
    )


def sample_lines(lines: list[str]) -> list[str]:
    """Sample lines from the whole of a text file except its beginning."""
    later = lines[min(len(lines) // 2, 20) :]
    stride = max(len(later) // SAMPLED_ROWS, 1)
    return later[::stride][:SAMPLED_ROWS]


def split_cells(line: str, separator: str) -> list[str]:
    """Split one line of a text file into cells, without the spaces around them."""
    if separator == " ":
        return [cell.strip('"') for cell in line.split()]
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        cells = next(csv.reader([line], delimiter=separator))
    except (csv.Error, StopIteration):
        return [line]
    return [cell.strip() for cell in cells]


def is_value(cell: str, decimal: str) -> bool:
    """Whether a cell is a number, a date or a missing value."""
    number = COMMA_NUMBER if decimal == "," else NUMBER
    return cell.lower() in MISSING or bool(number.fullmatch(cell) or DATE.fullmatch(cell))


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell is a number."""
    return bool((COMMA_NUMBER if decimal == "," else NUMBER).fullmatch(cell))


def find_separators(lines: list[str], settings: TextSettings) -> tuple[str, str]:
    """Find the separator and the decimal mark with which the lines form the best table of
    values."""
    separators = SEPARATORS if settings.separator_mark is None else (settings.separator_mark,)
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
    """Score of how well lines that were split into cells form a table of values. It is the share of
    rows with the usual length, times the share of values.

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


def find_numeric_columns(rows: list[list[str]], columns: int, decimal: str) -> list[bool]:
    """For each column, whether at least nine in ten sampled cells hold a value. A column of missing
    values does not count."""
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
    """Index of the first row that has values in all numeric columns; None if there is none."""
    for k, row in enumerate(cells):
        if len(row) != columns:
            continue
        pairs = zip(row, numeric, strict=True)
        values = [cell for cell, is_numeric in pairs if is_numeric]
        filled = [cell for cell in values if cell.lower() not in MISSING]
        if filled and all(is_value(cell, decimal) for cell in values):
            return k
    return None


def number_with_noun(number: int, noun: str) -> str:
    """Write a number with its noun in singular or plural, such as `1 line` and `2 lines`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def fits_header(row: list[str], columns: int, sample: list[list[str]]) -> bool:
    """Whether a row above the numbers has one cell for each column, so that its cells can be the
    columns' names."""
    if len(row) == columns + 1:
        return row[-1] == ""
    if len(row) == columns - 1:
        regular = [cells for cells in sample if len(cells) == columns]
        return columns > 1 and not any(cells[-1] for cells in regular)
    return len(row) == columns


def refuse_shifted_names(
    path: Path, cells: list[list[str]], above: list[list[str]], columns: int
) -> None:
    """Raise `BadRequest` for a header line with one name too many or too few. A trace whose
    variables are listed one below another is refused, too."""
    stacked = bool(above or cells) and (above + cells)[0][0].strip().lower() == "[key]"
    remedy = "export a table with one column a variable"
    problem = "is a trace of keys and values, its variables one below the other"
    require(not stacked, "data.path", path, problem, remedy)
    if cells and not above and columns > 2 and abs(len(cells[-1]) - columns) == 1:
        names = f"{len(cells[-1])} names"
        problem = f"the rows have {columns} cells"
        raise BadRequest(path.name, names, problem, "correct the line of names")


def remove_repeated_header_lines(body: list[tuple[int, str]]) -> tuple[list[tuple[int, str]], int]:
    """Remove lines that repeat the header in the body of a text file, and count them.

    A logger that is switched on again writes its line of names again.
    """
    first = {line.strip() for _, line in body[:FIRST_LINES] if not re.search(r"\d", line)}
    lines = body[:1]
    for number, line in body[1:]:
        if line.strip() not in first or number <= body[0][0] + FIRST_LINES:
            lines.append((number, line))
    return lines, len(body) - len(lines)


def split_names_and_units(above: list[list[str]]) -> tuple[list[str] | None, list[str]]:
    """Separate the header lines of a text file into column names and units."""
    if not above:
        return None, []
    for k in reversed(range(len(above))):
        if any(fold_header_cell(cell) in CLOCK_WORDS for cell in above[k]):
            below = above[k + 1 : k + 2]
            units = below[0] if below and are_possible_units(below[0], len(above[k])) else []
            return above[k], [cell.strip("()[] ") for cell in units]
    *before, last = above
    if before and are_possible_units(last, len(before[-1])):
        return before[-1], [cell.strip("()[] ") for cell in last]
    return last, []


def are_possible_units(cells: list[str], columns: int) -> bool:
    """Whether the cells of a row below the column names could all be units."""
    filled = [cell for cell in cells if cell]
    return len(cells) == columns and all(map(UNIT.fullmatch, filled))


def fold_header_cell(cell: str) -> str:
    """Title of a column in lower case, without its unit in brackets."""
    return re.sub(r"[\W_]+", "", re.sub(r"[\[(].*", "", cell)).lower()


def parse_names_in_comment(
    comments: list[str], separator: str, columns: int, decimal: str
) -> list[str] | None:
    """Parse the column names in the last comment line, where NumPy writes them; None if there are
    none."""
    bare = comments[-1].strip().lstrip('#%/" ')
    for mark in (separator, ",", ";", "\t", " "):
        cells = split_cells(bare, mark)
        if len(cells) == columns and not any(is_value(cell, decimal) for cell in cells):
            return cells
    return None


def numbered_column_names(
    cells: list[list[str]], columns: int, header: bool | None
) -> tuple[list[str] | None, int]:
    """Column names `0,1,2` or `1,2,3` in the first row of a table, and the number of rows that hold
    names.

    Counting from 0 they are names if the numbers below are unlike whole numbers, as pandas writes
    an array; counting from 1, always (a reader that is asked for a number refuses to guess).
    """
    first = cells[0]
    if header is not None:
        return (first, 1) if header else (None, 0)
    if first == [str(j + 1) for j in range(columns)] and columns > 1:
        return first, 1
    below = [cell for row in cells[1:12] for cell in row]
    unlike = all(not cell.lstrip("+-").isdigit() for cell in below if cell)
    if first == [str(j) for j in range(columns)] and below and unlike:
        return first, 1
    return None, 0
