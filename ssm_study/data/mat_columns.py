"""MATLAB files up to version 7: vectors by variable name."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

from ssm_study.data.table import Table
from ssm_study.refusal import BadRequest, require


def read_mat(path: Path, names: list[str]) -> Table:
    """Variables of shape (T, 1) or (1, T)."""
    contents = _load(path)
    return Table(columns={name: _vector(path, name, contents) for name in names})


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        contents = loadmat(path)
    except NotImplementedError as error:
        raise BadRequest("data.path", path, "MATLAB 7.3 (HDF5) files are not read", "save it with -v7") from error
    except Exception as error:  # scipy's parser raises whatever the damaged bytes lead it to (2026-11)
        raise BadRequest(
            "data.path", path, f"not a complete MAT file ({type(error).__name__}: {error})", "save it again"
        ) from error
    return {name: value for name, value in contents.items() if not name.startswith("__")}


def _vector(path: Path, name: str, contents: dict[str, np.ndarray]) -> np.ndarray:
    where = f"{path.name} (variable)"
    require(name in contents, where, name, f"the file has {', '.join(sorted(contents))}", "name one of these")
    value = np.asarray(contents[name])
    require(value.dtype.kind in "fiu", where, name, f"holds {value.dtype}, not real numbers", "save it as a vector")
    require(
        value.size == max(value.shape, default=0),
        where,
        name,
        f"has shape {value.shape}, no vector",
        "cut a column out",
    )
    return value.astype(np.float64).reshape(-1)
