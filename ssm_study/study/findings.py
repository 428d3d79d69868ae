"""Findings of a section of `verify`: a claim that holds or does not, columns derived, claims not
checked."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ssm_study.study.recordings import distance
from ssm_study.study.run_files import RunFiles, unknown


@dataclass(frozen=True, kw_only=True)
class Checked:
    """One claim, whether it holds, and what was found."""

    claim: str
    holds: bool
    found: str

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}  {self.claim}: {self.found}"


@dataclass(frozen=True)
class Derived:
    """Columns as the run's files give them."""

    columns: Mapping[str, Any]


@dataclass(frozen=True)
class NotChecked:
    """Columns or files by name, each with the reason why it cannot be checked."""

    reasons: Mapping[str, str]


Claims = Iterator[Checked | Derived | NotChecked]


def agreement(
    claim: str, pairs: Mapping[str, tuple[Any, Any]], tolerance: float, source: str
) -> Checked:
    """Whether each stored value is the one made again, to `tolerance` of its largest entry.

    `source` says in words what gives the value.
    """
    distances = {name: distance(*pair) for name, pair in pairs.items()}
    worst = max(distances, key=lambda name: distances[name])
    largest = distances[worst]
    # So written that NaN is wrong.
    wrong = [name for name in distances if not distances[name] <= tolerance]
    found = f"{source} to {largest:.1e}"
    if wrong:
        found = f"{', '.join(wrong)} differ by up to {largest:.1e}"
    return Checked(claim=claim, holds=not wrong, found=found)


def entries(run: RunFiles, file: str, read: Any) -> Checked:
    """Whether the file says only what its reader reads."""
    extra = unknown(run.stored(file), read.to_json())
    found = f"unknown: {', '.join(extra)}" if extra else "known"
    return Checked(claim=f"{file} entries", holds=not extra, found=found)
