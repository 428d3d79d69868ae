"""Plan before work: how many runs and stages a sweep needs, how many are there, and how long the rest will take."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from ssm_study.engine.stages import Compute, Facts, Kept, StageResult, Stages, measure_key
from ssm_study.engine.store import MANIFEST, Store


@dataclass(frozen=True)
class PlannedStages(Stages):
    """Walks down the line without computing: every stage is noted with its key and whether the store has it."""

    store: Store
    noted: dict[str, StageResult] = field(default_factory=dict)

    def keyed(self, name: str, key: str, note: Facts, compute: Compute) -> StageResult:  # noqa: ARG002
        if key not in self.noted:  # many runs share a stage: its folder is looked for once
            folder = self.store.folder(name, key)
            there = (folder / MANIFEST).is_file()  # sums are compared when it is used: a plan reads no gigabytes
            self.noted[key] = StageResult(path=folder, key=key, seconds=0.0, reused=there, name=name)
        return self.noted[key]


class KeyedStages(PlannedStages):
    """A plan that asks for the keys of the columns, too: whatever of the code they depend on is read."""

    def measured(self, kept: Kept[Any], before: Sequence[Kept[Any]]) -> Facts:
        measure_key(kept, before)
        return {}


@dataclass(frozen=True)
class StageForecast:
    """One stage over the whole sweep; `seconds_each` is the mean of those in the store, None if there are none yet."""

    name: str
    needed: int
    there: int
    seconds_each: float | None

    @property
    def missing(self) -> int:
        return self.needed - self.there

    def __str__(self) -> str:
        each = "unknown" if self.seconds_each is None else f"{self.seconds_each:.2f} s"
        return f"{self.name:<14}{self.needed:>8}{self.there:>8}{self.missing:>9}{each:>10}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a sweep would do now."""

    runs: int
    finished: int
    stages: tuple[StageForecast, ...]
    jobs_at_once: int = 1

    def lines(self) -> list[str]:
        """The table; the time is a lower bound while some stage was never timed."""
        seconds = sum(stage.missing * (stage.seconds_each or 0.0) for stage in self.stages) / self.jobs_at_once
        bound = "at least" if any(stage.missing and stage.seconds_each is None for stage in self.stages) else "about"
        return [
            f"{self.runs} runs: {self.finished} finished, {self.runs - self.finished} to do",
            "",
            f"{'stage':<14}{'needed':>8}{'there':>8}{'compute':>9}{'each':>10}",
            *map(str, self.stages),
            "",
            f"estimated time: {bound} {duration(seconds)} with {self.jobs_at_once} at a time",
        ]


def plan(
    store: Store, walks: Sequence[Callable[[Stages], object]], runs: int, finished: int, jobs_at_once: int = 1
) -> Plan:
    """The plan of `runs` runs; `walks` take the stages of each unfinished one down the line."""
    planned = PlannedStages(store)
    for walk in walks:
        walk(planned)
    needed = Counter(result.name for result in planned.noted.values())  # in the order of the line
    there = Counter(result.name for result in planned.noted.values() if result.reused)
    stages = tuple(StageForecast(name, needed[name], there[name], each(store, name)) for name in needed)
    return Plan(runs=runs, finished=finished, stages=stages, jobs_at_once=jobs_at_once)


def each(store: Store, stage: str) -> float | None:
    """The mean seconds of a stage in the store; a damaged manifest has no say in it."""
    seconds = []
    for manifest in store.root.glob(f"{stage}/[!.]*/{MANIFEST}"):
        with suppress(OSError, ValueError, KeyError, TypeError):
            seconds.append(float(json.loads(manifest.read_bytes())["seconds"]))
    return fmean(seconds) if seconds else None


def duration(seconds: float) -> str:
    """`7 s`, `3 min`, `2.5 h`: as precise as an estimate deserves."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
