"""What a file format, told by its suffix, answers: its columns of numbers, and how to point at one
of its rows."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data import readers
from ssm_study.family import Family
from ssm_study.refusal import BadRequest, require

LARGEST = 1e30  # of a recorded value, and the inverse of the least span: sums of squares stay finite and above 0
INTERPOLATE = "interpolate it (a row taken out would shift the time of all that follow)"


@dataclass(frozen=True, kw_only=True)
class Table:
    """`columns[name] (T,)`; `units[name]` where the file states one; row k is `row_word` number
    `first_row + k`.

    `time_s` are the times the file itself gives its samples (MCAP), None elsewhere.
    """

    columns: dict[str, Float[np.ndarray, "_"]]
    units: dict[str, str] = field(default_factory=dict)
    row_word: str = "sample"
    first_row: int = 0
    time_s: Float[np.ndarray, "T"] | None = None


class Reader(Family):
    """One file format; `names` are its suffixes."""

    @abstractmethod
    def read(self, path: Path, names: list[str]) -> Table:
        """The named columns. Raises `BadRequest` for a file that is not whole, a missing or
        ambiguous column."""


def read_table(path: Path, wanted: dict[str, str]) -> Table:
    """The wanted columns, finite and of one length; each with the unit it is declared in, or "".

    Raises `BadRequest` for a suffix that is not `.csv`, `.mat`, `.parquet` or `.mcap`, a missing or
    malformed file, a
    missing column, values that are no finite numbers, unequal lengths, or a unit that the file
    contradicts.
    """
    require(path.is_file(), "data.path", path, "no such file", "check the spelling")
    formats, kind = Reader.members(readers), path.suffix.lower()
    problem = f"the suffix is none of {', '.join(sorted(formats))}"
    require(kind in formats, "data.path", path, problem, "convert the file")
    table = formats[kind]().read(path, list(wanted))
    lengths = {name: len(table.columns[name]) for name in wanted}
    same = len(set(lengths.values())) == 1
    require(same, f"{path.name} (lengths)", lengths, "columns differ in length", "cut them alike")
    for name, unit in wanted.items():
        values = table.columns[name]
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            where = f"{path.name}, column {name}, {table.row_word} {bad[0] + table.first_row}"
            raise BadRequest(where, values[bad[0]], "not a finite number", INTERPOLATE)
        largest, span = (
            float(np.abs(values).max(initial=0.0)),
            float(np.ptp(values)) if len(values) else 0.0,
        )
        fits = largest < LARGEST and (span == 0 or span > 1 / LARGEST)
        problem = (
            f"floats hold no squares beyond {LARGEST:g}, or of differences below {1 / LARGEST:g}"
        )
        require(
            fits,
            f"{path.name}, column {name} (largest)",
            largest,
            problem,
            "convert it to another unit",
        )
        stated, problem = table.units.get(name, ""), f"{path.name} states {table.units.get(name)}"
        require(
            unit in ("", stated) or not stated,
            f"unit of {name}",
            unit,
            problem,
            "declare the unit the file is in",
        )
    return table


def has_columns(path: Path, names: Sequence[str]) -> bool:
    """Whether the file can be read and has these."""
    try:
        return bool(read_table(path, dict.fromkeys(names, "")))
    except BadRequest:
        return False


def check_named(
    where: str,
    names: list[str],
    known: Sequence[str],
    whole: str = "file",
    remedy: str = "name one of these",
) -> None:
    """Refuse a name that is not known, or known more than once; `whole` holds the known ones."""
    for name in names:
        shown, found = [one for one in known if one], list(known).count(name)
        listing = ", ".join(shown[:12]) + (" ..." if len(shown) > 12 else "")
        require(found > 0, where, name, f"the {whole} has {listing}", remedy)
        require(found == 1, where, name, f"the {whole} has it {found} times", "rename the others")


def arrow_numbers(
    path: Path, table: Any, names: dict[str, str], row_word: str, first_row: int
) -> dict[str, Any]:
    """Columns of an Arrow table as float64, by name; `names` has what the file calls them. Refuses
    an empty cell.

    Dates and times become seconds since the first.
    """
    columns = {}
    for name, stored in names.items():
        column = table.column(stored)
        if column.null_count:
            row = first_row + int(np.flatnonzero(column.is_null().to_numpy())[0])
            raise BadRequest(
                f"{path.name}, column {name}, {row_word} {row}", "(empty)", "no number", INTERPOLATE
            )
        values = column.to_numpy()
        if values.dtype.kind == "M":
            values = (values - values[:1]) / np.timedelta64(1, "s")
        columns[name] = np.ascontiguousarray(values, dtype=np.float64)
    return columns
