"""Computing steps (stages) of a run, each a pure function of its inputs, computed once and stored.

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
from ssm_study.engine.settings import digest_of_value, target_names

T = TypeVar("T")
Facts = dict[str, Any]
Compute = Callable[[Path], None]


def no_columns(*_: Any) -> Any:
    """Empty set of table columns, for a stage that only writes files."""
    return {}


@dataclass(frozen=True)
class Stage(Generic[T]):
    """Description of one computing step (stage) of a run, such as training: how the step is
    computed, read back and described by table columns. `compute(folder, *before, **parts)` writes
    files, `read(folder)` returns the value in them.

    `measure(value, *before)` gives columns of the record; it has a key of its own, so a new column
    computes nothing again. `before` are the values of earlier stages. `compute` may return the
    value, to save reading it back at once: it must be what `read` gives, to the last bit. `files`
    are those that belong into the run folder as well.
    """

    name: str
    compute: Callable[..., Any]
    read: Callable[[Path], T] = no_columns
    measure: Callable[..., Mapping[str, Any]] = no_columns
    files: tuple[str, ...] = ()
    # Later stages depend on what its files say, not on how they came about: an edit of its code
    # that
    # leaves them as they are makes nothing stale behind it.
    known_by_content: bool = False


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """Folder of a finished computing step (stage), its computing time, and whether a stored result
    was reused."""

    path: Path
    key: str
    seconds: float
    reused: bool
    name: str


@dataclass(frozen=True)
class StageOutput(Generic[T]):
    """Output of a finished computing step (stage) of a run, whose value is read from its folder
    when first needed."""

    stage: Stage[T]
    result: StageResult
    computed: tuple[T, ...] = ()
    facts: Facts = field(default_factory=dict)

    @cached_property
    def value(self) -> T:
        """Value that a computing step of a run wrote, read from the step's folder when first
        needed."""
        return self.computed[0] if self.computed else self.stage.read(self.result.path)

    @cached_property
    def value_key(self) -> str:
        """Key by which later computing steps (stages) of a run identify the result of this step. It
        is the key of the stage, or a checksum of its files, and the version of its reader."""
        origin: Any = self.result.key
        files = [self.result.path / name for name in self.stage.files]
        if self.stage.known_by_content and all(path.is_file() for path in files):
            origin = [sha256_of_file(path) for path in files]
        return digest_of_value([origin, code_version(self.stage.read)])


class Stages(ABC):
    """Interface for running the computing steps (stages) of a run, which are computed and stored or
    only planned. `Store` computes and stores them, `PlannedStages` only notes which would be
    computed."""

    def run_stage(
        self,
        stage: Stage[T],
        settings: Mapping[str, Any],
        parts: Mapping[str, Any] | None = None,
        *before: StageOutput[Any],
    ) -> StageOutput[T]:
        """Compute one step (stage) of a run, or reuse its stored result if the settings are the
        same. `compute` receives the `parts`, by default the settings themselves.

        The key depends on `settings` alone, so values that change no result belong into `parts`. A
        plan has no files, so the value of a stage may only be read inside the functions of a stage.
        """
        arguments = settings if parts is None else parts
        computed: list[T] = []

        def compute(folder: Path) -> None:
            """Compute a step of a run from the values of the steps before, and write its files into
            a folder."""
            values = [output.value for output in before]
            value = stage.compute(folder, *values, **arguments)
            if value is not None:
                computed.append(value)

        # Equal notes, equal results.
        note = {
            "stage": stage.name,
            "settings": settings,
            "before": [output.value_key for output in before],
            "code": code_version(stage.compute, *sorted(target_names(settings))),
        }
        result = self.stage_result(stage.name, digest_of_value(note), note, compute)
        output = StageOutput(stage, result, tuple(computed))
        return replace(output, facts=self.stage_columns(output, before))

    @abstractmethod
    def stage_result(self, name: str, key: str, note: Facts, compute: Compute) -> StageResult:
        """Result of the computing step (stage) with a given key, computed if it is not stored yet.
        `note` says from what the key was made."""

    def stage_columns(self, output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:  # noqa: ARG002
        """Columns of the results table that describe the result of a computing step; empty if the
        step was only planned."""
        return {}

    def unrecorded_store(self) -> "Stages":
        """Copy of this store that does not log computing steps in the run's record."""
        return self


def columns_key(output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> str:
    """Key under which the table columns of a computing step (stage) are stored."""
    earlier_keys = [earlier.value_key for earlier in before]
    return digest_of_value([output.value_key, earlier_keys, code_version(output.stage.measure)])
