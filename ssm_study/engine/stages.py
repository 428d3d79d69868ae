"""Stages: what a run computes on its way, each a pure function of what it is given, computed once
and kept.

The key of a result is written by nobody: it follows from the settings of its parts, the stages
before it and the code of its functions.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

from ssm_study.durable import sha256_of_file
from ssm_study.engine.fingerprint import code_version
from ssm_study.engine.settings import digest, targets

T = TypeVar("T")
Facts = dict[str, Any]
Compute = Callable[[Path], None]


def empty_facts(*_: Any) -> Any:
    """Value, or columns, of a stage that has none: it leaves files only."""
    return {}


@dataclass(frozen=True)
class Stage(Generic[T]):
    """`compute(folder, *before, **parts)` writes files; `read(folder)` gives the value that they
    hold.

    `measure(value, *before)` gives columns of the record; it has a key of its own, so a new column
    computes nothing again. `before` are the values of earlier stages. `compute` may return the
    value, to save reading it back at once: it must be what `read` gives, to the last bit. `files`
    are those that belong into the run folder as well.
    """

    name: str
    compute: Callable[..., Any]
    read: Callable[[Path], T] = empty_facts
    measure: Callable[..., Mapping[str, Any]] = empty_facts
    files: tuple[str, ...] = ()
    # Later stages depend on what its files say, not on how they came about: an edit of its code
    # that
    # leaves them as they are makes nothing stale behind it.
    known_by_content: bool = False


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """The folder of a finished stage. `seconds` is what computing it took; `reused` if not in this
    call."""

    path: Path
    key: str
    seconds: float
    reused: bool
    name: str


@dataclass(frozen=True)
class StageOutput(Generic[T]):
    """A stage that stands: its value is read from its folder when first asked for."""

    stage: Stage[T]
    result: StageResult
    computed: tuple[T, ...] = ()
    facts: Facts = field(default_factory=dict)

    @cached_property
    def value(self) -> T:
        return self.computed[0] if self.computed else self.stage.read(self.result.path)

    @cached_property
    def value_key(self) -> str:
        """Key of the value, by which what depends on it is known: how it was made, or what its
        files
        say, and how these are read."""
        made: Any = self.result.key
        files = [self.result.path / name for name in self.stage.files]
        if self.stage.known_by_content and all(path.is_file() for path in files):
            made = [sha256_of_file(path) for path in files]
        return digest([made, code_version(self.stage.read)])


class Stages(ABC):
    """Takes stages: `Store` computes and keeps, `PlannedStages` only notes what would be
    computed."""

    def run_stage(
        self,
        stage: Stage[T],
        settings: Mapping[str, Any],
        parts: Mapping[str, Any] | None = None,
        *before: StageOutput[Any],
    ) -> StageOutput[T]:
        """The stage of these `settings`, which `compute` is given as `parts` (as they are where
        that is None).

        Of the two the key depends on `settings` alone: what changes no result stands in `parts`. A
        plan has no files, so values may be asked for only inside the functions of a stage.
        """
        arguments = settings if parts is None else parts
        computed: list[T] = []

        def compute(folder: Path) -> None:
            values = [output.value for output in before]
            value = stage.compute(folder, *values, **arguments)
            if value is not None:
                computed.append(value)

        # Equal notes, equal results.
        note = {
            "stage": stage.name,
            "settings": settings,
            "before": [output.value_key for output in before],
            "code": code_version(stage.compute, *sorted(targets(settings))),
        }
        result = self.keyed(stage.name, digest(note), note, compute)
        output = StageOutput(stage, result, tuple(computed))
        return replace(output, facts=self.measured(output, before))

    @abstractmethod
    def keyed(self, name: str, key: str, note: Facts, compute: Compute) -> StageResult:
        """The stage of this key; `note` says what the key was made of."""

    def measured(self, output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:  # noqa: ARG002
        """Columns of a stage; a plan has none."""
        return {}

    def unrecorded(self) -> "Stages":
        """Takes the same stages, of which no run is told: what leads to its own."""
        return self


def measure_key(output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> str:
    """The key of a stage's columns."""
    earlier_keys = [earlier.value_key for earlier in before]
    return digest([output.value_key, earlier_keys, code_version(output.stage.measure)])
