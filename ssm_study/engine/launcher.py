"""Launching of the jobs of a sweep. Its jobs are composed, checked or planned here for every
launcher; the default one forks a process for each job."""

import contextlib
import os
import signal
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any, Protocol, runtime_checkable

from hydra.core.utils import JobReturn, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from ssm_study.engine.compose import Composer
from ssm_study.engine.jobs import (
    Job,
    create_jobs,
    ended_job_outcome,
    kill_job,
    run_job,
    stop_overdue_job,
)
from ssm_study.engine.plan import KeyedStages, plan_lines
from ssm_study.engine.progress import Progress
from ssm_study.engine.records import FAILED
from ssm_study.engine.server import Server
from ssm_study.engine.task import Task, find_task, shared_store
from ssm_study.refusal import require


@runtime_checkable
class SweepContext(Protocol):
    """Objects that Hydra gives to a launcher when a sweep begins, such as configuration and
    task."""

    hydra_context: HydraContext
    task_function: TaskFunction
    config: DictConfig


class Launcher(ABC):
    """Interface of launchers, which run the jobs of a sweep on this machine or on others."""

    max_parallel_jobs: int

    @abstractmethod
    def run(self, sweep: SweepContext, jobs: list[Job], composer: Composer) -> None:
        """Run the unfinished jobs of a sweep and note the outcome of each. Afterwards each job has
        its `outcome`, even if its process failed."""


def launch_sweep(
    launcher: Launcher, sweep: SweepContext, overrides: Sequence[list[str]], first_number: int
) -> list[JobReturn]:
    """Compose the configurations of a sweep, check the unfinished jobs, then run these jobs or only
    plan them. Returns one `JobReturn` for each."""
    setup_globals()
    task = find_task(sweep.task_function)
    task.refuse_invalid_configuration(sweep.config)
    composer = Composer(
        sweep.hydra_context.config_loader, sweep.config, task.refuse_invalid_configuration
    )
    jobs = create_jobs(composer, overrides, first_number)
    unique = list({job.folder: job for job in jobs}.values())  # equal configurations are one run
    for job in unique:
        job.outcome = task.outcome_without_running(job.settings)
    to_do = [job for job in unique if job.outcome is None]
    for job in to_do:  # all of them before the first is begun: a typo is not found after an hour
        job.check_settings(task)
    if sweep.config.get("dry_run"):
        runners = [partial(task.run_stages, task.request(job.settings)) for job in to_do]
        finished = len(unique) - len(to_do)
        store = shared_store(sweep.config)
        print(
            "\n".join(plan_lines(store, runners, len(unique), finished, launcher.max_parallel_jobs))
        )
    else:
        launcher.run(sweep, unique, composer)
    ends = {job.folder: job.outcome for job in unique}
    return [job.as_hydra_outcome(ends[job.folder]) for job in jobs]


@dataclass(frozen=True, kw_only=True)
class Processes(Launcher):
    """Launcher that runs each job of a sweep in a fresh process, so that a crash cannot affect
    other jobs. A job may raise, exit, crash, hang or be killed.

    `n_jobs` processes at a time with `threads` each; raises `BadRequest` if that is more than the
    cores. With `fail_fast` none is begun after the first failure.
    """

    n_jobs: int | None
    threads: int
    timeout_s: float | None
    fail_fast: bool = False

    def __post_init__(self) -> None:
        cores = len(os.sched_getaffinity(0))
        remedy = "give 1 or more"
        has_thread = self.threads >= 1
        require(
            has_thread,
            "hydra.launcher.threads",
            self.threads,
            "each job needs at least one thread",
            remedy,
        )
        has_job = self.max_parallel_jobs >= 1
        require(
            has_job,
            "hydra.launcher.n_jobs",
            self.n_jobs,
            "at least one job must run at a time",
            remedy,
        )
        most = cores if self.n_jobs is not None else max(cores, self.threads)
        require(
            self.max_parallel_jobs * self.threads <= most,
            "hydra.launcher.n_jobs * threads",
            f"{self.max_parallel_jobs} * {self.threads}",
            f"this machine gives {cores} cores and oversubscribed jobs run 20 times slower",
            f"keep the product at or below {cores}",
        )

    @property
    def max_parallel_jobs(self) -> int:  # type: ignore[override]
        """Number of jobs of a sweep that run at the same time."""
        if self.n_jobs is not None:
            return self.n_jobs
        return max(1, len(os.sched_getaffinity(0)) // self.threads)

    def run(self, sweep: SweepContext, jobs: list[Job], composer: Composer) -> None:
        """Fork a process for each unfinished job, a few at a time, and wait until all have
        ended."""
        to_do = [job for job in jobs if job.outcome is None]
        running = list[Job]()
        task = find_task(sweep.task_function)
        waiting = deque(enumerate(to_do))
        context = sweep.hydra_context
        works = [partial(run_job, job, composer, task, context) for job in to_do]
        # Starts with the first job.
        server = Server(works, preload=partial(preload_for_jobs, task, to_do), threads=self.threads)
        with _end_sweep_on_signals(running, server), Progress(total=len(jobs)) as progress:
            for job in jobs:
                if job.outcome is not None:
                    progress.count_outcome(job.outcome.status, reused=True)
            while waiting or running:
                while waiting and len(running) < self.max_parallel_jobs:
                    number, ready = waiting.popleft()
                    running.append(ready)
                    ready.process = server.fork_job(number)
                    ready.started = time.monotonic()
                for job in self._wait_for_ended_jobs(server, running, progress):
                    running.remove(job)
                    job.outcome = ended_job_outcome(job)
                    progress.count_outcome(job.outcome.status)
                    if self.fail_fast and job.outcome.status == FAILED:
                        waiting.clear()
            progress.update_running_jobs(running=0)

    def _wait_for_ended_jobs(
        self, server: Server, running: list[Job], progress: Progress
    ) -> list[Job]:
        """Wait a moment, and return the jobs of a sweep that have ended or exceeded the time
        limit."""
        server.wait_for_job_end(0.5)
        ended = [job for job in running if job.process and job.process.exitcode is not None]
        progress.update_running_jobs(running=len(running))
        if self.timeout_s is None:
            return ended
        for job in running:
            is_too_long = time.monotonic() - job.started > self.timeout_s
            if job not in ended and is_too_long:
                stop_overdue_job(job)
                ended.append(job)
        return ended


def preload_for_jobs(task: Task[Any], jobs: list[Job]) -> None:
    """Import, before any job of a sweep starts, everything that the jobs need, and read the code on
    which their results depend."""
    planned = KeyedStages(shared_store(jobs[0].settings))
    for job in jobs:
        with contextlib.suppress(Exception):  # the job itself says what is wrong with it
            task.run_stages(task.request(job.settings), planned)
    missing = Counter(result.name for result in planned.noted.values() if not result.reused)
    task.preload_modules({name for name, number in missing.items() if number > 1})
    task.provenance()


@contextlib.contextmanager
def _end_sweep_on_signals(running: list[Job], server: Server) -> Iterator[None]:
    """Context manager in which Ctrl-C and SIGTERM end a sweep and kill its jobs at once. Their runs
    count as `lost` and run again next time."""

    def raise_sweep_end(number: int, _: FrameType | None) -> None:
        """Raise the exception that ends the sweep; later signals are ignored meanwhile."""
        for name in previous:
            signal.signal(name, signal.SIG_IGN)  # a second Ctrl-C shall not stop the cleaning up
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    stopping = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous = {number: signal.signal(number, raise_sweep_end) for number in stopping}
    try:
        yield
    finally:
        try:
            # The groups first: what a job has started is no child of the server.
            for job in running:
                kill_job(job)
            server.close()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
