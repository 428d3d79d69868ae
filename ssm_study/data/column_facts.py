"""Summary of one column of a log: range, number of distinct values and missing values."""

from dataclasses import dataclass

import numpy as np

from ssm_study.data.readers.reader import Table

HELD = 0.5  # share of samples at which a column that holds levels does not change


@dataclass(frozen=True, kw_only=True)
class ColumnFacts:
    """Summary of one column of a log: unit, range, number of distinct values and number of missing
    values."""

    name: str
    unit: str
    low: float
    high: float
    levels: int
    missing: int
    held: float
    rows: int

    def as_table_line(self) -> str:
        """Line of text on one column of a log: range, number of distinct values and missing
        values."""
        printed_name = self.name or "(no name)"
        name = printed_name[:28]
        unit = f"[{self.unit}]" if self.unit else ""
        return f"  {name:<28} {unit:<8}{self.range_text()}".rstrip()

    def range_text(self) -> str:
        """Text that states the smallest and largest value of a column and how many distinct values
        the column has."""
        if not self.levels:
            return "empty"
        if self.levels == 1:
            missing = f", {self.missing} missing" if self.missing else ""
            return f"{self.low:>11.5g} throughout{missing}"
        holds = f", {self.held:.0%} of rows unchanged" if self.held > HELD else ""
        missing = f", {self.missing} missing" if self.missing else ""
        numbers = f"{self.low:>11.5g} ... {self.high:<11.5g} {self.levels:>6} values"
        return f"{numbers}{holds}{missing}"


def summarise_column(name: str, table: Table) -> ColumnFacts:
    """Summarise one column of a log: unit, range, number of distinct values and number of missing
    values."""
    values = table.columns[name]
    finite = values[np.isfinite(values)]
    is_held = np.diff(finite) == 0
    held_share = float(is_held.mean()) if len(finite) > 1 else 0.0
    is_dated = name in table.dated
    smallest = finite.min(initial=np.inf)
    largest = finite.max(initial=-np.inf)
    distinct = np.unique(finite)
    row_count = len(values)
    finite_count = len(finite)
    return ColumnFacts(
        name=name,
        unit="s" if is_dated else table.units.get(name, ""),
        low=float(smallest) + 0.0,  # no minus before a zero
        high=float(largest) + 0.0,
        levels=len(distinct),
        missing=row_count - finite_count,
        held=held_share,
        rows=len(values),
    )
