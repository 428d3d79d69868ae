"""Arrays, series and frames as logs, so that what is given in Python is read, checked and named as
any recording."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.refusal import BadRequest, require


def logged(u: Any, y: Any, folder: Path) -> tuple[list[str], list[str], list[str]]:
    """Each experiment as `logs/<digest>.parquet`, so that equal numbers are the same run; its
    columns by name."""
    several = isinstance(u, list | tuple) and len(u) > 0 and np.ndim(u[0]) > 0
    experiments = ([u], [y]) if not several else (u, y)
    counts = tuple(map(len, experiments))
    require(
        counts[0] == counts[1], "u, y", counts, "not as many experiments", "give one y for each u"
    )
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    paths = []
    for one_u, one_y in zip(*experiments, strict=True):
        (inputs, applied), (outputs, measured) = signal(one_u, "u"), signal(one_y, "y")
        lengths = (len(applied), len(measured))
        require(
            lengths[0] == lengths[1],
            "u, y",
            lengths,
            "differ in length",
            "cut both to the same samples",
        )
        columns = [*inputs, *outputs]
        require(
            len(set(columns)) == len(columns),
            "u, y",
            columns,
            "two signals have one name",
            "rename the columns",
        )
        table = pd.DataFrame(np.hstack([applied, measured]), columns=columns)
        digest = hashlib.sha256(repr(list(table)).encode() + table.to_numpy().tobytes()).hexdigest()
        path = folder / "logs" / f"{digest[:16]}.parquet"
        table.to_parquet(path)
        paths.append(str(path))
    return paths, inputs, outputs


def signal(
    values: Any, name: str, channels: int | None = None
) -> tuple[list[str], Float[np.ndarray, "T c"]]:
    """Names and numbers of one signal; raises `BadRequest` for what is no table of numbers or has
    other channels."""
    remedy = "give an array (T, channels)"
    try:
        table = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(name, type(values).__name__, "not a table of numbers", remedy) from error
    require(
        table.ndim in (1, 2) and table.size, name, f"shape {table.shape}", "not a signal", remedy
    )
    table = table.reshape(len(table), -1)
    problem = f"needs one column per channel: {channels}"
    require(
        channels in (None, table.shape[1]),
        name,
        table.shape,
        problem,
        "give those that the model was fitted to",
    )
    if isinstance(values, pd.Series) and values.name is not None:
        return [str(values.name)], table
    if isinstance(values, pd.DataFrame):
        return list(map(str, values)), table
    count = table.shape[1]
    return [name] if count == 1 else [f"{name}_{j + 1}" for j in range(count)], table
