"""Which jobs of a sweep get their models from one program that trains them together, before they start."""

import shutil
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil

from hydra.types import TaskFunction

from ssm_study.results.store import Stages
from ssm_study.sweeps.sweep import Job, task_hook

LARGEST = 8  # members per program: measured in benchmarks/training_together.py, more gain nothing
FOLDER = ".together"  # in the study folder: a program's log while it runs, or when it failed


@dataclass(frozen=True)
class Sharing:
    """What a task's hook `sharing` says of a run: runs of one `kind` may share a program, for the model `key`."""

    kind: str
    key: str


def training_programs(task_function: TaskFunction, jobs: Sequence[Job], stages: Stages, at_once: int) -> list[Job]:
    """Jobs that train the models of their `members`; empty where sharing brings nothing or the task knows of none.

    A program has so few members that all `at_once` processes have work, and two at least.
    """
    sharing: Callable[..., Sharing | None] | None = task_hook(task_function, "sharing")
    if sharing is None or len(jobs) < 2:
        return []
    kinds: defaultdict[str, dict[str, list[Job]]] = defaultdict(dict)
    for job in jobs:
        if shared := sharing(job.checked, stages):
            kinds[shared.kind].setdefault(shared.key, []).append(job)
    return [program for models in kinds.values() for program in _programs(list(models.values()), at_once)]


def _programs(models: list[list[Job]], at_once: int) -> list[Job]:
    """One list of jobs per model, dealt out evenly."""
    count = max(at_once, ceil(len(models) / LARGEST))
    dealt = [models[i::count] for i in range(count)]
    return [_program(members) for members in dealt if len(members) > 1]


def _program(models: list[list[Job]]) -> Job:
    first = models[0][0]
    folder = first.folder.parent / FOLDER / first.name
    members = tuple(job for jobs in models for job in jobs)
    return Job(overrides=[], config=first.config, folder=folder, members=members, models=len(models))


def next_to_start(waiting: list[Job], running: Sequence[Job]) -> Job | None:
    """The first that need not wait for its model; taken out of `waiting`."""
    held = {id(job) for program in (*waiting, *running) for job in program.members}
    ready = next((job for job in waiting if id(job) not in held), None)
    if ready is not None:
        waiting.remove(ready)
    return ready


def close(program: Job) -> None:
    """Its members may start, whatever became of it: a model it has not left is trained by the run that needs it."""
    assert program.process is not None
    program.process.join()
    if program.process.exitcode == 0:
        shutil.rmtree(program.folder, ignore_errors=True)
        if program.folder.parent.is_dir() and not any(program.folder.parent.iterdir()):
            program.folder.parent.rmdir()


def attempt(work: Callable[[], object], what: str) -> None:
    """One member's failure is not the others': it is logged here, and raised again in the member's own run."""
    try:
        work()
    except Exception:  # whatever a member raises
        print(f"{what}: left to its own run", file=sys.stderr)
        traceback.print_exc()
