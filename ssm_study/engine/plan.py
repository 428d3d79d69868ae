"""Plan of a sweep, made before any work. It tells how many runs and stages it needs, how many exist
already, and how long the others will take."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from ssm_study.engine.stages import Compute, Facts, StageOutput, StageResult, Stages, columns_key
from ssm_study.engine.store import MANIFEST, Store


@dataclass(frozen=True)
class PlannedStages(Stages):
    """Stand-in for the store of results in a dry run, which only notes the computing steps that a
    run needs."""

    store: Store
    noted: dict[str, StageResult] = field(default_factory=dict)

    def stage_result(self, name: str, key: str, note: Facts, compute: Compute) -> StageResult:  # noqa: ARG002
        """Note that a run needs a computing step and whether its result is stored, without
        computing the step."""
        if key in self.noted:  # many runs share a stage: its folder is looked for once
            return self.noted[key]
        folder = self.store.stage_folder(name, key)
        # Sums are compared when it is used: a plan reads no gigabytes.
        is_there = (folder / MANIFEST).is_file()
        result = StageResult(path=folder, key=key, seconds=0.0, reused=is_there, name=name)
        self.noted[key] = result
        return result


class KeyedStages(PlannedStages):
    """Stand-in for the store of results in a dry run, which notes the needed computing steps
    and determines the keys of table columns. For this, all code on which the columns depend is
    read."""

    def stage_columns(self, output: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:
        """Determine the key under which the table columns of a step are stored, without computing
        the columns."""
        columns_key(output, before)
        return {}


def plan_lines(
    store: Store,
    runners: Sequence[Callable[[Stages], object]],
    run_count: int,
    finished_count: int,
    jobs_at_once: int = 1,
) -> list[str]:
    """Text lines with the plan of a sweep: how many runs and stages are missing, and how long
    computing them will take. It says `at least` if a missing stage was never timed.

    `runners` take the stages of each unfinished run down the line.
    """
    planned = PlannedStages(store)
    for walk in runners:
        walk(planned)
    needed = Counter(result.name for result in planned.noted.values())
    there = Counter(result.name for result in planned.noted.values() if result.reused)
    lines = []
    seconds = 0.0
    bound = "about"
    for name, count in needed.items():  # in the order of the line
        seconds_each = mean_stage_seconds(store, name)
        missing = count - there[name]
        time_each = "unknown" if seconds_each is None else f"{seconds_each:.2f} s"
        lines.append(f"{name:<14}{count:>8}{there[name]:>8}{missing:>9}{time_each:>10}")
        seconds += missing * (seconds_each or 0.0) / jobs_at_once
        bound = "at least" if missing and seconds_each is None else bound
    return [
        f"{run_count} runs: {finished_count} finished, {run_count - finished_count} to do",
        "",
        f"{'stage':<14}{'needed':>8}{'there':>8}{'compute':>9}{'each':>10}",
        *lines,
        "",
        f"estimated time: {bound} {format_duration(seconds)} with {jobs_at_once} at a time",
    ]


def mean_stage_seconds(store: Store, stage: str) -> float | None:
    """Mean computing time of one step (stage) of a run in seconds, from earlier stored results."""
    seconds = []
    for manifest in store.root.glob(f"{stage}/[!.]*/{MANIFEST}"):
        with suppress(OSError, ValueError, KeyError, TypeError):
            seconds.append(float(json.loads(manifest.read_bytes())["seconds"]))
    return fmean(seconds) if seconds else None


def format_duration(seconds: float) -> str:
    """Duration as text, rounded to the precision of an estimate: `7 s`, `3 min`, `2.5 h`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
