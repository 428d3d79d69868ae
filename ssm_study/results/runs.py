"""One run: claim its folder, do the work, leave one record, of a failure too. A finished run is never touched again."""

import os
import re
import shutil
import socket
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ssm_study.refusal import require
from ssm_study.results.durable import locked_or_none, write_atomically
from ssm_study.results.provenance import provenance
from ssm_study.results.records import (
    CORRUPT,
    FAILED,
    INFEASIBLE,
    LOCK,
    LOST,
    OK,
    RECORD,
    RUNNING,
    read_record,
    write_record,
)
from ssm_study.results.store import StageResult, intact_manifest, seal_folder

TRACEBACK = "traceback.txt"
ATTEMPTS = "attempts"
KEPT_IN_PLACE = frozenset({LOCK, ".hydra", ATTEMPTS})
FINISHED = frozenset({OK, INFEASIBLE})


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run stands after `execute`: `did` is one of `ran`, `found` (finished before), `left` (failed before and not
    asked to retry), `elsewhere` (another process is at it)."""

    folder: Path
    status: str
    did: str
    message: str = ""


@dataclass
class Run:
    """A claimed run folder. The work writes its artefacts into `path` and its numbers through `note`."""

    path: Path
    facts: dict[str, Any] = field(default_factory=dict)

    def note(self, **facts: Any) -> None:
        """Add numbers to the record; they are kept even if the work fails later."""
        self.facts.update(facts)

    def stage(self, result: StageResult) -> StageResult:
        """Note a stage's key, its seconds and whether it was reused; returns the stage, so calls can be chained."""
        self.facts.update(
            {
                f"stage_{result.name}_key": result.key,
                f"stage_{result.name}_seconds": result.seconds,
                f"stage_{result.name}_reused": result.reused,
            }
        )
        return result


def run_folder(results_dir: Path | str, study: str, name: str) -> Path:
    """`results_dir/study/name`; raises `BadRequest` for names that would leave the results folder."""
    for label, part in (("study", study), ("run", name)):
        require(
            re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._=,+-]{0,199}", part) is not None,
            label,
            part,
            "not a plain folder name",
            "use letters, digits, '.', '_' and '-'",
        )
    return Path(results_dir) / study / name


def execute(
    folder: Path,
    parameters: Mapping[str, Any],
    work: Callable[[Run], Mapping[str, Any] | None],
    *,
    configuration: Mapping[str, str] | None = None,
    retry_failed: bool = False,
) -> Outcome:
    """Do `work(run)` in `folder` unless it is done already; record what it returns, or how it failed.

    `work` returns further facts; `status` among them may be `infeasible` (default `ok`). `parameters` are in the record
    from the start. `configuration` maps file names to text, written below `.hydra/`. An exception becomes a `failed`
    record with `traceback.txt`; only being stopped (KeyboardInterrupt, SIGTERM) is raised on, leaving a run that the
    same command takes up again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with locked_or_none(folder / LOCK) as mine:
        if not mine:
            return Outcome(folder=folder, status=RUNNING, did="elsewhere", message="another process is at this run")
        before = standing(folder, mine=True)
        if not is_to_run(before, retry_failed):
            return outcome_of(folder, before)
        _set_aside(folder, before)
        for name, text in (configuration or {}).items():
            (folder / ".hydra").mkdir(exist_ok=True)
            write_atomically(folder / ".hydra" / name, text.encode(), durable=False)
        return _run(folder, _opening(folder, parameters, before), work)


def standing(folder: Path, mine: bool = False) -> dict[str, Any] | None:
    """The record, with `status = corrupt` also for a finished run one of whose artefacts is not as it was written.

    `mine` is for the holder of the lock: a run that says `running` is then nobody's.
    """
    record = read_record(folder)
    if record is not None and record["status"] == RUNNING and mine:
        record["status"] = LOST
    if record is not None and record["status"] in FINISHED and intact_manifest(folder) is None:
        record["status"] = CORRUPT
    return record


def is_to_run(before: Mapping[str, Any] | None, retry_failed: bool) -> bool:
    """Finished runs stay; failed ones wait for `retry_failed`, unless the machine was at fault (disk, signal)."""
    status = before["status"] if before else None
    if retry_failed:
        return status in (FAILED, LOST, CORRUPT)
    return status in (None, LOST, CORRUPT) or (status == FAILED and bool(before and before.get("failure_transient")))


def outcome_of(folder: Path, before: Mapping[str, Any] | None) -> Outcome:
    """Of a run that is not executed now: what its folder says."""
    if before is None:
        return Outcome(folder=folder, status="absent", did="left", message="never ran; only failed runs are retried")
    did = "found" if before["status"] in FINISHED else "left"
    return Outcome(folder=folder, status=before["status"], did=did, message=str(before.get("error_message") or ""))


def _opening(folder: Path, parameters: Mapping[str, Any], before: Mapping[str, Any] | None) -> dict[str, Any]:
    place = {"study": folder.parent.name, "run": folder.name, "status": RUNNING}
    attempt = {"attempt": int((before or {}).get("attempt") or 0) + 1, "started_utc": _now()}
    return dict(parameters) | place | attempt | {"pid": os.getpid(), "host": socket.gethostname()} | provenance()


def _run(folder: Path, opening: dict[str, Any], work: Callable[[Run], Mapping[str, Any] | None]) -> Outcome:
    run, started = Run(path=folder), time.perf_counter()
    write_record(folder, opening, durable=False)  # until the end only the lock says that the run is under way
    try:
        run.note(**(work(run) or {}))
        status = run.facts.get("status", OK)
        require(status in FINISHED, "status", status, "not the status of finished work", "return ok or infeasible")
        closing = {"status": status, "ended_utc": _now(), "seconds": time.perf_counter() - started}
        seal_run(folder)
        write_record(folder, opening | run.facts | closing)
    except (Exception, SystemExit) as error:
        write_failure(folder, opening | run.facts, error_facts(error), text=traceback.format_exc())
        return Outcome(folder=folder, status=FAILED, did="ran", message=error_facts(error)["error_message"])
    return Outcome(folder=folder, status=str(status), did="ran")


def seal_run(folder: Path) -> None:
    """`manifest.json` over the artefacts of the run: what `is_run_intact` compares with."""
    seal_folder(folder, {"run": folder.name}, leave_out=KEPT_IN_PLACE | {RECORD, "run.log"})


def error_facts(error: BaseException) -> dict[str, Any]:
    """The failure as data. Transient: the machine was at fault (disk, memory), so the same command tries again."""
    text = f"exited with status {error.code}" if isinstance(error, SystemExit) else (str(error) or type(error).__name__)
    return {
        "error_type": type(error).__name__,
        "error_message": " ".join(text.split())[:500],
        "failure_transient": isinstance(error, (OSError, MemoryError)) and not isinstance(error, _PROGRAM_ERRORS),
    }


# OSErrors that a second attempt meets again.
_PROGRAM_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)


def write_failure(folder: Path, facts: Mapping[str, Any], error: Mapping[str, Any], text: str) -> None:
    """Traceback first, then the record that names it; on a full disk the run stays `running` without lock: lost."""
    with suppress(OSError):
        write_atomically(folder / TRACEBACK, text.encode(errors="replace"))
        write_record(folder, dict(facts) | {"status": FAILED, "ended_utc": _now()} | dict(error))


def _set_aside(folder: Path, before: Mapping[str, Any] | None) -> None:
    """Move what an earlier attempt left into `attempts/<n>/`, so that two attempts never mix in one file."""
    if before is None and not (folder / RECORD).exists():
        leftovers = [path for path in folder.iterdir() if path.suffix == ".tmp"]
        for path in leftovers:
            path.unlink()
        return
    attempts = folder / ATTEMPTS
    attempts.mkdir(exist_ok=True)
    number = 1 + max((int(path.name) for path in attempts.iterdir() if path.name.isdigit()), default=0)
    (attempts / f"{number}").mkdir()
    for path in sorted(folder.iterdir(), key=lambda path: path.name == RECORD):  # the record last: a kill repeats this
        if path.name not in KEPT_IN_PLACE and path.suffix != ".log":
            shutil.move(path, attempts / f"{number}" / path.name)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
