"""MATLAB files up to version 7: vectors by variable name."""

from pathlib import Path

import numpy as np

from ssm_study.data.mat_format import NotAMatFile, Value, parse
from ssm_study.data.table import Table
from ssm_study.refusal import BadRequest, require


def read_mat(path: Path, names: list[str]) -> Table:
    """Variables of shape (T, 1) or (1, T); refuses a file that is not whole."""
    try:
        contents = parse(path.read_bytes())
    except NotAMatFile as error:
        raise BadRequest("data.path", path, f"not a complete MAT file: {error}", "save it again with -v7") from error
    return Table(columns={name: _vector(path, name, contents) for name in names})


def _vector(path: Path, name: str, contents: dict[str, Value]) -> np.ndarray:
    where = f"{path.name} (variable)"
    require(name in contents, where, name, f"the file has {', '.join(sorted(contents))}", "name one of these")
    value = contents[name]
    if isinstance(value, str):
        raise BadRequest(where, name, f"is {value}, not real numbers", "save it as a vector")
    vector = value.size == max(value.shape, default=0)
    require(vector, where, name, f"has shape {value.shape}, no vector", "cut a column out")
    return value.astype(np.float64).reshape(-1)
