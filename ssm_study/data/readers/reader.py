"""Interface of the file readers. Each returns columns of numbers, and can name one of its rows."""

import re
import unicodedata
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data import readers
from ssm_study.data.text_layout import TextSettings
from ssm_study.family import Family
from ssm_study.refusal import BadRequest, require

# Limit of a recorded value, and the inverse of the least span: sums of squares stay finite.
LARGEST = 1e30
MOST_LISTED = 12  # titles in a refusal
INTERPOLATE = "interpolate it (a row taken out would shift the time of all that follow)"
FOREIGN = {
    ".bag": "export the topics as MCAP or CSV",
    ".db3": "convert it: ros2 bag convert, storage mcap; or export CSV",
    ".h5": "export the columns as Parquet or CSV",
    ".hdf5": "export the columns as Parquet or CSV",
    ".tdms": "export the channels as CSV",
    ".mf4": "export the channels as CSV",
}


@dataclass(frozen=True, kw_only=True)
class Table:
    """Columns of numbers read from a log file, with their units, titles and the times that the file
    states. All columns have one length; row k is `row_word` number `first_row + k`, or
    `row_numbers[k]`.

    `columns[name] (T,)`, NaN where a value is missing; `units[name]` where the file states one.
    `time_s` are the times the file itself gives its samples (MCAP), `step_s` the sampling time that
    it states (an `iddata` object). `remark` is how the file was read; `skipped` says why a column
    was not, `dated` holds dates and times, `nameless` means that columns go by their numbers.
    """

    columns: dict[str, Float[np.ndarray, "_"]]
    units: dict[str, str] = field(default_factory=dict)
    row_word: str = "sample"
    first_row: int = 0
    row_numbers: Sequence[int] | None = None
    time_s: Float[np.ndarray, "T"] | None = None
    step_s: float | None = None
    remark: str = ""
    skipped: dict[str, str] = field(default_factory=dict)
    dated: frozenset[str] = frozenset()
    nameless: bool = False

    def describe_row(self, row: int) -> str:
        """Description of a table row for error messages, numbered as in the log file."""
        number = row + self.first_row
        if self.row_numbers is not None:
            number = self.row_numbers[row]
        return f"{self.row_word} {number}"


class Reader(Family):
    """Base class of the readers of log files, one class for each file format. `names` are its
    suffixes."""

    settings: TextSettings = TextSettings()

    @abstractmethod
    def read_columns(self, path: Path, names: list[str]) -> Table:
        """Read the named columns of a log file to a table. Raises `BadRequest` for a file that is
        not whole, a missing or ambiguous column."""

    def read_all_columns(self, path: Path) -> Table:
        """Read all readable columns of a log file, in the order of the file. Refuses a file that is
        not whole."""
        problem = f"the reader of {path.suffix} files lists no columns"
        remedy = "name the columns"
        raise BadRequest("data.path", path, problem, remedy)


def choose_reader(path: Path, settings: TextSettings | None = None) -> Reader:
    """Choose the reader of a log file by the suffix of the file name. A file with an unknown suffix
    is read as text.

    Raises `BadRequest` for a missing file and for known formats without a reader.
    """
    remedy = "check the spelling"
    require(path.is_file(), "data.path", path, "no such file", remedy)
    formats = Reader.members(readers)
    suffix = path.suffix.lower()
    if suffix in FOREIGN:
        problem = f"files of the kind {suffix} are not read"
        raise BadRequest("data.path", path, problem, FOREIGN[suffix])
    reader: Reader = formats[suffix if suffix in formats else ""]()
    reader.settings = settings or TextSettings()
    return reader


def read_table(
    path: Path,
    requested: dict[str, str],
    settings: TextSettings | None = None,
    missing: bool = False,
    reader: "Reader | None" = None,
) -> Table:
    """Read the requested columns of a log file, and check their lengths, values and units. Each has
    the unit in which it is declared, or "".

    `missing` allows NaN, where the file has no value. Raises `BadRequest` for a missing or
    malformed file, a missing column, values that are no finite numbers, unequal lengths, or a unit
    that the file contradicts.
    """
    chosen = choose_reader(path, settings) if reader is None else reader
    table = chosen.read_columns(path, list(requested))
    lengths = {name: len(table.columns[name]) for name in requested}
    same = len(set(lengths.values())) <= 1
    remedy = "cut them to the same length"
    require(same, f"{path.name} (lengths)", lengths, "columns differ in length", remedy)
    for name, unit in requested.items():
        refuse_unusable_values(path, name, table, missing)
        stated = table.units.get(name, "")
        problem = f"{path.name} states {stated}"
        agrees = unit in ("", stated) or not stated
        remedy = "declare the unit the file is in"
        require(agrees, f"unit of {name}", unit, problem, remedy)
    return table


def refuse_unusable_values(path: Path, name: str, table: Table, missing: bool) -> None:
    """Raise `BadRequest` for a column with values that are not finite, too large, or too close
    together to compute their variance."""
    values = table.columns[name]
    is_bad = np.isinf(values) if missing else ~np.isfinite(values)
    bad = np.flatnonzero(is_bad)
    if len(bad):
        where = f"{path.name}, column {name}, {table.describe_row(int(bad[0]))}"
        raise BadRequest(where, values[bad[0]], "not a finite number", INTERPOLATE)
    finite = values[np.isfinite(values)]
    largest = float(np.abs(finite).max(initial=0.0))
    span = float(np.ptp(finite)) if len(finite) else 0.0
    fits = largest < LARGEST and (span == 0 or span > 1 / LARGEST)
    problem = "too large for floats, or its differences too small"
    where = f"{path.name}, column {name} (largest)"
    remedy = (
        f"convert it to a unit with values below {LARGEST:g}, differences above {1 / LARGEST:g}"
    )
    require(fits, where, largest, problem, remedy)


def refuse_equal_columns(table: Table, signals: list[str], file: Path) -> None:
    """Raise `BadRequest` for two signals that are the same column of a log file, or that have the
    same numbers."""
    for k, name in enumerate(signals):
        for other in signals[:k]:
            theirs = table.columns[other]
            equal = np.array_equal(table.columns[name], theirs, equal_nan=True)
            problem = f"holds the numbers of column {other}"
            remedy = "name another column for one of them"
            moves = float(np.nanstd(table.columns[name])) > 0
            require(not (equal and moves), f"{file.name}, column {name}", name, problem, remedy)


def has_columns(path: Path, names: Sequence[str], settings: TextSettings | None = None) -> bool:
    """Whether a log file can be read and has all the named columns."""
    try:
        return bool(read_table(path, dict.fromkeys(names, ""), settings, missing=True))
    except BadRequest:
        return False


def require_known_columns(
    field: str,
    names: list[str],
    titles: Sequence[str],
    container: str = "file",
    remedy: str = "name one of these",
) -> None:
    """Raise `BadRequest` for a requested column name that is unknown or ambiguous. `container` says
    what holds the known ones."""
    for name in names:
        count = list(titles).count(name)
        named = [title for title in titles if title]
        listing = ", ".join(named[:MOST_LISTED])
        if len(named) > MOST_LISTED:
            listing += " ..."
        problem = f"the {container} has {listing}"
        require(count > 0, field, name, problem, remedy)
        problem = f"the {container} has it {count} times"
        require(count == 1, field, name, problem, "rename the others")


def title_without_unit(title: str) -> str:
    """Column title without the unit in brackets at its end, such as `speed` for `speed [rad/s]`."""
    return re.sub(r"\s*(\[[^\]]*\]|\([^()]*\))\s*$", "", title).strip()


def normalise_title(title: str) -> str:
    """Reduce a column title to letters and digits in lower case, for comparison with other titles.
    The two micro signs count as the same letter."""
    normal = unicodedata.normalize("NFKC", title)
    return re.sub(r"[\W_]+", "", normal).lower()


def require_column_index(
    path: Path, name: str, titles: list[str], header: bool | None = None
) -> int:
    """Index of the column that a name or number stands for, among the titles of a log file; raises
    `BadRequest` if there is none. The name may be exact, without its unit, or agree in its letters
    alone.

    A number counts the columns from 0. Where it is a title too, and of another column, the request
    is refused with both readings; `header` true says that it is the title.
    """
    where = f"{path.name} (column)"
    plain = [title_without_unit(title) for title in titles]
    folded = [normalise_title(title) for title in titles]
    folded_plain = [normalise_title(title) for title in plain]
    ways = (list(titles), plain, folded, folded_plain)
    wanted_forms = (name, name, normalise_title(name), normalise_title(name))
    number = int(name) if name.isascii() and name.isdigit() else None
    numbered = number is not None and number < len(titles)
    for word, titles_in_form in zip(wanted_forms, ways, strict=True):
        if not word or word not in titles_in_form:
            continue
        require_known_columns(where, [word], titles_in_form, "header")
        place = titles_in_form.index(word)
        counted = numbered and place != number and header is None
        if counted:
            problem = (
                f"is both the name of column {place} (counted from 0) and the number of column "
                f"{titles[number or 0]!r}"
            )
            remedy = "say which: data.header=true reads names, data.header=false numbers from 0"
            raise BadRequest(where, name, problem, remedy)
        return place
    if numbered and number is not None:
        return number
    numbers = [str(j) for j in range(len(titles))]
    if list(titles) == numbers:
        remedy = "count the columns from 0, or write names into the first line"
        require_known_columns(where, [name], titles, "file without names", remedy)
    require_known_columns(where, [name], titles, "header")
    raise AssertionError  # refused by now


def arrow_columns_to_arrays(
    path: Path, table: Any, names: dict[str, str], row_word: str, first_row: int
) -> dict[str, Any]:
    """Convert the columns of an Arrow table to float64 arrays, keyed by name. `names` has the
    file's own name for each.

    Dates and times become seconds since the first; a missing value is NaN.
    """
    del path, row_word, first_row  # of readers of other packages
    columns = {}
    for name, stored in names.items():
        column = table.column(stored)
        values = column.to_numpy()
        if values.dtype.kind == "M":
            known_values = values[~np.isnat(values)]
            values = (values - known_values[:1]) / np.timedelta64(1, "s")
        columns[name] = np.ascontiguousarray(values, dtype=np.float64)
    return columns
