"""How a job's process ended: by its record, or else by its exit status; and what stops the ones that do not end."""

import contextlib
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssm_study.results.durable import locked_or_none
from ssm_study.results.records import FAILED, FINAL, LOCK, read_record
from ssm_study.results.runs import Outcome, outcome_of, write_failure
from ssm_study.sweeps.jobs import LOG
from ssm_study.sweeps.server import kill_all_of
from ssm_study.sweeps.sweep import Job

GRACE_S = 2.0  # between asking a hanging job for its traceback and killing it


def conclude(job: Job) -> Outcome:
    """What became of a job whose process has ended: its record says, or else how the process died."""
    assert job.process is not None
    job.process.join()
    kill_group(job)  # what the job started and left behind
    death = _cause_of_death(job)
    return note_death(job.folder, death, _log_tail(job.folder) or death["error_message"])


def note_death(folder: Path, death: Mapping[str, Any], text: str) -> Outcome:
    """What the run's record says; if it says nothing final and nobody is at it, a failure with `text` as traceback."""
    record = read_record(folder)
    if record is not None and record["status"] in FINAL:
        return Outcome(
            folder=folder, status=record["status"], did="ran", message=str(record.get("error_message") or "")
        )
    with locked_or_none(folder / LOCK) as mine:
        if not mine:
            return outcome_of(folder, record)
        facts = {"study": folder.parent.name, "run": folder.name} | (record or {})
        write_failure(folder, facts, death, text)
    return Outcome(folder=folder, status=FAILED, did="ran", message=death["error_message"])


def _cause_of_death(job: Job) -> dict[str, Any]:
    """A signal or an exit without a record. Only being killed from outside is worth a second try of itself."""
    code = job.process.exitcode if job.process and job.process.exitcode is not None else 255
    if code >= 0:
        return _death(
            "ProcessExit", f"the process ended with status {code} before the run was recorded", transient=False
        )
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    if job.outcome is not None:
        return _death("Timeout", job.outcome.message, transient=False)
    hint = {"SIGKILL": " (the system does this when memory runs out)", "SIGSEGV": " (a crash in native code)"}
    transient = name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
    return _death(name, f"the process was stopped by {name}{hint.get(name, '')}", transient=transient)


def _death(kind: str, message: str, transient: bool) -> dict[str, Any]:
    return {"error_type": kind, "error_message": message, "failure_transient": transient}


def stop_hanging(job: Job) -> None:
    """Ask for the traceback (faulthandler answers SIGABRT into the log), then stop the job's whole group."""
    assert job.process is not None
    spent = time.monotonic() - job.started
    message = f"no result after {spent:.0f} s, the limit of hydra.launcher.timeout_s"
    job.outcome = Outcome(folder=job.folder, status=FAILED, did="ran", message=message)
    with contextlib.suppress(ProcessLookupError):
        os.kill(job.process.pid, signal.SIGABRT)
    job.process.join(GRACE_S)
    kill_group(job)


def kill_group(job: Job) -> None:
    """SIGKILL to the job and to whatever it started."""
    if job.process is not None and job.process.exitcode is None:
        kill_all_of(job.process.pid)
    elif job.process is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(job.process.pid, signal.SIGKILL)


def _log_tail(folder: Path, characters: int = 8000) -> str:
    try:
        return (folder / LOG).read_text(errors="replace")[-characters:]
    except OSError:
        return ""
