"""Reader of MATLAB files of the formats 4 and 5 (up to version 7), real matrices only.

Format 5 is read in plain Python with every length checked: `scipy.io.loadmat` ends the whole
process on some damaged files of it (2026-11, found by fuzzing); there it is the tests' oracle.
Source: MathWorks, "MAT-File Format", R2024a.
"""

import math
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.data.readers.mat_hdf5 import parse_mat_hdf5
from ssm_study.data.readers.reader import Reader, Table, require_known_columns
from ssm_study.data.whole_files import read_whole_file
from ssm_study.refusal import BadRequest

ColumnValues = Float[np.ndarray, "_"]

COMPRESSED = 15
MATRIX = 14
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
CLASSES = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix",
           16: "a function",
           17: "an object"}  # fmt: skip
# Properties that have the numbers of an object; an `iddata` has inputs as well.
NUMBERS_OF_CLASSES = {
    "timeseries": "Data",
    "table": "Variables",
    "timetable": "Variables",
    "iddata": "OutputData",
}
FIRST_NUMERIC_CLASS = 6
LAST_NUMERIC_CLASS = 15
COMPLEX = 0x0800
V4_KINDS = {"U": CLASSES[4], "c": "complex"}  # of NumPy
TEXT = 4
CELL = 1
STRUCT = 2
OBJECT = 3
OPAQUE = 17
MOST_STRUCTS = 256  # elements of an array of structs whose fields are read
MOST_BYTES = 1 << 27  # of all decompressed variables

SECONDS = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "minutes": 60.0,
           "hours": 3600.0, "days": 86400.0}  # fmt: skip

Value = np.ndarray | str  # a string says what it is instead of a real matrix


class MatText(str):
    """Text variable in a MATLAB file, which is no signal and only appears in messages."""

    content: str = ""


def _require_intact(condition: bool, message: str) -> None:
    """Raise `ValueError` with a given message for a MATLAB file that violates a condition of the
    file format."""
    if not condition:
        raise ValueError(message)


class MatReader(Reader, names=(".mat",)):
    """Reader of MATLAB files. Vectors have their names, columns of matrices names such as `data:1`,
    fields of structs `log.u`.

    Where the file has one matrix and nothing else, its columns also go by their numbers from 0.
    Objects that are no real numbers are named in the error message, and never make the others
    unreadable. Raises `BadRequest` for an incomplete file.
    """

    def read_columns(self, path: Path, names: list[str]) -> Table:
        columns, skipped, texts = read_numeric_variables(path)
        owners: list[str] = []
        where = f"{path.name} (variable)"
        places = list(columns)
        chosen = {}
        for name in names:
            counted = name.isdigit() and name not in columns and belong_to_one_matrix(columns)
            is_place = counted and int(name) < len(places)
            title = places[int(name)] if is_place else name
            if title in skipped:
                remedy = "save it as a vector"
                raise BadRequest(where, name, f"{skipped[title]}, no vector of numbers", remedy)
            own = [place for place in places if place.startswith(f"{title}:")]
            if title not in columns and own:
                problem = f"is a matrix of {len(own)} columns"
                raise BadRequest(where, name, problem, f"name one as {own[0]} or {own[-1]}")
            require_known_columns(where, [title], sorted(places))
            chosen[name] = columns[title]
            owners.append(title.rpartition(".")[0])
        step_s = stated_step_s(columns, texts, owners)
        remark = f"its Ts is {step_s:g} s" if step_s is not None else ""
        return Table(columns=chosen, step_s=step_s, remark=remark)

    def read_all_columns(self, path: Path) -> Table:
        columns, skipped, texts = read_numeric_variables(path)
        length = max(map(len, columns.values()), default=0)
        others = [name for name, values in columns.items() if len(values) != length]
        for name in others:
            skipped[name] = f"has {len(columns.pop(name))} samples, others {length}"
        return Table(columns=columns, skipped=skipped, remark=name_fields_remark(columns, texts))


def stated_step_s(
    columns: dict[str, ColumnValues], texts: dict[str, str], objects: list[str]
) -> float | None:
    """Sampling period in seconds that MATLAB objects such as `iddata` state in their field `Ts`;
    None if none is stated or they differ."""
    steps = set()
    for owner in objects:
        ts = columns.get(f"{owner}.Ts", np.empty(0))
        if not owner or len(ts) != 1:
            continue
        unit = SECONDS.get(texts.get(f"{owner}.TimeUnit", "seconds") or "seconds")
        if unit is None or not ts[0] > 0:
            return None
        steps.add(float(ts[0]) * unit)
    return steps.pop() if len(steps) == 1 else None


def name_fields_remark(columns: dict[str, ColumnValues], texts: dict[str, str]) -> str:
    """Text that states the name of each element in an array of structs, as recorders store it in a
    field `Name`."""
    remarks = []
    for title in columns:
        owner, _, field = title.rpartition(".")
        stated_name = texts.get(f"{owner}.Name")
        if field == "Data" and stated_name:
            remarks.append(f"{title} is {stated_name}")
    return ", ".join(remarks)


def belong_to_one_matrix(columns: dict[str, ColumnValues]) -> bool:
    """Whether all columns read from a MATLAB file come from one matrix."""
    matrices = {name.split(":")[0] for name in columns}
    return len(matrices) == 1 and len(columns) > 1


def read_numeric_variables(
    path: Path,
) -> tuple[dict[str, ColumnValues], dict[str, str], dict[str, str]]:
    """Read all numeric variables of a MATLAB file, its texts, and the reasons why other variables
    are skipped. Vectors by name, matrices by columns; raises `BadRequest` for a file that is not
    whole."""
    try:
        contents = parse_mat_file(path)
    except BadRequest:
        raise  # no reader of HDF5 is installed
    except Exception as error:  # whatever scipy, NumPy and zlib raise on damaged files (2026-11)
        reason = repr(error) if isinstance(error, LookupError) else error
        problem = f"not a complete MAT file: {reason}"
        remedy = "save it again with -v7"
        raise BadRequest("data.path", path, problem, remedy) from error
    columns: dict[str, np.ndarray] = {}
    skipped: dict[str, str] = {}
    texts: dict[str, str] = {}
    for name, value in contents.items():
        if isinstance(value, str):
            skipped[name] = f"is {value}, not real numbers"
            texts[name] = value.content if isinstance(value, MatText) else ""
        elif value.ndim > 2 or value.size == 0:
            skipped[name] = f"has shape {value.shape}"
        elif min(value.shape, default=1) <= 1:
            columns[name] = value.astype(np.float64).reshape(-1)
        else:
            rows, width = value.shape
            tall = value if rows >= width else value.T
            for j, column in enumerate(tall.T, start=1):
                columns[f"{name}:{j}"] = np.ascontiguousarray(column, dtype=np.float64)
    return columns, skipped, texts


def parse_mat_file(path: Path) -> dict[str, Value]:
    """Parse the bytes of a MATLAB file of any version to named variables. Raises an exception of
    any type where the bytes are wrong."""
    with path.open("rb") as stream:
        head = stream.read(len(b"MATLAB 7.3"))
    if head.startswith((b"MATLAB 7.3", b"\x89HDF")):
        return parse_mat_hdf5(path, MOST_BYTES)
    content = read_whole_file(path, MOST_BYTES, "data.path", "split it")
    _require_intact(len(content) >= 20, "it is too short")
    return dict(_parse_version_4(path) if 0 in content[:4] else _parse_version_5(content))


def _parse_version_5(content: bytes) -> Iterator[tuple[str, Value]]:
    """Iterate over the names and values of the variables in a MATLAB 5 file."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128], "")
    _require_intact(order != "", "its header names no byte order")
    left = MOST_BYTES
    for kind, data in _iterate_elements(content[128:], order):
        parts: Iterable[tuple[int, bytes]] = [(kind, data)]
        if kind == COMPRESSED:
            stream = zlib.decompressobj()
            unpacked = stream.decompress(data, max(left, 1))  # 0 would be no limit
            left -= len(unpacked)
            _require_intact(
                not stream.unconsumed_tail,
                f"it unpacks to more than {MOST_BYTES >> 20} MiB; split it",
            )
            parts = _iterate_elements(unpacked, order)
            _require_intact(stream.eof, "a compressed variable is cut short")
        for inner, matrix in parts:
            if inner == MATRIX:
                variables = _parse_variable(matrix, order)
                # A nameless matrix of bytes holds the contents of the file's objects.
                yield from ((name, value) for name, value in variables if name)


def _iterate_elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Iterate over the data elements of a MATLAB 5 file, each as its type and its contents. `(type,
    length)` and the data, padded to 8 bytes; or both in 8 bytes if they fit."""
    at = 0
    while at < len(content):
        first, length = struct.unpack_from(order + "II", content, at)
        if first >> 16:  # both in eight bytes
            kind = first & 0xFFFF
            length = first >> 16
            start = at + 4
            step = 8
            _require_intact(length <= 4, "a small element is too long")
        else:
            kind = first
            start = at + 8
            padded = -(-length // 8) * 8
            step = 8 + (length if kind == COMPRESSED else padded)
        _require_intact(start + length <= len(content), "it is cut short")
        yield kind, content[start : start + length]
        at += step


def _parse_variable(data: bytes, order: str, owner: str = "") -> Iterator[tuple[str, Value]]:
    """Iterate over the named values in one variable of a MATLAB 5 file; a struct or cell array
    contains several. Fields of structs and cells of cell arrays have names of their own.

    The kind of an object is read before its shape, because objects of new classes have no shape and
    name in the places where matrices have them.
    """
    parts = list(_iterate_elements(data, order))
    if not parts:
        return  # an empty field
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    kind = flags & 0xFF
    if kind == OPAQUE:
        words = [part.decode("ascii", errors="replace") for _, part in parts[1:4]]
        name = owner or next(iter(words), "")
        yield name, describe_matlab_object(name, words[2] if len(words) == 3 else "")
        return
    _require_intact(len(parts) >= 3, "a variable has no name")
    name = owner or parts[2][1].decode("ascii")
    if kind in (STRUCT, OBJECT):
        yield from _parse_struct(parts, kind, name, order)
    elif kind == CELL:
        matrices = [matrix for inner, matrix in parts[3:] if inner == MATRIX]
        for k, matrix in enumerate(matrices, start=1):
            own = name if len(matrices) == 1 else f"{name}{{{k}}}"
            yield from _parse_variable(matrix, order, own)
        if not matrices:
            yield name, CLASSES[CELL]
    else:
        yield name, _parse_matrix(parts, order, name)


def describe_matlab_object(name: str, class_name: str) -> str:
    """Describe, for an error message, a MATLAB object that cannot be read, and name the property
    that contains its numbers."""
    if not class_name:
        return CLASSES[OPAQUE]
    member = NUMBERS_OF_CLASSES.get(class_name)
    remedy = f" (save x = {name}.{member} instead)" if member else ""
    return f"an object of class {class_name}{remedy}"


def _parse_struct(
    parts: list[tuple[int, bytes]], kind: int, owner: str, order: str
) -> Iterator[tuple[str, Value]]:
    """Iterate over the fields of a MATLAB struct or old-style object, named `owner.field`, or
    `owner(1).field` in an array of structs."""
    shape = np.frombuffer(parts[1][1], order + "i4")
    at = 4 if kind == OBJECT else 3  # an object says its class before its fields
    count = int(shape.prod())
    most = MOST_STRUCTS if kind == STRUCT else 1
    if not 1 <= count <= most or len(parts) < at + 2:
        yield owner, CLASSES[kind]
        return
    lengths = struct.unpack_from(order + "i", parts[at][1])
    length = int(lengths[0])
    _require_intact(0 < length <= 4096, "a struct has no names of fields")
    listed = parts[at + 1][1]
    padded = [listed[k : k + length] for k in range(0, len(listed), length)]
    fields = [field.split(b"\0")[0] for field in padded]
    matrices = [matrix for inner, matrix in parts[at + 2 :] if inner == MATRIX]
    labels = [field.decode("ascii") for field in fields]
    owners = [owner] if count == 1 else [f"{owner}({k})" for k in range(1, count + 1)]
    prefixes = [f"{element}." if element else "" for element in owners]
    names = [prefix + label for prefix, label in product(prefixes, labels)]
    _require_intact(len(names) == len(matrices), "a struct has other fields than names")
    for name, matrix in zip(names, matrices, strict=True):
        yield from _parse_variable(matrix, order, name)


def _parse_matrix(parts: list[tuple[int, bytes]], order: str, name: str) -> Value:
    """Parse a matrix of a MATLAB 5 file to real numbers, or return a word for contents that are no
    real numbers."""
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    sizes = np.frombuffer(parts[1][1], order + "i4")
    shape = tuple(int(size) for size in sizes)
    kind = flags & 0xFF
    if not FIRST_NUMERIC_CLASS <= kind <= LAST_NUMERIC_CLASS:
        word = MatText(CLASSES.get(kind, f"of class {kind}"))
        if kind == TEXT and len(parts) >= 4:
            letters = parts[3][1].replace(b"\0", b"")
            word.content = letters.decode("utf-8", errors="replace")
        return word
    if flags & COMPLEX:
        return "complex"
    has_numbers = len(parts) >= 4 and parts[3][0] in STORAGE
    _require_intact(has_numbers, f"variable {name} has no numbers")
    storage, content = parts[3]
    numbers = np.frombuffer(content, order + STORAGE[storage])
    is_shape = min(shape, default=-1) >= 0
    fills = is_shape and math.prod(shape) == len(numbers)
    _require_intact(fills, f"{len(numbers)} numbers do not fill a matrix of shape {shape}")
    return numbers.reshape(shape, order="F")


def _parse_version_4(path: Path) -> Iterator[tuple[str, Value]]:
    """Iterate over the names and values of the variables in a MATLAB 4 file."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # sizes that overflow: what they lead to is an error
        warnings.simplefilter("error", UserWarning)  # a byte order that is not known
        variables = scipy.io.loadmat(path, appendmat=False)
    for name, value in variables.items():
        if isinstance(value, np.ndarray):
            yield name, V4_KINDS.get(value.dtype.kind, value)
        else:
            yield name, CLASSES[5]
