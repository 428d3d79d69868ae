"""Definitions of the columns of the results table: name, unit, and how each is printed, ranked and
verified."""

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

Kind = Literal["string", "Int64", "Float64", "boolean"]

ONE_FORMULA = 1e-9  # relative: the same float64 formula on another machine's libraries
ITERATED = (
    1e-6  # relative: what an iteration or a thousand steps produce (eigenvalues, frontier, norms)
)
EIGENVALUE = (
    1e-12  # absolute: what rounding moves the smallest eigenvalue of a matrix with unit diagonal
)

# Columns that records of 0.1 (`record_version` 1) lack.
ADDED = "records of 0.1 do not have it"
ADDED_COLUMNS = frozenset(
    {
        "coverage",
        "coverage_needed",
        "coverage_reason",
        "coverage_reference",
        "fresh_sets",
        "noise_gain_model",
        "faster_than_open_loop",
        "predicted_faster",
        "sine_coverage",
        "sine_margin",
        "settling_time_pi_s",
        "stable_count_pi",
        "swings_at_rest",
        "piece_start",
        "fit_test_other_start_percent",
        "members",
        "fit_validation_members_percent",
        "fit_test_members_percent",
    }
)


@dataclass(frozen=True)
class Column:
    """Definition of one column of the results table: its name, type, unit, printed name and the
    direction in which it improves.

    `better` is `high`, `low`, or empty where no direction is better; `word` is what print calls it
    (in `unit`), `head` a heading for narrow tables; a `shown` column is among those that `show`
    prints first. `verify` derives the value again and compares to `tolerance` (relative, for
    Float64) plus `resolution` (absolute), or, where it cannot, lists the column as not checked for
    the reason given in `unchecked`. `setting` is the entry of the configuration that the column
    repeats. A `*` in the name stands for what differs between columns of one sort; without a `kind`
    each is of the kind of its values.
    """

    name: str
    kind: Kind | None
    better: Literal["high", "low", ""] = ""
    head: str = ""
    word: str = ""
    unit: str = ""
    tolerance: float = ONE_FORMULA
    resolution: float = 0.0
    unchecked: str = ""
    setting: str = ""
    shown: bool = False

    @property
    def label(self) -> str:
        """Printed name of a table column with its unit, such as `Mean settling time (s)`."""
        word = self.word or self.name.replace("_", " ")
        return f"{word} ({self.unit})" if self.unit else word

    @property
    def is_pattern(self) -> bool:
        """Whether the name in a column definition contains a wildcard, so that it describes several
        columns."""
        return "*" in self.name

    def matches_name(self, name: str) -> bool:
        """Whether a column definition describes the table column of a given name."""
        return fnmatchcase(name, self.name)


def iterative_result_column(
    name: str,
    better: Literal["high", "low", ""],
    printed_name: str,
    unit: str = "",
    heading: str = "",
) -> Column:
    """Definition of a table column whose values, such as norms, are computed iteratively. `verify`
    compares them with a wider tolerance than the values of a closed formula."""
    return Column(name, "Float64", better, heading, printed_name, unit, ITERATED)
