"""Reader of MATLAB files of version 7.3, which are HDF5 files, by h5py if it is installed.

MATLAB stores a matrix by columns, HDF5 by rows, so each one is turned back; a struct is a group,
and what a variable is stands in its attribute `MATLAB_class`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from ssm_study.refusal import BadRequest

NUMERIC = ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64",
           "uint64", "logical")  # fmt: skip
WORDS = {"char": "text", "cell": "a cell array", "struct": "a struct",
         "function_handle": "a function"}  # fmt: skip
OWN = "#"  # first letter of MATLAB's own groups


def parse_mat_hdf5(path: Path, max_bytes: int) -> dict[str, Shaped[np.ndarray, "..."] | str]:
    """Read the variables of a MATLAB 7.3 file, which is an HDF5 file. Fields of structs have names
    such as `log.u`; a word stands for a value that is no real matrix.

    Raises `BadRequest` where h5py is not installed, and whatever h5py raises for a damaged file.
    """
    try:
        import h5py
    except ImportError as error:
        problem = "a MAT file of version 7.3 (HDF5), and there is no reader of it"
        remedy = "save it with -v7, or pip install h5py"
        raise BadRequest("data.path", path, problem, remedy) from error
    with h5py.File(path, "r") as file:
        pairs = [pair for name in file for pair in iterate_datasets(name, file[name])]
        datasets = [value for _, value in pairs if not isinstance(value, str)]
        total = sum(value.nbytes for value in datasets)
        if total > max_bytes:
            raise ValueError(f"it holds more than {max_bytes >> 20} MiB; split it")
        return {
            name: value if isinstance(value, str) else read_hdf5_matrix(value)
            for name, value in pairs
        }


def iterate_datasets(name: str, node: Any) -> Iterator[tuple[str, Any]]:
    """Iterate over the numeric HDF5 data sets of one MATLAB variable, without reading their
    contents. A word stands for a value without real numbers."""
    if name.startswith(OWN):
        return
    kind = matlab_class(node)
    is_group = hasattr(node, "keys")
    if is_group and kind in ("struct", ""):
        for field in node:
            yield from iterate_datasets(f"{name}.{field}", node[field])
    elif is_group:
        yield name, WORDS.get(kind, "a sparse matrix" if "MATLAB_sparse" in node.attrs else kind)
    elif "MATLAB_object_decode" in node.attrs or kind not in (*NUMERIC, ""):
        yield name, WORDS.get(kind, "an object")
    elif "MATLAB_empty" in node.attrs:
        return
    elif node.dtype.kind not in "fiub":
        yield name, "complex" if node.dtype.names else WORDS.get(kind, "an array of structs")
    else:
        yield name, node


def matlab_class(node: Any) -> str:
    """MATLAB class, such as `double`, that an HDF5 object states in an attribute; empty if none is
    stated."""
    stated = node.attrs.get("MATLAB_class", b"")
    if isinstance(stated, bytes):
        return stated.decode("ascii", errors="replace")
    return str(stated)


def read_hdf5_matrix(node: Any) -> Shaped[np.ndarray, "..."]:
    """Read an HDF5 data set as a matrix with rows and columns as in MATLAB."""
    values = np.asarray(node[()])
    return np.atleast_2d(values).T
