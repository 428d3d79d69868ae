"""Header of a text file: names of its columns, units and prose above the numbers."""

import re
from pathlib import Path

from ssm_study.data.text_cells import is_value, split_cells
from ssm_study.refusal import BadRequest, require

UNIT = re.compile(r"[A-Za-zµμ°%Ωω·*/^²³\-\d. ]{1,12}|\([^()]{1,12}\)|\[[^\[\]]{1,12}\]")
RULES = "-=*_#> "  # marks that draw a line above or below prose
FIRST_LINES = 5  # lines among which the names of the columns are looked for again further down
# Titles of clocks that are no units: of two rows of words, that with such a title holds names.
CLOCK_WORDS_TEXT = """
    time timestamp date datetime zeit datum temps times zeitstempel tiempo clock elapsed
    timems
"""
CLOCK_WORDS = tuple(CLOCK_WORDS_TEXT.split())
NumberedLine = tuple[int, str]


def count_phrase(number: int, noun: str) -> str:
    """Phrase of a number and a noun in singular or plural, such as `1 line` and `2 lines`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def can_be_header(row: list[str], columns: int, sample_rows: list[list[str]]) -> bool:
    """Whether a row above the numbers of a text file can be the header, with one name for each
    column."""
    if len(row) == columns + 1:
        return row[-1].lower() in ("", "comment")  # LabVIEW names a column of remarks
    if len(row) == columns - 1:
        regular = [cells for cells in sample_rows if len(cells) == columns]
        return columns > 1 and not any(cells[-1] for cells in regular)
    return len(row) == columns


def refuse_shifted_names(
    path: Path, cells: list[list[str]], header_rows: list[list[str]], columns: int
) -> None:
    """Raise `BadRequest` for a header with one name more or fewer than the table has columns. A
    trace whose variables are listed one below another is refused, too."""
    rows = header_rows + cells
    first_cell = rows[0][0] if rows else ""
    stacked = first_cell.strip().lower() == "[key]"
    remedy = "export a table with one column a variable"
    problem = "is a trace of keys and values, its variables one below the other"
    require(not stacked, "data.path", path, problem, remedy)
    if not cells or header_rows or columns <= 2:
        return
    count = len(cells[-1])
    if abs(count - columns) == 1:
        names = f"{count} names"
        problem = f"the rows have {columns} cells"
        raise BadRequest(path.name, names, problem, "correct the line of names")


def remove_repeated_header_lines(body: list[NumberedLine]) -> tuple[list[NumberedLine], int]:
    """Remove repetitions of the header between the rows of a text file, and count them.

    A logger that is switched on again writes its line of names again.
    """
    without_digits = [line for _, line in body[:FIRST_LINES] if not re.search(r"\d", line)]
    header = {line.strip() for line in without_digits}
    last_of_header = body[0][0] + FIRST_LINES
    lines = body[:1]
    for number, line in body[1:]:
        is_repeated = line.strip() in header and number > last_of_header
        if not is_repeated:
            lines.append((number, line))
    return lines, len(body) - len(lines)


def remove_prose_below_table(
    body: list[NumberedLine], separator: str, decimal: str, columns: int
) -> tuple[list[NumberedLine], int]:
    """Remove lines of prose below the last row of numbers of a text file, and count them.

    Prose begins with a word, or draws a line, and is no row of the table: it has another number of
    cells, or no value in any.
    """
    length = len(body)
    while length > 1:
        cells = split_cells(body[length - 1][1], separator)
        values = [is_value(cell, decimal) for cell in cells if cell]
        bare = cells[0].lstrip(RULES)
        draws_line = bool(cells[0]) and not bare
        begins_with_word = bare[:1].isalpha() and not values[0]
        if not (draws_line or begins_with_word) or (any(values) and len(cells) == columns):
            break
        length -= 1
    return body[:length], len(body) - length


def split_names_and_units(header_rows: list[list[str]]) -> tuple[list[str] | None, list[str]]:
    """Separate the header lines of a text file into column names and units."""
    if not header_rows:
        return None, []
    for k in reversed(range(len(header_rows))):
        names = header_rows[k]
        folded = map(normalise_header_cell, names)
        if any(cell in CLOCK_WORDS for cell in folded):
            below = header_rows[k + 1 : k + 2]
            return names, parse_unit_row(below, len(names))
    *before, last = header_rows
    units = parse_unit_row([last], len(before[-1])) if before else []
    if before and are_possible_units(last, len(before[-1])):
        return before[-1], units
    return last, []


def parse_unit_row(rows: list[list[str]], columns: int) -> list[str]:
    """Parse the row of units below the column names of a text file, if there is such a row."""
    if not rows or not are_possible_units(rows[0], columns):
        return []
    return [cell.strip("()[] ") for cell in rows[0]]


def are_possible_units(cells: list[str], columns: int) -> bool:
    """Whether the cells in a row below the column names could all be units."""
    filled = [cell for cell in cells if cell]
    return len(cells) == columns and all(map(UNIT.fullmatch, filled))


def normalise_header_cell(cell: str) -> str:
    """Column title in lower case, without the unit in brackets."""
    without_unit = re.sub(r"[\[(].*", "", cell)
    return re.sub(r"[\W_]+", "", without_unit).lower()


def parse_names_in_comment(
    comments: list[str], separator: str, columns: int, decimal: str
) -> list[str] | None:
    """Parse column names from the last comment line of a text file, where NumPy writes them; None
    if there are none."""
    bare = comments[-1].strip().lstrip('#%/" ')
    for mark in (separator, ",", ";", "\t", " "):
        cells = split_cells(bare, mark)
        has_value = any(is_value(cell, decimal) for cell in cells)
        if len(cells) == columns and not has_value:
            return cells
    return None


def numbered_column_names(
    cells: list[list[str]], columns: int, header: bool | None
) -> tuple[list[str] | None, int]:
    """Column names of a table whose first row numbers the columns, and the count of rows that they
    occupy.

    Counting from 0 they are names if the numbers below are unlike whole numbers, as pandas writes
    an array; counting from 1, always (a reader that is asked for a number refuses to guess).
    """
    first = cells[0]
    if header is not None:
        return (first, 1) if header else (None, 0)
    from_zero = [str(j) for j in range(columns)]
    from_one = [str(j + 1) for j in range(columns)]
    if first == from_one and columns > 1:
        return first, 1
    below = [cell for row in cells[1:12] for cell in row]
    digits = [cell.lstrip("+-").isdigit() for cell in below if cell]
    if first == from_zero and below and not any(digits):
        return first, 1
    return None, 0
