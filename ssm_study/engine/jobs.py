"""Jobs of a sweep, each in a process of its own with its own log. Each leaves a record however its
process ends."""

import contextlib
import faulthandler
import os
import signal
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus, configure_log
from hydra.types import HydraContext
from omegaconf import open_dict, read_write

from ssm_study.durable import PATIENCE_S, file_lock
from ssm_study.engine.compose import Composer, set_hydra_config
from ssm_study.engine.records import FAILED, FINAL, LOCK, LOST, read_record
from ssm_study.engine.runs import Outcome, existing_outcome, failure_columns, write_failure
from ssm_study.engine.server import SERVER_DIED, UNBORN, JobProcess, kill_process_tree
from ssm_study.engine.settings import Settings
from ssm_study.engine.task import Task, run_folder
from ssm_study.refusal import BadRequest

LOG = "run.log"
LOG_TAIL = 8000  # characters of it that a traceback shows
OUT_OF_MEMORY_SCORE = 500  # when memory runs out the system stops a job, not the sweep
GRACE_S = 2.0  # between asking a hanging job for its traceback and killing it
HINTS = {
    "SIGKILL": " (the system does this when memory runs out)",
    "SIGSEGV": " (a crash in native code)",
}
# Only these are worth a second try of itself.
FROM_OUTSIDE = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")


@dataclass(kw_only=True)
class Job:
    """One job of a sweep: its settings and, once started, its process."""

    overrides: list[str]
    settings: Settings
    folder: Path
    number: int = 0
    outcome: Outcome | None = None
    process: JobProcess | None = None
    started: float = 0.0

    def as_hydra_outcome(self, outcome: Outcome | None) -> JobReturn:
        """Convert the outcome of a run to the form that Hydra expects."""
        ended = JobReturn(self.overrides, working_dir=str(Path.cwd()), task_name=self.folder.name)
        ended.status = JobStatus.COMPLETED
        ended.return_value = outcome
        return ended

    def check_settings(self, task: Task[Any]) -> None:
        """Check the settings of one job of a sweep before any job is started. Raises the task's
        `BadRequest` with the name of the run added."""
        try:
            task.request(self.settings)
        except BadRequest as refusal:
            where = f"{refusal.field} (of the run {' '.join(self.overrides)})"
            raise BadRequest(where, refusal.value, refusal.problem, refusal.remedy) from refusal


def create_jobs(
    composer: Composer, overrides: Sequence[list[str]], first_number: int = 0
) -> list[Job]:
    """Create the jobs of a sweep, numbered as Hydra numbers them, each with its settings and its
    folder.

    Raises `BadRequest` for a name that leaves the results folder.
    """
    numbered = list(enumerate(overrides, first_number))
    settings = [composer.compose_settings(words, number) for number, words in numbered]
    jobs = []
    for (number, words), of_job in zip(numbered, settings, strict=True):
        folder = run_folder(of_job).absolute()
        jobs.append(Job(overrides=words, settings=of_job, folder=folder, number=number))
    return jobs


def run_job(job: Job, composer: Composer, task: Task[Any], hydra_context: HydraContext) -> None:
    """Run a job in the present process, and write all its output to the log file `run.log` of its
    folder.

    What Hydra's `run_job` does in a process that goes on to other jobs, without the copies it needs
    to undo it.
    """
    os.setsid()  # a group of its own, so that whatever it starts can be stopped with it
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OUT_OF_MEMORY_SCORE))
    _redirect_output(job.folder)  # first of all: what goes wrong from here on is in the log
    config = composer.compose_configuration(job.overrides, job.number)
    with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
        config.hydra.runtime.output_dir = str(job.folder)
    set_hydra_config(config)
    if config.hydra.job.chdir:
        os.chdir(job.folder)
    configure_log(config.hydra.job_logging, config.hydra.verbose)
    os.environ.update(config.hydra.job.env_set)
    hydra_context.callbacks.on_job_start(config=config, task_function=task.run_job)
    # A copy without Hydra's section takes 10 ms.
    ended = JobReturn(overrides=config.hydra.overrides.task, cfg=config)
    try:
        ended.return_value = task.run_job(job.settings)
        ended.status = JobStatus.COMPLETED
    except Exception as error:  # whatever the task raises
        ended.return_value = error
        ended.status = JobStatus.FAILED
        text = "".join(traceback.format_exception(error))
        print(text, file=sys.stderr)
        record_death(job.folder, failure_columns(error, job.folder), text, os.getpid())
    hydra_context.callbacks.on_job_end(config=config, job_return=ended)
    if ended.status is JobStatus.FAILED:
        sys.exit(1)


def _redirect_output(folder: Path) -> None:
    """Redirect all output of this process into the log file `run.log` of a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    log = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    null_device = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((null_device, 0), (log, 1), (log, 2)):
        # The descriptors themselves: native code and what the job starts write there, too.
        os.dup2(source, target)
    faulthandler.enable()  # a crash in native code leaves its Python traceback in the log


def ended_job_outcome(job: Job) -> Outcome:
    """Outcome of a job whose process has ended, read from the job's record, else from the process's
    exit status."""
    assert job.process is not None
    job.process.join()
    kill_job(job)  # what the job started and left behind
    death = _death_cause_columns(job)
    text = ""
    with contextlib.suppress(OSError):  # it died before it could open its log
        text = (job.folder / LOG).read_text(errors="replace")[-LOG_TAIL:]
    return record_death(job.folder, death, text, job.process.pid)


def record_death(
    folder: Path, death: Mapping[str, Any], text: str, pid: int | None = None
) -> Outcome:
    """Write into the record of a run that its process died, unless the record is final, and return
    the run's outcome. A failure with `text` as traceback is recorded if no process works on the
    run.

    Nothing is recorded if another process than `pid` began the run: then a killed sweep left it,
    and it counts as lost.
    """
    with file_lock(folder / LOCK, PATIENCE_S) as mine:
        # Under the lock: another sweep may have finished the run in the meantime.
        record = read_record(folder)
        if record is not None and record["status"] in FINAL:
            message = str(record.get("error_message") or "")
            return Outcome(folder=folder, status=record["status"], did="ran", message=message)
        is_of_another = pid is not None and record is not None and record.get("pid") != pid
        if mine and record and is_of_another:
            record |= {"status": LOST}
        if not mine or is_of_another:  # this death is no end of the run
            return existing_outcome(folder, record)
        facts = {"study": folder.parent.name, "run": folder.name} | (record or {})
        write_failure(folder, facts, death, text or death["error_message"])
    return Outcome(folder=folder, status=FAILED, did="ran", message=death["error_message"])


def _death_cause_columns(job: Job) -> dict[str, Any]:
    """Record columns that say why the process of a job died: it was ended by a signal, or left no
    record."""
    code = job.process.exitcode if job.process else None
    if code is None or code == SERVER_DIED:
        message = "the process that jobs are forked from was killed"
        return _death_columns("ServerKilled", message, transient=True)
    if code >= 0:  # it chose to end; a signal has a negative code
        message = f"the process ended with status {code} before the run was recorded"
        return _death_columns("ProcessExit", message, transient=False)
    if job.outcome is not None:
        return _death_columns("Timeout", job.outcome.message, transient=False)
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    message = f"the process was stopped by {name}{HINTS.get(name, '')}"
    return _death_columns(name, message, transient=name in FROM_OUTSIDE)


def _death_columns(error_type: str, message: str, transient: bool) -> dict[str, Any]:
    """Record columns for a job that ended without a record: error type, message, and whether a
    retry may succeed."""
    return {"error_type": error_type, "error_message": message, "failure_transient": transient}


def stop_overdue_job(job: Job) -> None:
    """Stop a job that exceeds its time limit, after its traceback has been written to its log.
    Faulthandler writes it on SIGABRT; then the whole process group is killed."""
    assert job.process is not None
    seconds = time.monotonic() - job.started
    message = f"no result after {seconds:.0f} s, the limit of hydra.launcher.timeout_s"
    job.outcome = Outcome(folder=job.folder, status=FAILED, did="ran", message=message)
    with contextlib.suppress(ProcessLookupError):  # it may end by itself at this very moment
        os.kill(job.process.pid, signal.SIGABRT)
    job.process.join(GRACE_S)
    kill_job(job)


def kill_job(job: Job) -> None:
    """Kill the process of a job and all processes that it started. A job that was never started has
    no group (0 would be our own)."""
    if job.process is None or job.process.pid == UNBORN:
        return
    if job.process.exitcode is None:
        kill_process_tree(job.process.pid)
    else:
        # Its own number may be another process's by now, that of its group not while a member
        # lives.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(job.process.pid, signal.SIGKILL)
