"""Fields of a certificate as a file stores them: complete, of the right kind, and of sizes that fit
each other."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ssm_study.certificates.theorem import AGAIN
from ssm_study.refusal import require


def read_fields(where: str, kind: Any, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a dataclass from stored values, by their names in the class. Raises `BadRequest`
    for a missing, unknown or malformed field, and for matrices that do not fit each other."""
    declared = {part.name.rstrip("_"): part for part in fields(kind)}
    for name in declared.keys() ^ stored.keys():
        problem = "is missing" if name in declared else "is not part of a certificate"
        require(False, f"{where}.{name}", stored.get(name), problem, AGAIN)
    values = {}
    for name, part in declared.items():
        values[name] = convert_field(f"{where}.{name}", part.type, stored[name])
    types = {name: part.type for name, part in declared.items()}
    _require_matching_sizes(where, types, values)
    return {declared[name].name: value for name, value in values.items()}


def _require_matching_sizes(
    where: str, types: Mapping[str, Any], values: Mapping[str, Any]
) -> None:
    """Raise `BadRequest` for matrices whose declared shapes share a letter but whose sizes
    differ."""
    # The size of each letter of a shape, and the field that has it first.
    sizes = dict[str, tuple[int, str]]()
    for name, matrix in values.items():
        letters = getattr(types[name], "dim_str", "").split()
        shape = np.shape(matrix)
        for letter, size in zip(letters, shape, strict=True):
            expected, first = sizes.setdefault(letter, (size, name))
            problem = f"is to be {' by '.join(letters)}, and {letter} is {expected} in {first}"
            require(size == expected, f"{where}.{name} (shape)", shape, problem, AGAIN)


def convert_field(where: str, kind: Any, value: Any) -> Any:
    """Convert a stored field to the type that the certificate declares for it. Raises `BadRequest`
    for a value of another kind."""
    if kind in (bool, str):
        require(isinstance(value, kind), where, value, f"is not a {kind.__name__}", AGAIN)
        return value
    is_number = kind is float
    refused = np.array(np.nan)
    try:
        entries = np.array(value, dtype=object)
        # NumPy would read "0.5" and true
        has_words = any(isinstance(entry, bool | str) for entry in entries.flat)
        matrix = refused if has_words else entries.astype(float)
    except (TypeError, ValueError, OverflowError):
        matrix = refused
    dimensions = 0 if is_number else len(kind.dim_str.split())
    fits = matrix.ndim == dimensions and bool(np.isfinite(matrix).all())
    noun = "number" if is_number else "matrix"
    require(fits, where, value, f"is not a finite {noun}", AGAIN)
    return float(value) if is_number else matrix
