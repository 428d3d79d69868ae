"""Detection of text files in which some lines have decimal commas and others decimal points."""

import re
from collections.abc import Sequence

from ssm_study.data.text_cells import split_cells

# A comma, too, divides cells in many files: where it does, it says nothing about decimals.
SEPARATORS = (";", "\t", "|", " ")
WITH_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
WITH_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")


def describe_mixed_decimals(lines: Sequence[tuple[int, str]]) -> str:
    """Text that quotes the first line with a decimal comma and the first with a decimal point, in a
    file that mixes both."""
    for separator in SEPARATORS:
        comma = find_first_cell(WITH_COMMA, lines, separator)
        point = find_first_cell(WITH_POINT, lines, separator)
        if comma is not None and point is not None:
            first, later = sorted([(*comma, "comma"), (*point, "point")])
            return (
                f"line {first[0]} has a decimal {first[2]} ({first[1]}) and line {later[0]} a "
                f"decimal {later[2]} ({later[1]})"
            )
    return ""


def find_first_cell(
    pattern: re.Pattern[str], lines: Sequence[tuple[int, str]], separator: str
) -> tuple[int, str] | None:
    """Find the first cell that matches a pattern among lines of text, and return its line number
    and content; None if no cell matches."""
    for number, line in lines:
        cells = split_cells(line, separator)
        cell = next((cell for cell in cells if pattern.fullmatch(cell)), None)
        if len(cells) > 1 and cell is not None:
            return number, cell
    return None
