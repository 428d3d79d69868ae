"""The MATLAB file formats 4 and 5 (to version 7), real matrices only, in plain Python with every length checked.

`scipy.io.loadmat` ends the whole process on some damaged files (2026-11, found by fuzzing); it is the tests' oracle.
Source: MathWorks, "MAT-File Format", R2024a.
"""

import struct
import zlib
from collections.abc import Iterator

import numpy as np

COMPRESSED, MATRIX = 15, 14
STORAGE = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
CLASSES = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function",
           17: "an object"}  # fmt: skip
FIRST_NUMERIC_CLASS, LAST_NUMERIC_CLASS, COMPLEX = 6, 15, 0x0800
V4_STORAGE = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}
MOST_BYTES = 1 << 30  # of one decompressed variable

Value = np.ndarray | str  # a string says what it is instead of a real matrix


class NotAMatFile(ValueError):
    """What is wrong with the bytes."""


def parse(content: bytes) -> dict[str, Value]:
    """The variables of a file; raises `NotAMatFile`."""
    if content.startswith(b"MATLAB 7.3") or content.startswith(b"\x89HDF"):
        raise NotAMatFile("it is of version 7.3 (HDF5); save it with -v7")
    if len(content) < 20:
        raise NotAMatFile("it is too short")
    try:
        return dict(_version_4(content) if 0 in content[:4] else _version_5(content))
    except (struct.error, zlib.error, ValueError, UnicodeDecodeError, OverflowError) as error:
        raise NotAMatFile(str(error)) from error


def _version_5(content: bytes) -> Iterator[tuple[str, Value]]:
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise NotAMatFile("its header names no byte order")
    for kind, data in _elements(content[128:], order):
        if kind == COMPRESSED:
            for inner, matrix in _elements(_inflated(data), order):
                if inner == MATRIX:
                    yield _matrix(matrix, order)
        elif kind == MATRIX:
            yield _matrix(data, order)


def _inflated(data: bytes) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(data, MOST_BYTES)
    if not stream.eof:
        raise NotAMatFile("a compressed variable is cut short")
    return content


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Tagged elements: `(type, length)` and the data, padded to 8 bytes; or both in 8 bytes when they fit."""
    at = 0
    while at < len(content):
        first, length = struct.unpack_from(order + "II", content, at)
        if first >> 16:
            kind, length, start, step = first & 0xFFFF, first >> 16, at + 4, 8
            if length > 4:
                raise NotAMatFile("a small element is too long")
        else:
            kind, start = first, at + 8
            step = 8 + (length if kind == COMPRESSED else -(-length // 8) * 8)
        if start + length > len(content):
            raise NotAMatFile("it is cut short")
        yield kind, content[start : start + length]
        at += step


def _matrix(data: bytes, order: str) -> tuple[str, Value]:
    parts = list(_elements(data, order))
    if len(parts) < 3:
        raise NotAMatFile("a variable has no name")
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    shape = tuple(int(n) for n in np.frombuffer(parts[1][1], order + "i4"))
    name = parts[2][1].decode("ascii")
    kind = flags & 0xFF
    if not FIRST_NUMERIC_CLASS <= kind <= LAST_NUMERIC_CLASS:
        return name, CLASSES.get(kind, f"of class {kind}")
    if flags & COMPLEX:
        return name, "complex"
    if len(parts) < 4 or parts[3][0] not in STORAGE:
        raise NotAMatFile(f"variable {name} has no numbers")
    return name, _shaped(np.frombuffer(parts[3][1], order + STORAGE[parts[3][0]]), shape)


def _version_4(content: bytes) -> Iterator[tuple[str, Value]]:
    """Per variable: type `MOPT`, rows, columns, imaginary flag, name length; the name; the numbers by columns."""
    order = "<" if struct.unpack_from("<I", content)[0] < 5000 else ">"
    at = 0
    while at < len(content):
        mopt, rows, columns, imaginary, name_length = struct.unpack_from(order + "5i", content, at)
        thousands, hundreds, tens, ones = mopt // 1000, mopt // 100 % 10, mopt // 10 % 10, mopt % 10
        if thousands != (0 if order == "<" else 1) or hundreds or tens not in V4_STORAGE or imaginary not in (0, 1):
            raise NotAMatFile("a variable's header makes no sense")
        if min(rows, columns) < 0 or not 1 <= name_length <= 4096:
            raise NotAMatFile("a variable's size makes no sense")
        at += 20
        name = content[at : at + name_length].rstrip(b"\0").decode("ascii")
        at += name_length
        storage = np.dtype(order + V4_STORAGE[tens])
        size = rows * columns * storage.itemsize
        if at + size * (1 + imaginary) > len(content):
            raise NotAMatFile("it is cut short")
        numbers = np.frombuffer(content[at : at + size], storage)
        at += size * (1 + imaginary)
        yield name, "complex" if imaginary else _shaped(numbers, (rows, columns)) if ones == 0 else "text"


def _shaped(numbers: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if min(shape, default=-1) < 0 or int(np.prod([int(n) for n in shape], dtype=object)) != len(numbers):
        raise NotAMatFile(f"{len(numbers)} numbers do not fill a matrix of shape {shape}")
    return numbers.reshape(shape, order="F")
