"""One fresh process per job: a job may raise, exit, crash, hang or be killed, and the others do not notice."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from ssm_study.refusal import BadRequest, require
from ssm_study.results.durable import locked_or_none
from ssm_study.results.jobs import LOG, run_in_this_process
from ssm_study.results.progress import Progress
from ssm_study.results.records import FAILED, INFEASIBLE, LOCK, OK, read_record
from ssm_study.results.runs import Outcome, is_to_run, outcome_of, run_folder, write_failure

# Raised mmap and trim thresholds keep large tensors from going back to the system at every step (1.6-2.2 times faster).
ALLOCATOR = {
    "MALLOC_MMAP_THRESHOLD_": "4294967296",
    "MALLOC_TRIM_THRESHOLD_": "4294967296",
    "MALLOC_TOP_PAD_": "67108864",
}
GRACE_S = 2.0  # between asking a hanging job for its traceback and killing it


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What Hydra hands to a launcher."""

    hydra_context: HydraContext
    task_function: TaskFunction
    config: DictConfig


@dataclass(kw_only=True)
class Job:
    """One configuration of the sweep and, once started, its process."""

    overrides: list[str]
    config: DictConfig
    folder: Path
    outcome: Outcome | None = None
    process: ForkServerProcess | None = None
    started: float = field(default=0.0)

    @property
    def name(self) -> str:
        return self.folder.name


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
        """Compose and check every configuration, then run those that are not finished; one `JobReturn` each."""
        setup_globals()
        jobs = [compose(sweep, words, first_number + i) for i, words in enumerate(overrides)]
        check_all(sweep.task_function, jobs)
        unique = list({job.folder: job for job in jobs}.values())
        retry = bool(OmegaConf.select(sweep.config, "retry_failed", default=False))
        for job in unique:
            before = read_record(job.folder)
            if not is_to_run(before, retry):
                job.outcome = outcome_of(job.folder, before)
        self._run_all(sweep, unique)
        ends = {job.folder: job.outcome for job in unique}
        return [_returned(job, ends[job.folder]) for job in jobs]

    def _run_all(self, sweep: Sweep, jobs: list[Job]) -> None:
        waiting = [job for job in jobs if job.outcome is None]
        running: list[Job] = []
        with Progress(total=len(jobs)) as progress, _stopped_by_signals(running):
            for job in jobs:
                if job.outcome is not None:
                    progress.done(job.outcome.status, reused=True)
            while waiting or running:
                while waiting and len(running) < self.jobs:
                    running.append(self._start(sweep, waiting.pop(0)))
                for job in self._ended(running, progress):
                    running.remove(job)
                    job.outcome = conclude(job)
                    progress.done(job.outcome.status)
            progress.tick(running=0)

    def _start(self, sweep: Sweep, job: Job) -> Job:
        context = get_context("forkserver")
        context.set_forkserver_preload(list(self.preload))
        singletons = Singleton.get_state()["instances"]
        arguments = (job.folder, job.config, sweep.hydra_context, sweep.task_function, singletons)
        job.process = context.Process(target=run_in_this_process, args=arguments, name=job.name)
        with _environment(thread_limits(self.threads) | ALLOCATOR):
            job.process.start()
        job.started = time.monotonic()
        return job

    def _ended(self, running: list[Job], progress: Progress) -> list[Job]:
        """Wait a moment; the jobs that have ended, of themselves or by the time limit."""
        sentinels = {job.process.sentinel: job for job in running if job.process}
        ended = [sentinels[ready] for ready in wait(list(sentinels), timeout=0.5) if isinstance(ready, int)]
        progress.tick(running=len(running))
        for job in running:
            if job not in ended and self.timeout_s and time.monotonic() - job.started > self.timeout_s:
                _stop_hanging(job)
                ended.append(job)
        return ended


def thread_limits(threads: int) -> dict[str, str]:
    """The variables that torch, MKL and OpenBLAS read when they are first imported."""
    counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
    return counts | {"OMP_WAIT_POLICY": "passive"}


def compose(sweep: Sweep, overrides: list[str], number: int) -> Job:
    """The configuration of one job and the folder it names; raises `BadRequest` if that leaves the results folder."""
    config = sweep.hydra_context.config_loader.load_sweep_config(sweep.config, overrides)
    with open_dict(config):
        config.hydra.job.id = number
        config.hydra.job.num = number
    HydraConfig.instance().set_config(config)
    folder = Path(str(config.hydra.sweep.dir)) / str(config.hydra.sweep.subdir)
    run_folder(folder.parent.parent, folder.parent.name, folder.name)
    return Job(overrides=overrides, config=config, folder=folder.absolute())


def check_all(task_function: TaskFunction, jobs: list[Job]) -> None:
    """`check(configuration)` of the task's module on every job, before any starts; `BadRequest` names the job."""
    check: Callable[[DictConfig], None] | None = getattr(sys.modules[task_function.__module__], "check", None)
    for job in jobs:
        if check is None:
            return
        try:
            check(OmegaConf.masked_copy(job.config, [str(key) for key in job.config if key != "hydra"]))
        except BadRequest as refusal:
            where = f"{refusal.field} (of the run {' '.join(job.overrides)})"
            raise BadRequest(where, refusal.value, refusal.problem, refusal.remedy) from refusal


def conclude(job: Job) -> Outcome:
    """What became of a job whose process has ended: its record says, or else how the process died."""
    assert job.process is not None
    job.process.join()
    _kill_group(job)  # what the job started and left behind
    record = read_record(job.folder)
    if record is not None and record["status"] in (OK, INFEASIBLE, FAILED):
        return Outcome(
            folder=job.folder, status=record["status"], did="ran", message=str(record.get("error_message") or "")
        )
    with locked_or_none(job.folder / LOCK) as mine:
        if not mine:
            return outcome_of(job.folder, record)
        facts = {"study": job.folder.parent.name, "run": job.folder.name} | (record or {})
        death = _cause_of_death(job)
        write_failure(job.folder, facts, death, _log_tail(job.folder) or death["error_message"])
    return Outcome(folder=job.folder, status=FAILED, did="ran", message=death["error_message"])


def _cause_of_death(job: Job) -> dict[str, Any]:
    """A signal or an exit without a record. Only being killed from outside is worth a second try of itself."""
    code = job.process.exitcode if job.process and job.process.exitcode is not None else 255
    if code >= 0:
        return _death(
            "ProcessExit", f"the process ended with status {code} before the run was recorded", transient=False
        )
    name = signal.Signals(-code).name
    if job.outcome is not None:
        return _death("Timeout", job.outcome.message, transient=False)
    hint = {"SIGKILL": " (the system does this when memory runs out)", "SIGSEGV": " (a crash in native code)"}
    transient = name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
    return _death(name, f"the process was stopped by {name}{hint.get(name, '')}", transient=transient)


def _death(kind: str, message: str, transient: bool) -> dict[str, Any]:
    return {"error_type": kind, "error_message": message, "failure_transient": transient}


def _stop_hanging(job: Job) -> None:
    """Ask for the traceback (faulthandler answers SIGABRT into the log), then stop the job's whole group."""
    assert job.process is not None
    assert job.process.pid is not None
    spent = time.monotonic() - job.started
    message = f"no result after {spent:.0f} s, the limit of hydra.launcher.timeout_s"
    job.outcome = Outcome(folder=job.folder, status=FAILED, did="ran", message=message)
    with contextlib.suppress(ProcessLookupError):
        os.kill(job.process.pid, signal.SIGABRT)
    job.process.join(GRACE_S)
    _kill_group(job)


def _kill_group(job: Job) -> None:
    if job.process is None or job.process.pid is None:
        return
    for kill in (os.killpg, os.kill) if job.process.is_alive() else (os.killpg,):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            kill(job.process.pid, signal.SIGKILL)


def _log_tail(folder: Path, characters: int = 8000) -> str:
    try:
        return (folder / LOG).read_text(errors="replace")[-characters:]
    except OSError:
        return ""


def _returned(job: Job, outcome: Outcome | None) -> JobReturn:
    returned = JobReturn(overrides=job.overrides, cfg=job.config, working_dir=str(Path.cwd()), task_name=job.name)
    returned.status = JobStatus.COMPLETED
    returned.return_value = outcome
    return returned


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


@contextlib.contextmanager
def _stopped_by_signals(running: list[Job]) -> Iterator[None]:
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
            _kill_group(job)
            if job.process:
                job.process.join(GRACE_S)
        for number, handler in previous.items():
            signal.signal(number, handler)
