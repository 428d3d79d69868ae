"""Columns read from a file, and how to point a reader at one of its rows."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

INTERPOLATE = "interpolate it (a row taken out would shift the time of all that follow)"


@dataclass(frozen=True, kw_only=True)
class Table:
    """`columns[name] (T,)`; `units[name]` where the file states one; row k is `row_word` number `first_row + k`.

    `time_s` are the times the file itself gives its samples (MCAP), None elsewhere.
    """

    columns: dict[str, Float[np.ndarray, "_"]]
    units: dict[str, str] = field(default_factory=dict)
    row_word: str = "sample"
    first_row: int = 0
    time_s: Float[np.ndarray, "T"] | None = None
