"""Conversion of numbers in text files to one form: digit groups, percent signs, words for on and
off, and the like.

A point or comma between groups of three digits is read where the column shows that it groups them
(`1,234.5`, `1.234.567`). A column of `20,007` alone could be thousands or decimals, and is refused.
"""

import pyarrow as pa
import pyarrow.compute as pc

BARE_GROUPS = " '’\u00a0\u2009\u202f"  # marks between groups of digits that mean nothing else
WORDS = {"true": "1", "false": "0", "on": "1", "off": "0", "yes": "1", "no": "0",
         "wahr": "1", "falsch": "0", "ein": "1", "aus": "0"}  # fmt: skip
AMBIGUOUS = "its mark may stand between thousands, or before decimals"
FORTRAN = r"^([-+]?[\d.]+)[dD]([-+]?\d+)$"


def normalise_numbers(
    cells: pa.ChunkedArray, missing: pa.ChunkedArray, decimal: str
) -> tuple[pa.ChunkedArray, str]:
    """Rewrite numbers in text cells with a decimal point and without thousands separators, and
    describe ambiguous numbers."""
    cells = pc.replace_substring(cells, "\u2212", "-")
    cells = _remove_spaces_between_digits(cells)
    filled = pc.filter(cells, pc.invert(missing))
    if not len(filled):
        return cells, ""
    group = "," if decimal == "." else "."
    if pc.any(pc.match_substring(filled, group)).as_py():
        cells, problem = _remove_group_separators(cells, filled, group, decimal)
        if problem:
            return cells, problem
    if decimal == ",":
        cells = pc.replace_substring(cells, ",", ".")
    cells = pc.replace_substring_regex(cells, FORTRAN, r"\1e\2")
    if pc.all(pc.ends_with(filled, "%")).as_py():
        cells = pc.utf8_rtrim(cells, "% ")
    return _replace_switch_words(cells, filled), ""


def _remove_spaces_between_digits(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Remove apostrophes and spaces that separate groups of three digits in text cells."""
    pattern = rf"^[-+]?\d{{1,3}}([{BARE_GROUPS}]\d{{3}})+([.,]\d+)?$"
    is_grouped = pc.match_substring_regex(cells, pattern)
    bare = pc.replace_substring_regex(cells, f"[{BARE_GROUPS}]", "")
    return pc.if_else(is_grouped, bare, cells)


def _remove_group_separators(
    cells: pa.ChunkedArray, filled: pa.ChunkedArray, group: str, decimal: str
) -> tuple[pa.ChunkedArray, str]:
    """Remove commas or points between groups of three digits, if a column's numbers show that these
    are no decimal marks."""
    mark = "," if group == "," else r"\."
    point = r"\." if decimal == "." else ","
    grouped = rf"^[-+]?[1-9]\d{{0,2}}({mark}\d{{3}})+({point}\d+)?$"
    clear = rf"^[-+]?[1-9]\d{{0,2}}(({mark}\d{{3}})+{point}\d+|({mark}\d{{3}}){{2,}})$"
    marked = pc.filter(filled, pc.match_substring(filled, group))
    if not pc.all(pc.match_substring_regex(marked, grouped)).as_py():
        return cells, ""
    if not pc.any(pc.match_substring_regex(marked, clear)).as_py():
        return cells, AMBIGUOUS
    is_grouped = pc.match_substring_regex(cells, grouped)
    return pc.if_else(is_grouped, pc.replace_substring(cells, group, ""), cells), ""


def _replace_switch_words(cells: pa.ChunkedArray, filled: pa.ChunkedArray) -> pa.ChunkedArray:
    """Replace words for the state of a switch, such as on and off, by 1 and 0 in text cells."""
    words = pa.array(list(WORDS))
    is_switch = pc.is_in(pc.utf8_lower(filled), value_set=words)
    if not pc.all(is_switch).as_py():
        return cells
    lower = pc.utf8_lower(cells)
    for word, digit in WORDS.items():
        lower = pc.if_else(pc.equal(lower, word), digit, lower)
    return lower
