"""Detection of numbers that stand for missing values, such as -9999.

They are read as numbers, since a log may mean them; the outcome and `look` say so.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.data.readers.reader import Table

FULL_SCALE = (32767.0, -32768.0, 65535.0, 2147483647.0, -2147483648.0, 4294967295.0)
NINES = re.compile(r"-?9{2,}(\.9*)?")
FAR = 2.0  # ranges of all other values, between these and a code
CODES = "a number that may stand for a missing value"


def find_missing_code(values: Float[np.ndarray, "T"]) -> tuple[float, int] | None:
    """Find an extreme value in a column that may stand for missing values, such as -9999, and how
    often it occurs."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    for code in (float(finite.min()), float(finite.max())):
        is_code = code in FULL_SCALE or bool(NINES.fullmatch(f"{code:.12g}"))
        other_values = finite[finite != code]
        if not is_code or len(other_values) < 2 or np.ptp(other_values) == 0:
            continue
        distance = float(np.abs(other_values - code).min())
        if distance > FAR * np.ptp(other_values):
            return code, len(finite) - len(other_values)
    return None


def missing_code_remarks(table: Table, signals: Sequence[str]) -> list[str]:
    """Remarks on signals that contain a number, such as -9999, that may stand for missing
    values."""
    remarks = []
    for name in signals:
        code_and_count = find_missing_code(table.columns[name])
        if code_and_count is not None:
            code, count = code_and_count
            rows = "row" if count == 1 else "rows"
            remarks.append(f"{name} is {code:g} in {count} {rows}: {CODES}")
    return remarks
