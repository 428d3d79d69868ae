"""One fresh process per job: a job may raise, exit, crash, hang or be killed, and the others do not notice."""

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType

from hydra.core.utils import JobReturn, setup_globals
from omegaconf import OmegaConf

from ssm_study.refusal import require
from ssm_study.results.allow_list import refuse_foreign_targets
from ssm_study.results.plan import PlannedStages, plan
from ssm_study.results.runs import is_to_run, outcome_of, standing
from ssm_study.results.store import Store
from ssm_study.sweeps.deaths import conclude, kill_group, stop_hanging
from ssm_study.sweeps.groups import close, next_to_start, training_programs
from ssm_study.sweeps.jobs import run_in_this_process, train_in_this_process
from ssm_study.sweeps.progress import Progress
from ssm_study.sweeps.server import Server
from ssm_study.sweeps.sweep import Job, Sweep, check_all, jobs_of, task_hook


@dataclass(frozen=True, kw_only=True)
class Processes:
    """`n_jobs` processes at a time with `threads` each; raises `BadRequest` if that is more than the cores."""

    n_jobs: int | None
    threads: int
    timeout_s: float | None
    preload: tuple[str, ...]

    def __post_init__(self) -> None:
        cores = len(os.sched_getaffinity(0))
        require(self.threads >= 1, "hydra.launcher.threads", self.threads, "a job needs a thread", "give 1 or more")
        require(self.jobs >= 1, "hydra.launcher.n_jobs", self.n_jobs, "no job could run", "give 1 or more")
        require(
            self.jobs * self.threads <= max(cores, self.threads if self.n_jobs is None else 0),
            "hydra.launcher.n_jobs * threads",
            f"{self.jobs} * {self.threads}",
            f"this machine gives {cores} cores and oversubscribed jobs run 20 times slower",
            f"keep the product at or below {cores}",
        )

    @property
    def jobs(self) -> int:
        return max(1, len(os.sched_getaffinity(0)) // self.threads) if self.n_jobs is None else self.n_jobs

    def launch(self, sweep: Sweep, overrides: Sequence[list[str]], first_number: int) -> list[JobReturn]:
        """Compose every configuration, check those that are not finished, then run them; one `JobReturn` each."""
        setup_globals()
        jobs = jobs_of(sweep.hydra_context.config_loader, sweep.config, overrides, first_number)
        unique = list({job.folder: job for job in jobs}.values())
        retry = bool(OmegaConf.select(sweep.config, "retry_failed", default=False))
        for job in unique:
            before = standing(job.folder)
            if not is_to_run(before, retry):
                job.outcome = outcome_of(job.folder, before)
        refuse_foreign_targets(sweep.config)
        check_all(sweep.task_function, [job for job in unique if job.outcome is None])
        if OmegaConf.select(sweep.config, "dry_run"):
            self._tell(sweep, unique)
        else:
            self._run_all(sweep, unique)
        ends = {job.folder: job.outcome for job in unique}
        return [job.returned(ends[job.folder]) for job in jobs]

    def _run_all(self, sweep: Sweep, jobs: list[Job]) -> None:
        to_do = [job for job in jobs if job.outcome is None]
        waiting, running = [*self._programs(sweep, to_do), *to_do], list[Job]()
        numbers = {id(job): number for number, job in enumerate(waiting)}
        server = Server([_task(sweep, job) for job in waiting], preload=self.preload, threads=self.threads)
        with _stopped_by_signals(running, server), Progress(total=len(jobs)) as progress:
            for job in jobs:
                if job.outcome is not None:
                    progress.done(job.outcome.status, reused=True)
            while waiting or running:
                while len(running) < self.jobs and (ready := next_to_start(waiting, running)):
                    running.append(ready)
                    ready.process, ready.started = server.fork(numbers[id(ready)]), time.monotonic()
                for job in self._ended(server, running, progress):
                    running.remove(job)
                    if job.members:
                        close(job)
                        continue
                    job.outcome = conclude(job)
                    progress.done(job.outcome.status)
            progress.tick(running=0)

    def _tell(self, sweep: Sweep, jobs: list[Job]) -> None:
        """Print the plan: `walk(checked, stages)` of the task's module takes each run's stages down the line."""
        walk = task_hook(sweep.task_function, "walk")
        to_do = [job for job in jobs if job.outcome is None]
        walks = [partial(walk, job.checked) for job in to_do] if walk else []
        finished, programs = len(jobs) - len(to_do), [job.models for job in self._programs(sweep, to_do)]
        store = _store(sweep)
        told = plan(store, walks, runs=len(jobs), finished=finished, jobs_at_once=self.jobs, together=programs)
        print("\n".join(told.lines()))

    def _programs(self, sweep: Sweep, jobs: list[Job]) -> list[Job]:
        return training_programs(sweep.task_function, jobs, PlannedStages(_store(sweep)), self.jobs)

    def _ended(self, server: Server, running: list[Job], progress: Progress) -> list[Job]:
        """Wait a moment; the jobs that have ended, of themselves or by the time limit."""
        server.listen(0.5)
        ended = [job for job in running if job.process and job.process.exitcode is not None]
        progress.tick(running=len(running))
        for job in running:
            limit = self.timeout_s * job.models if self.timeout_s else math.inf
            if job not in ended and time.monotonic() - job.started > limit:
                stop_hanging(job)
                ended.append(job)
        return ended


def _task(sweep: Sweep, job: Job) -> Callable[[], object]:
    """What the job's process does."""
    if job.members:
        return partial(train_in_this_process, job.folder, [one.config for one in job.members], sweep.task_function)
    return partial(run_in_this_process, job.folder, job.config, sweep.hydra_context, sweep.task_function)


def _store(sweep: Sweep) -> Store:
    return Store(Path(sweep.config.results_dir) / ".store")


@contextlib.contextmanager
def _stopped_by_signals(running: list[Job], server: Server) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the sweep at once and take its jobs along; their runs are then `lost`, to be run again."""

    def stop(number: int, _: FrameType | None) -> None:
        for name in previous:
            signal.signal(name, signal.SIG_IGN)  # a second Ctrl-C shall not stop the cleaning up
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for job in running:
            kill_group(job)
        server.close()
        for number, handler in previous.items():
            signal.signal(number, handler)
