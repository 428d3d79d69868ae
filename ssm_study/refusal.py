"""Errors about bad input, all in one form: field, value, problem and remedy."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

# Errors that NumPy raises of values that are no numbers, or no floats.
NO_NUMBERS = (TypeError, ValueError, OverflowError, RuntimeError)


class BadRequest(ValueError):
    """Error that names the field, the value, the problem and the remedy of a bad input. `<field> =
    <value>: <problem>; <remedy>.`

    Raised while specifications are built, before any long work; the command line prints it and
    exits with status 2.
    """

    def __init__(self, field: str, value: Any, problem: str, remedy: str) -> None:
        self.field = field
        self.value = value
        self.problem = problem
        self.remedy = remedy
        # A library may answer in lines, and a foreign name may hold what would command the
        # terminal.
        shown, reason = (
            escape_control_characters(" ".join(str(part).split())) for part in (value, problem)
        )
        if len(shown) > 80:
            shown = (
                f"...{shown[-77:]}" if isinstance(value, Path) else f"{shown[:77]}..."
            )  # a path ends with its file
        end = "" if remedy.endswith("?") else "."
        super().__init__(f"{field} = {shown}: {reason}; {remedy}{end}")

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.field, self.value, self.problem, self.remedy))


def escape_control_characters(text: str) -> str:
    """Replace the control characters of a text by printable escapes."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


def require(condition: Any, field: str, value: Any, problem: str, remedy: str) -> None:
    """Raise `BadRequest` with field, value, problem and remedy unless a condition holds."""
    if not condition:
        raise BadRequest(field, value, problem, remedy)


def require_positive(field: str, value: Any, remedy: str) -> None:
    """Raise `BadRequest` unless a number, or each of several, is positive and finite. None is
    accepted."""
    values = value if isinstance(value, list | tuple) else (value,)
    good = all(v is None or 0 < v < math.inf for v in values)
    require(good, field, value, "must be positive and finite", remedy)


def require_at_least(minimum: float | int, field: str, value: Any, remedy: str) -> None:
    """Raise `BadRequest` unless a number is finite and not below a minimum. None is accepted."""
    problem = "must not be negative" if minimum == 0 else f"must be at least {minimum:g}"
    require(value is None or minimum <= value < math.inf, field, value, problem, remedy)


def require_seed(field: str, value: Any) -> None:
    """Raise `BadRequest` unless a value can be the seed of random numbers."""
    is_seed = type(value) is int and 0 <= value < 2**32
    require(is_seed, field, value, "not a whole number from 0 to 2^32 - 1", "use 0")


def require_one_of(allowed: Iterable[Any], field: str, value: Any) -> None:
    """Raise `BadRequest` unless a value is among the allowed ones, which the message lists."""
    *others, last = map(str, names := tuple(allowed))
    require(value in names, field, value, "unknown", f"use {', '.join(others)} or {last}")
