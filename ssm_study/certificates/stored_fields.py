"""Fields of a certificate read from a file and checked: complete, of the right kind, and of sizes
that fit each other."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ssm_study.certificates.theorem import AGAIN
from ssm_study.refusal import require


def read_fields(
    error_label: str, dataclass_type: Any, stored_values: Mapping[str, Any]
) -> dict[str, Any]:
    """Convert stored values to the fields of a dataclass, by their names in the class. Raises
    `BadRequest` for a missing, unknown or malformed field, and for matrices that do not fit each
    other."""
    declared = {part.name.rstrip("_"): part for part in fields(dataclass_type)}
    for name in declared.keys() ^ stored_values.keys():
        problem = "is missing" if name in declared else "is not part of a certificate"
        require(False, f"{error_label}.{name}", stored_values.get(name), problem, AGAIN)
    values = {}
    for name, part in declared.items():
        values[name] = convert_field(f"{error_label}.{name}", part.type, stored_values[name])
    types = {name: part.type for name, part in declared.items()}
    _require_matching_sizes(error_label, types, values)
    return {declared[name].name: value for name, value in values.items()}


def _require_matching_sizes(
    error_label: str, types: Mapping[str, Any], values: Mapping[str, Any]
) -> None:
    """Raise `BadRequest` for matrices whose sizes differ in a dimension that they must share."""
    # The size of each letter of a shape, and the field that has it first.
    sizes = dict[str, tuple[int, str]]()
    for name, matrix in values.items():
        letters = getattr(types[name], "dim_str", "").split()
        shape = np.shape(matrix)
        for letter, size in zip(letters, shape, strict=True):
            expected, first = sizes.setdefault(letter, (size, name))
            problem = f"must be {' by '.join(letters)}, and {letter} is {expected} in {first}"
            require(size == expected, f"{error_label}.{name} (shape)", shape, problem, AGAIN)


def convert_field(error_label: str, declared_type: Any, value: Any) -> Any:
    """Convert a stored value to the type that a certificate declares for the field. Raises
    `BadRequest` for a value of another kind."""
    if declared_type in (bool, str):
        require(
            isinstance(value, declared_type),
            error_label,
            value,
            "is not a text" if declared_type is str else "is neither true nor false",
            AGAIN,
        )
        return value
    is_number = declared_type is float
    refused = np.array(np.nan)
    try:
        entries = np.array(value, dtype=object)
        # NumPy would read "0.5" and true
        has_words = any(isinstance(entry, bool | str) for entry in entries.flat)
        matrix = refused if has_words else entries.astype(float)
    except (TypeError, ValueError, OverflowError):
        matrix = refused
    dimensions = 0 if is_number else len(declared_type.dim_str.split())
    fits = matrix.ndim == dimensions and bool(np.isfinite(matrix).all())
    noun = "number" if is_number else "matrix"
    require(fits, error_label, value, f"is not a finite {noun}", AGAIN)
    return float(value) if is_number else matrix
