"""Cells of a text file: splitting of lines, and which cells are numbers, dates or missing."""

import csv
import re

MISSING_WORDS = "nan na n/a #n/a n.a. #nv null none - -- --- ---- ? nat -nan 1.#qnan missing"
MISSING = frozenset(["", *MISSING_WORDS.split()])
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?|[-+]?inf(inity)?", re.IGNORECASE)
COMMA_NUMBER = re.compile(
    r"[-+]?(\d+(,\d+)?|,\d+)([eEdD][-+]?\d+)?|[-+]?inf(inity)?", re.IGNORECASE
)
TIME_AND_ZONE = r"([T ]+\d{1,2}:\d\d(:\d\d([.,]\d+)?)?\s*([AaPp][Mm])?\s*(Z|UTC|[-+]\d\d:?\d\d)?)?"
MONTH = r"(jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*"
DATE = re.compile(
    rf"\d{{1,4}}[-/.]\d{{1,2}}[-/.]\d{{1,4}}{TIME_AND_ZONE}"
    rf"|\d{{1,2}}[-/. ]{MONTH}[-/. ]\d{{4}}{TIME_AND_ZONE}"
    rf"|{MONTH} \d{{1,2}},? \d{{4}}{TIME_AND_ZONE}"
    r"|\d{1,2}:\d\d:\d\d([.,]\d+|:\d{3})?",
    re.IGNORECASE,
)


def split_cells(line: str, separator: str) -> list[str]:
    """Split a line of a text file at the separator into cells, without surrounding spaces."""
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
    """Whether a cell of a text file contains a number, a date or a mark for a missing value."""
    number = COMMA_NUMBER if decimal == "," else NUMBER
    return cell.lower() in MISSING or bool(number.fullmatch(cell) or DATE.fullmatch(cell))


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell of a text file contains a number, with a given decimal mark."""
    return bool((COMMA_NUMBER if decimal == "," else NUMBER).fullmatch(cell))
