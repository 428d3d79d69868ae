"""Kinds of findings of `verify`: claims that hold or fail, recomputed columns, claims that are not
checked."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ssm_study.study.recordings import largest_relative_difference
from ssm_study.study.run_files import RunFiles, find_unknown_entries


@dataclass(frozen=True, kw_only=True)
class CheckedClaim:
    """Checked claim of a run: whether the claim holds, and what was observed."""

    claim: str
    holds: bool
    found: str

    def __str__(self) -> str:
        """Verdict, claim and observation of a check in one line."""
        return f"{'holds' if self.holds else 'FAILS'}  {self.claim}: {self.found}"


@dataclass(frozen=True)
class DerivedColumns:
    """Values of a run's record as recomputed from the run's files, by column."""

    columns: Mapping[str, Any]


@dataclass(frozen=True)
class UnconfirmableSettings:
    """Recorded settings that affect no result of a run and can only be compared with its
    configuration. They fail where they differ from it, and are not checked where they agree, for
    the reason."""

    columns: Mapping[str, Any]
    reason: str


@dataclass(frozen=True)
class UncheckedValues:
    """Recorded values or files of a run that cannot be checked, each with the reason."""

    reasons: Mapping[str, str]


Claims = Iterator[CheckedClaim | DerivedColumns | UnconfirmableSettings | UncheckedValues]


def check_agreement(
    claim: str, pairs: Mapping[str, tuple[Any, Any]], tolerance: float, source: str
) -> CheckedClaim:
    """Check whether stored values equal recomputed ones up to a tolerance.

    `source` says in words what gives the value.
    """
    distances = {name: largest_relative_difference(*pair) for name, pair in pairs.items()}
    worst = max(distances, key=lambda name: distances[name])
    largest = distances[worst]
    # So written that NaN is wrong.
    wrong = [name for name in distances if not distances[name] <= tolerance]
    observation = f"{source} to {largest:.1e}"
    if wrong:
        observation = f"{', '.join(wrong)} differ by up to {largest:.1e}"
    return CheckedClaim(claim=claim, holds=not wrong, found=observation)


def check_unknown_entries(run: RunFiles, file: str, read: Any) -> CheckedClaim:
    """Check that a file of a run contains no entries that the program would ignore."""
    extra = find_unknown_entries(run.read_json_object(file), read.to_json())
    observation = f"unknown: {', '.join(extra)}" if extra else "known"
    return CheckedClaim(claim=f"{file} entries", holds=not extra, found=observation)
