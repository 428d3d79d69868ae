"""Plan before work: how many runs and stages a sweep needs, how many are there, and how long the rest will take."""

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from ssm_study.results.store import MANIFEST, Compute, StageResult, Stages, Store


@dataclass(frozen=True)
class PlannedStages(Stages):
    """Walks down the line without computing: every stage is noted with its key and whether the store has it."""

    store: Store
    noted: dict[str, StageResult] = field(default_factory=dict)

    def keyed(self, name: str, key: str, note: dict[str, Any], compute: Compute) -> StageResult:  # noqa: ARG002
        if key not in self.noted:
            folder = self.store.folder(name, key)
            there = (folder / MANIFEST).is_file()
            self.noted[key] = StageResult(path=folder, key=key, seconds=0.0, reused=there, name=name)
        return self.noted[key]


@dataclass(frozen=True, kw_only=True)
class StageForecast:
    """One stage over the whole sweep; `seconds_each` is the mean of those in the store, None if there are none yet."""

    name: str
    needed: int
    there: int
    seconds_each: float | None

    @property
    def missing(self) -> int:
        return self.needed - self.there


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a sweep would do now; `together` holds the number of models of each training program."""

    runs: int
    finished: int
    stages: tuple[StageForecast, ...]
    jobs_at_once: int = 1
    together: tuple[int, ...] = ()

    @property
    def seconds(self) -> float:
        """Stages with known times, spread over the jobs; a lower bound while some are unknown."""
        return sum(stage.missing * (stage.seconds_each or 0.0) for stage in self.stages) / self.jobs_at_once

    def lines(self) -> list[str]:
        lines = [f"{self.runs} runs: {self.finished} finished, {self.runs - self.finished} to do", ""]
        lines += [f"{'stage':<14}{'needed':>8}{'there':>8}{'compute':>9}{'each':>10}"]
        for stage in self.stages:
            each = "unknown" if stage.seconds_each is None else f"{stage.seconds_each:.2f} s"
            lines.append(f"{stage.name:<14}{stage.needed:>8}{stage.there:>8}{stage.missing:>9}{each:>10}")
        unknown = any(stage.missing and stage.seconds_each is None for stage in self.stages)
        bound = "at least " if unknown else "about "
        if self.together:
            members = "+".join(str(models) for models in self.together)
            lines.append(f"trained together: {len(self.together)} groups ({members} models)")
        return [*lines, "", f"estimated time: {bound}{duration(self.seconds)} with {self.jobs_at_once} at a time"]


def plan(
    store: Store,
    walks: Sequence[Callable[[Stages], object]],
    runs: int,
    finished: int,
    jobs_at_once: int = 1,
    together: Sequence[int] = (),
) -> Plan:
    """The plan of `runs` runs; `walks` take the stages of each unfinished one down the line."""
    planned = PlannedStages(store)
    for walk in walks:
        walk(planned)
    by_name: dict[str, list[StageResult]] = defaultdict(list)
    for result in planned.noted.values():
        by_name[result.name].append(result)
    known = stage_seconds(store)
    forecasts = [
        StageForecast(
            name=name,
            needed=len(results),
            there=sum(result.reused for result in results),
            seconds_each=fmean(known[name]) if known[name] else None,
        )
        for name, results in by_name.items()
    ]
    return Plan(
        runs=runs, finished=finished, stages=tuple(forecasts), jobs_at_once=jobs_at_once, together=tuple(together)
    )


def stage_seconds(store: Store) -> defaultdict[str, list[float]]:
    """Seconds of every stage in the store, by stage name."""
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    for manifest in store.root.glob(f"[!.]*/[!.]*/{MANIFEST}"):
        try:
            seconds[manifest.parents[1].name].append(float(json.loads(manifest.read_bytes())["seconds"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue  # a damaged manifest has no say in an estimate
    return seconds


def duration(seconds: float) -> str:
    """`7 s`, `3 min`, `2.5 h`: as precise as an estimate deserves."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
