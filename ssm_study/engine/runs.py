"""Execution of one run: reserve its folder, do the work, and write one record, even after a
failure. A finished run is never touched again."""

import errno
import os
import shutil
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ssm_study.durable import PATIENCE_S, file_lock, link_or_copy_file, write_atomically
from ssm_study.engine import records
from ssm_study.engine.records import CORRUPT, FAILED, INFEASIBLE, LOCK, LOST, OK, RECORD, RUNNING
from ssm_study.engine.stages import StageResult
from ssm_study.engine.store import MANIFEST, read_intact_manifest, write_manifest
from ssm_study.refusal import BadRequest, require

TRACEBACK = "traceback.txt"
ATTEMPTS = "attempts"
KEPT_IN_PLACE = frozenset({LOCK, ".hydra", ATTEMPTS})
LONGEST_MESSAGE = 500  # characters of an error in the record
FINISHED = frozenset({OK, INFEASIBLE})


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a run: its status, and whether the run was executed now or had finished before.
    `did` is one of `ran`, `found` (finished before), `left` (failed before and not to be retried),
    `elsewhere` (another process works on it)."""

    folder: Path
    status: str
    did: str
    message: str = ""


@dataclass
class Run:
    """Folder of a run that is being executed by this process, and the facts recorded so far. The
    work writes its files into `path` and its numbers through `add_columns`."""

    path: Path
    facts: dict[str, Any] = field(default_factory=dict)
    stage_folders: list[Path] = field(default_factory=list)  # that the work has taken so far

    def add_columns(self, **facts: Any) -> None:
        """Add values to the record of a run, where they stay even if the run fails later."""
        self.facts.update(facts)

    def record_stage(
        self, stage: StageResult, files: Iterable[str], facts: Mapping[str, Any]
    ) -> None:
        """Note a finished computing step in the record of a run and copy its files into the run
        folder."""
        about = {"key": stage.key, "seconds": stage.seconds, "reused": stage.reused}
        self.add_columns(
            **facts, **{f"stage_{stage.name}_{name}": value for name, value in about.items()}
        )
        for name in files:
            if (stage.path / name).is_file():
                link_or_copy_file(stage.path / name, self.path / name)
        if not stage.path.is_dir():  # then a file may be missing that it had
            raise FileNotFoundError(errno.ENOENT, "was removed", str(stage.path))

    def lacks_stored_stage(self) -> bool:
        """Whether the stored result of a computing step that a run uses was removed from the
        store."""
        return not all(folder.is_dir() for folder in self.stage_folders)


def execute_run(
    folder: Path,
    parameters: Mapping[str, Any],
    work: Callable[[Run], Mapping[str, Any] | None],
    *,
    configuration: Mapping[str, str] | None = None,
    provenance: Mapping[str, Any] | None = None,
    retry_failed: bool = False,
) -> Outcome:
    """Execute the work of one run in its folder, unless the run is finished, and record results or
    the failure.

    `work` returns further facts; `status` among them may be `infeasible` (default `ok`).
    `parameters` are in the record from the start. `configuration` maps file names to text, written
    below `.hydra/`; `provenance` is who computes. An exception becomes a `failed` record with
    `traceback.txt`; only being stopped (KeyboardInterrupt, SIGTERM, a scheduler's time limit) is
    raised on, leaving a run that the same command takes up again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with file_lock(folder / LOCK, PATIENCE_S) as mine:
        if not mine:  # two sweeps may share runs: who comes second leaves them to the first
            message = "another process is at this run"
            return Outcome(folder=folder, status=RUNNING, did="elsewhere", message=message)
        # Under the lock: another process may have done the run in the meantime.
        before = record_with_status(folder, holds_lock=True)
        if not needs_execution(before, retry_failed):
            return existing_outcome(folder, before)
        _archive_attempt(folder, before)
        for name, text in (configuration or {}).items():
            (folder / ".hydra").mkdir(exist_ok=True)
            write_atomically(folder / ".hydra" / name, text.encode(), durable=False)
        opening = dict(parameters) | _starting_columns(folder, before) | dict(provenance or {})
        return _execute_work(folder, opening, work)


def _starting_columns(folder: Path, earlier_record: Mapping[str, Any] | None) -> dict[str, Any]:
    """Columns of a run's record that are known when the run begins, with the number of attempts."""
    attempts = int((earlier_record or {}).get("attempt") or 0)
    return {
        "study": folder.parent.name,
        "run": folder.name,
        "status": RUNNING,
        "attempt": attempts + 1,
        "started_utc": _utc_now(),
        "pid": os.getpid(),
        "host": socket.gethostname(),
    }


def record_with_status(folder: Path, holds_lock: bool = False) -> dict[str, Any] | None:
    """Record of a run, in which the status is the present one; None if there is no record. The
    status is `corrupt` also for a finished run with a changed file.

    `holds_lock` is for the holder of the lock: a run that says `running` is then nobody's.
    """
    record = records.read_record(folder)
    if record is not None and record["status"] == RUNNING and holds_lock:
        record["status"] = LOST
    if record is not None and record["status"] in FINISHED and read_intact_manifest(folder) is None:
        record["status"] = CORRUPT
    return record


def needs_execution(earlier_record: Mapping[str, Any] | None, retry_failed: bool) -> bool:
    """Whether a run has to be executed, given the record of an earlier execution. Finished runs
    need not; failed ones only with `retry_failed`, or if the machine was at fault (disk,
    signal)."""
    if earlier_record is None:
        return not retry_failed
    status = earlier_record["status"]
    if status == FAILED:
        return retry_failed or bool(earlier_record.get("failure_transient"))
    return status in (LOST, CORRUPT)


def existing_outcome(folder: Path, earlier_record: Mapping[str, Any] | None) -> Outcome:
    """Outcome of a run that is not executed again, read from the record of its last execution."""
    if earlier_record is None:
        message = "never ran; only failed runs are retried"
        return Outcome(folder=folder, status="absent", did="left", message=message)
    did = "found" if earlier_record["status"] in FINISHED else "left"
    message = str(earlier_record.get("error_message") or "")
    return Outcome(folder=folder, status=earlier_record["status"], did=did, message=message)


def _execute_work(
    folder: Path, opening_columns: dict[str, Any], work: Callable[[Run], Mapping[str, Any] | None]
) -> Outcome:
    """Execute the work of a run and write its record, even if the work fails."""
    run = Run(path=folder)
    started = time.perf_counter()
    # Until the end only the lock says that the run is under way.
    records.write_record(folder, opening_columns, durable=False)
    try:
        run.add_columns(**(work(run) or {}))
        status = run.facts.get("status", OK)
        problem = "not the status of finished work"
        require(status in FINISHED, "status", status, problem, "return ok or infeasible")
        seconds = time.perf_counter() - started
        closing = {"status": status, "ended_utc": _utc_now(), "seconds": seconds}
        # Before the record: that one makes the run count, so its files must already be durable.
        write_run_manifest(folder)
        records.write_record(folder, opening_columns | run.facts | closing)
    except (Exception, SystemExit) as error:
        if _is_scheduler_stop(error):
            raise
        death = failure_columns(error, folder)
        if run.lacks_stored_stage():  # its reader may say so in any words
            death["failure_transient"] = True
        write_failure(folder, opening_columns | run.facts, death, text=traceback.format_exc())
        return Outcome(folder=folder, status=FAILED, did="ran", message=death["error_message"])
    return Outcome(folder=folder, status=str(status), did="ran")


def _is_scheduler_stop(error: BaseException) -> bool:
    """Whether an error was raised because the cluster's scheduler announced the end of the job's
    time. The job is queued again, or its last attempt is over; the run is `lost`, so that the next
    attempt or the same command repeats it."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return str(innermost.f_globals.get("__name__")).startswith("submitit.")


def write_run_manifest(folder: Path) -> None:
    """Write a manifest file with the checksums of all files of a run, including its
    configuration."""
    changing = frozenset({LOCK, ATTEMPTS, RECORD, "run.log"})
    write_manifest(folder, {"run": folder.name}, leave_out=changing)


def failure_columns(error: BaseException, folder: Path) -> dict[str, Any]:
    """Columns of a record that describe a failure: type, message, and whether a retry may succeed.
    A transient failure (disk or memory of the machine) is retried by the same command."""
    text = str(error) or type(error).__name__
    if isinstance(error, SystemExit):
        text = f"exited with status {error.code}"
    if isinstance(error, OSError) and error.filename is None:
        text = f"{text} (in {folder})"
    is_transient = any(_is_fault_of_machine(cause, folder) for cause in _exception_chain(error))
    return {
        "error_type": type(error).__name__,
        "error_message": " ".join(text.split())[:LONGEST_MESSAGE],
        "failure_transient": is_transient,
    }


def _exception_chain(error: BaseException) -> Iterator[BaseException]:
    """Iterate over an exception and all exceptions that it was raised from or while handling."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


# OSErrors that a second attempt meets again, unless they are about files of our own that somebody
# has removed.
_PROGRAM_ERRORS = (
    FileNotFoundError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)
# What writers of other libraries quote of a failing disk, in exceptions of their own.
_ERRORS_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ESTALE)
_OF_THE_DISK = tuple(os.strerror(code) for code in _ERRORS_OF_THE_DISK)


def _is_fault_of_machine(error: BaseException, folder: Path) -> bool:
    """Whether an error is the fault of the machine (disk, memory, a removed store) rather than of
    the run."""
    if isinstance(error, FileNotFoundError):
        if error.filename is None:
            return False
        missing = Path(os.fsdecode(error.filename)).absolute()
        return folder.absolute().parents[1] in missing.parents
    if isinstance(error, _PROGRAM_ERRORS):
        return False
    if isinstance(error, (OSError, MemoryError)):
        return True
    return any(message in str(error) for message in _OF_THE_DISK)


def write_failure(
    folder: Path, facts: Mapping[str, Any], error: Mapping[str, Any], text: str
) -> None:
    """Write the traceback of a failed run, then its record, into the run's folder. On a full disk
    the run stays `running` without a lock and counts as lost."""
    with suppress(OSError):
        write_atomically(folder / TRACEBACK, text.encode(errors="replace"))
        storable_facts = {}
        for name, value in facts.items():
            with suppress(BadRequest):  # what no record holds may be the very cause of the failure
                storable_facts[name] = records.storable_value(name, value)
        closing = {"status": FAILED, "ended_utc": _utc_now()} | dict(error)
        (folder / MANIFEST).unlink(missing_ok=True)  # it would seal a finished run
        records.write_record(folder, storable_facts | closing)


def _archive_attempt(folder: Path, earlier_record: Mapping[str, Any] | None) -> None:
    """Move the files of an earlier attempt at a run into a subfolder, to keep the attempts
    apart."""
    if earlier_record is None and not (folder / RECORD).exists():
        for path in folder.glob(".*.tmp"):  # of writes that were killed
            path.unlink()
        return
    attempts = folder / ATTEMPTS
    attempts.mkdir(exist_ok=True)
    numbers = [int(path.name) for path in attempts.iterdir() if path.name.isdigit()]
    attempt = attempts / f"{max(numbers, default=0) + 1}"
    attempt.mkdir()
    # The record last: a kill repeats this.
    for path in sorted(folder.iterdir(), key=lambda path: path.name == RECORD):
        if path.name not in KEPT_IN_PLACE and path.suffix != ".log":
            shutil.move(path, attempt / path.name)


def _utc_now() -> str:
    """Present time in UTC as text in ISO format."""
    return datetime.now(UTC).isoformat(timespec="seconds")
