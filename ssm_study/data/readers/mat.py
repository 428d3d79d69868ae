"""MATLAB files of the formats 4 and 5 (to version 7), real matrices only.

Format 5 is read in plain Python with every length checked: `scipy.io.loadmat` ends the whole
process on some damaged
files of it (2026-11, found by fuzzing); there it is the tests' oracle. Source: MathWorks, "MAT-File
Format", R2024a.
"""

import math
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import scipy

from ssm_study.data.readers.reader import Reader, Table, check_named
from ssm_study.refusal import BadRequest, require

COMPRESSED, MATRIX = 15, 14
STORAGE = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
CLASSES = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function",
           17: "an object"}  # fmt: skip
FIRST_NUMERIC_CLASS, LAST_NUMERIC_CLASS, COMPLEX = 6, 15, 0x0800
V4_KINDS = {"U": CLASSES[4], "c": "complex"}  # of NumPy
MOST_BYTES = 1 << 27  # of all decompressed variables

Value = np.ndarray | str  # a string says what it is instead of a real matrix


def _must(condition: bool, otherwise: str) -> None:
    if not condition:
        raise ValueError(otherwise)


class MatReader(Reader, names=(".mat",)):
    """Variables of shape (T, 1) or (1, T); refuses a file that is not whole."""

    def read(self, path: Path, names: list[str]) -> Table:
        try:
            contents = parse(path)
        except (
            Exception
        ) as error:  # whatever scipy, NumPy and zlib raise on damaged files (2026-11)
            said = repr(error) if isinstance(error, LookupError) else error
            problem = f"not a complete MAT file: {said}"
            raise BadRequest("data.path", path, problem, "save it again with -v7") from error
        columns, where = {}, f"{path.name} (variable)"
        check_named(where, names, sorted(contents))
        for name in names:
            value = contents[name]
            if isinstance(value, str):
                raise BadRequest(
                    where, name, f"is {value}, not real numbers", "save it as a vector"
                )
            vector = value.size == max(value.shape, default=0)
            require(vector, where, name, f"has shape {value.shape}, no vector", "cut a column out")
            columns[name] = value.astype(np.float64).reshape(-1)
        return Table(columns=columns)


def parse(path: Path) -> dict[str, Value]:
    """The variables of a file; raises, of whatever type, what is wrong with its bytes."""
    content = path.read_bytes()
    newer = content.startswith((b"MATLAB 7.3", b"\x89HDF"))
    _must(not newer, "it is of version 7.3 (HDF5); save it with -v7")
    _must(len(content) >= 20, "it is too short")
    return dict(_version_4(path) if 0 in content[:4] else _version_5(content))


def _version_5(content: bytes) -> Iterator[tuple[str, Value]]:
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128], "")
    _must(order != "", "its header names no byte order")
    left = MOST_BYTES
    for kind, data in _elements(content[128:], order):
        parts: Iterable[tuple[int, bytes]] = [(kind, data)]
        if kind == COMPRESSED:
            stream = zlib.decompressobj()
            unpacked = stream.decompress(data, max(left, 1))  # 0 would be no limit
            left -= len(unpacked)
            _must(
                not stream.unconsumed_tail,
                f"it unpacks to more than {MOST_BYTES >> 20} MiB; split it",
            )
            parts = _elements(unpacked, order)
            _must(stream.eof, "a compressed variable is cut short")
        yield from (_matrix(matrix, order) for inner, matrix in parts if inner == MATRIX)


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Tagged elements: `(type, length)` and the data, padded to 8 bytes; or both in 8 bytes when
    they fit."""
    at = 0
    while at < len(content):
        first, length = struct.unpack_from(order + "II", content, at)
        if first >> 16:  # both in eight bytes
            kind, length, start, step = first & 0xFFFF, first >> 16, at + 4, 8
            _must(length <= 4, "a small element is too long")
        else:
            kind, start = first, at + 8
            step = 8 + (length if kind == COMPRESSED else -(-length // 8) * 8)
        _must(start + length <= len(content), "it is cut short")
        yield kind, content[start : start + length]
        at += step


def _matrix(data: bytes, order: str) -> tuple[str, Value]:
    parts = list(_elements(data, order))
    _must(len(parts) >= 3, "a variable has no name")
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    shape = tuple(int(n) for n in np.frombuffer(parts[1][1], order + "i4"))
    name = parts[2][1].decode("ascii")
    kind = flags & 0xFF
    if not FIRST_NUMERIC_CLASS <= kind <= LAST_NUMERIC_CLASS:
        return name, CLASSES.get(kind, f"of class {kind}")
    if flags & COMPLEX:
        return name, "complex"
    _must(len(parts) >= 4 and parts[3][0] in STORAGE, f"variable {name} has no numbers")
    numbers = np.frombuffer(parts[3][1], order + STORAGE[parts[3][0]])
    fills = min(shape, default=-1) >= 0 and math.prod(shape) == len(numbers)
    _must(fills, f"{len(numbers)} numbers do not fill a matrix of shape {shape}")
    return name, numbers.reshape(shape, order="F")


def _version_4(path: Path) -> Iterator[tuple[str, Value]]:
    """By scipy, whose reader of this format is plain Python."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # sizes that overflow: what they lead to is an error
        warnings.simplefilter("error", UserWarning)  # a byte order that is not known
        found = scipy.io.loadmat(path, appendmat=False)
    for name, value in found.items():
        yield (
            name,
            V4_KINDS.get(value.dtype.kind, value) if isinstance(value, np.ndarray) else CLASSES[5],
        )
