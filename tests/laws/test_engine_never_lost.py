"""No finished run is lost and no failure is final that the machine has caused: each case was lost
once."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from ssm_study.durable import add_digest, json_bytes, link_or_copy_file
from ssm_study.engine.jobs import Job, kill_job, record_death
from ssm_study.engine.records import LOCK, RECORD, parse_record, read_record, write_record
from ssm_study.engine.runs import Run, execute_run, failure_columns
from ssm_study.engine.server import SERVER_DIED, UNBORN, JobProcess, Server
from ssm_study.engine.settings import Settings
from ssm_study.engine.stages import Stage
from ssm_study.engine.task import RunStages
from ssm_study.refusal import BadRequest
from ssm_study.table.gather import gather

PROGRAM = [sys.executable, str(Path(__file__).resolve().parents[1] / "engine_study.py"), "-m"]
ROOT = Path(__file__).resolve().parents[2]
DEATH = {
    "error_type": "ProcessExit",
    "error_message": "ended with status 0",
    "failure_transient": False,
}


def test_a_death_seen_from_another_sweep_does_not_replace_a_finished_run(tmp_path: Path) -> None:
    """The job of a second sweep ends at once, for the run is another's; that one finishes before
    the death is noted."""
    folder = tmp_path / "study" / "run"
    folder.mkdir(parents=True)
    with (folder / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        record = {"status": "running"}
        write_record(folder, record)
        noted: list[Any] = []
        other = Thread(target=lambda: noted.append(record_death(folder, DEATH, "")))
        other.start()
        time.sleep(0.3)
        record = {"status": "ok", "fit_test_percent": 90.0}
        write_record(folder, record)
    other.join()
    status = (read_record(folder) or {})["status"]
    assert status == "ok"
    assert noted[0].status == "ok"
    # The negative control: nobody has finished that one.
    never_path = tmp_path / "study" / "never"
    record_death(never_path, DEATH, "text")
    record = read_record(tmp_path / "study" / "never")
    status = (record or {})["status"]
    assert status == "failed"


def test_a_run_that_a_killed_sweep_left_is_lost_and_not_failed(tmp_path: Path) -> None:
    """The job of a second sweep left the run to the first, which was killed before the end of that
    job was noted."""
    folder = tmp_path / "study" / "run"
    folder.mkdir(parents=True)
    for pid, status in ((4711, "lost"), (4712, "failed")):  # of the process that began the run
        record = {"status": "running", "pid": pid}
        write_record(folder, record)
        outcome = record_death(folder, DEATH, "", pid=4712)
        assert outcome.status == status
        assert (read_record(folder) or {})["status"] == status
    assert execute_run(folder, {}, lambda _: {}, retry_failed=True).status == "ok"


def test_killing_a_job_that_was_never_born_kills_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Group 0 is the caller's own: its shell and script would die."""
    killed: list[int] = []
    monkeypatch.setattr(os, "killpg", lambda pid, _: killed.append(pid))
    monkeypatch.setattr(os, "kill", lambda pid, _: killed.append(pid))
    for pid in (UNBORN, 12345):
        job = Job(overrides=[], settings=Settings(), folder=Path("x"))
        job.process = JobProcess(pid=pid, wait_for_job_end=lambda _: None, exitcode=SERVER_DIED)
        kill_job(job)
    assert killed == [12345]


def test_a_server_that_is_killed_is_started_again() -> None:
    tasks = [lambda: time.sleep(60), lambda: None]
    server = Server(tasks, preload=lambda: None, threads=1)
    first = server.fork_job(0)
    os.kill(server.pid, signal.SIGKILL)
    first.join(10.0)
    assert first.exitcode == SERVER_DIED
    second = server.fork_job(1)
    second.join(10.0)
    assert second.exitcode == 0
    os.kill(server.pid, signal.SIGKILL)
    os.waitid(os.P_PID, server.pid, os.WEXITED | os.WNOWAIT)
    # The broken pipe is a death, not an error of the sweep.
    exitcode = server.fork_job(1).exitcode
    assert exitcode == SERVER_DIED
    server.close()


def start(folder: Path, *words: str, **more: str) -> "subprocess.Popen[str]":
    environment = os.environ | {"PYTHONPATH": str(ROOT), "HYDRA_FULL_ERROR": "1"} | more
    command = [*PROGRAM, f"results_dir={folder / 'results'}", *words]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=environment, text=True, stdout=pipe, stderr=pipe, start_new_session=True
    )


def finish(process: "subprocess.Popen[str]") -> str:
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, output + errors
    return output + errors


def statuses(folder: Path) -> list[str]:
    study_path = folder / "results" / "study"
    paths = study_path.glob(f"*/{RECORD}")
    found = [read_record(path.parent) for path in paths]
    return sorted(str((record or {})["status"]) for record in found)


def test_jobs_of_a_killed_server_are_done_by_the_same_command(tmp_path: Path) -> None:
    process = start(tmp_path, "do=wait,work", "hydra.launcher.n_jobs=1")
    deadline = time.monotonic() + 60
    while not statuses(tmp_path):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    text = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
    children = text.split()
    os.kill(int(children[0]), signal.SIGKILL)
    finish(process)
    expected = ["failed", "ok"]
    assert statuses(tmp_path) == expected
    go_path = tmp_path / "results" / "go"
    go_path.touch()
    finish(start(tmp_path, "do=wait,work"))
    expected = ["ok", "ok"]
    assert statuses(tmp_path) == expected


def test_three_sweeps_into_one_study_end_with_the_undisturbed_table(tmp_path: Path) -> None:
    for process in [start(tmp_path, "seed=range(6)", WORK_S="0.05") for _ in range(3)]:
        finish(process)
    expected = ["ok"] * 6
    assert statuses(tmp_path) == expected
    alone = tmp_path / "alone"
    alone.mkdir()
    finish(start(alone, "seed=range(6)"))
    columns = ["run", "status", "attempt", "fit_test_percent", "number"]
    folders = (tmp_path, alone)
    tables = [gather(folder / "results" / "study")[columns] for folder in folders]
    assert tables[0].equals(tables[1])


def test_a_sweep_can_stop_at_its_first_failure(tmp_path: Path) -> None:
    words = ("do=raise", "seed=range(5)", "hydra.launcher.n_jobs=1")
    process = start(tmp_path, *words, "hydra.launcher.fail_fast=true")
    finish(process)
    assert statuses(tmp_path) == ["failed"]
    process = start(tmp_path, *words)
    finish(process)
    expected = ["failed"] * 5
    assert statuses(tmp_path) == expected


class Unwritable(Exception):
    """Exception of the kind that writers of other libraries raise."""


CAUSES = {
    "the disk, in words of another library": (
        Unwritable(f"chunk 3: {os.strerror(errno.ENOSPC)}"),
        True,
    ),
    "a limit of the size of files, in words of another library": (
        Unwritable("Error while serializing: I/O error: File too large (os error 27)"),
        True,
    ),
    "the disk": (OSError(errno.ENOSPC, "No space left on device"), True),
    "a quota": (OSError(errno.EDQUOT, "Disk quota exceeded"), True),
    "a quota, in words of another library": (Unwritable(os.strerror(errno.EDQUOT)), True),
    "memory": (MemoryError(), True),
    "a file of ours that somebody removed": (
        FileNotFoundError(2, "No such file", "RESULTS/.store/model/m"),
        True,
    ),
    "a file that never was": (FileNotFoundError(2, "No such file", "/data/log.csv"), False),
    "a mistake": (ValueError("singular"), False),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_what_the_machine_has_caused_is_tried_again(tmp_path: Path, cause: str) -> None:
    error, transient = CAUSES[cause]
    if isinstance(error, FileNotFoundError):
        filename = str(error.filename)
        error = FileNotFoundError(2, "No such file", filename.replace("RESULTS", str(tmp_path)))
    folder = tmp_path / "study" / "run"
    facts = failure_columns(error, folder)
    assert facts["failure_transient"] is transient
    wrapped = ValueError("in between")
    wrapped.__cause__ = error
    failure_transient = failure_columns(wrapped, folder)["failure_transient"]
    assert failure_transient is transient


@pytest.mark.parametrize("stage", ["first", "second"])
def test_a_store_that_is_removed_under_a_run_is_no_fault_of_the_run(
    tmp_path: Path, stage: str
) -> None:
    """Readers and writers say so in words of their own: the run had failed for good."""
    store = tmp_path / ".store"

    def compute(folder: Path, name: str) -> None:
        (folder / "number.json").write_text("1")
        if name == stage and not (tmp_path / "removed").exists():
            (tmp_path / "removed").touch()
            shutil.rmtree(store)
            raise BadRequest("recording", folder, "cannot be read", "run again")

    def work(run: Run) -> dict[str, Any]:
        stages = RunStages(store, run)
        for name in ("first", "second"):
            stage = Stage(name=name, compute=compute, files=("number.json",))
            settings = {"name": name}
            stages.run_stage(stage, settings)
        return {}

    folder = tmp_path / "study" / "run"
    status = execute_run(folder, {}, work).status
    assert status == "failed"
    failure_transient = (read_record(folder) or {})["failure_transient"]
    assert failure_transient is True
    status = execute_run(folder, {}, work).status
    assert status == "ok"
    text = (folder / "number.json").read_text()
    assert text == "1"


def test_a_full_disk_names_its_folder(tmp_path: Path) -> None:
    error = OSError(errno.ENOSPC, "No space left on device")
    message = failure_columns(error, tmp_path)["error_message"]
    assert str(tmp_path) in message


def test_a_record_with_a_number_that_fits_no_table_spoils_nothing(tmp_path: Path) -> None:
    study = tmp_path / "study"
    execute_run(study / "good", {"seed": 1}, lambda _: {})
    execute_run(study / "huge", {"seed": 1}, lambda _: {})
    body = {"record_version": 1, "status": "ok", "seed": 10**30}
    huge = json_bytes(add_digest(body))
    (study / "huge" / RECORD).write_bytes(huge)
    expected = {"status": "corrupt"}
    assert parse_record(huge) == expected
    status = gather(study).set_index("run")["status"]
    expected = {"good": "ok", "huge": "corrupt"}
    assert status.to_dict() == expected
    outcome = execute_run(study / "noted", {"seed": 1}, lambda _: {"count": 10**30})
    assert outcome.status == "failed"
    count = -(1 << 63)
    record = {"count": count}
    with pytest.raises(BadRequest, match="count"):
        write_record(study / "good", record)


def test_a_run_shares_its_files_with_the_store_and_stays_whole_without_it(tmp_path: Path) -> None:
    source = tmp_path / "a"
    target = tmp_path / "b"
    source.write_bytes(b"x" * 100_000)
    target.write_bytes(b"old")
    link_or_copy_file(source, target)
    f_fsid = os.statvfs(tmp_path).f_fsid
    shared = f_fsid >= 0 and source.stat().st_ino == target.stat().st_ino
    assert shared or target.stat().st_nlink == 1  # a clone has its own number
    source.unlink()
    assert target.read_bytes() == b"x" * 100_000


def test_a_file_system_with_clones_keeps_the_bytes_once(tmp_path: Path) -> None:
    image = tmp_path / "image"
    disk = tmp_path / "disk"
    disk.mkdir()
    try:
        with image.open("wb") as made:
            made.truncate(400 << 20)  # sparse; XFS makes nothing below 300 MB
        subprocess.run(
            ["mkfs.xfs", "-q", "-m", "reflink=1", image], check=True, capture_output=True
        )
        subprocess.run(["mount", "-o", "loop", image, disk], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("XFS's tools and the right to mount are needed")
    try:
        (disk / "a").write_bytes(os.urandom(8 << 20))
        os.sync()
        before = os.statvfs(disk).f_bfree
        link_or_copy_file(disk / "a", disk / "b")
        os.sync()
        f_bfree = os.statvfs(disk).f_bfree
        difference = before - f_bfree
        f_frsize = os.statvfs(disk).f_frsize
        assert (difference) * f_frsize < 1 << 20
        st_nlinks = [(disk / name).stat().st_nlink for name in "ab"]
        assert st_nlinks == [1, 1]  # cloned, not linked
        (disk / "b").write_bytes(b"another")
        st_size = (disk / "a").stat().st_size
        assert st_size == 8 << 20
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_where_files_cannot_be_shared_they_are_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.EXDEV, "another file system")

    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.setattr(fcntl, "ioctl", refuse)
    (tmp_path / "a").write_text("text")
    link_or_copy_file(tmp_path / "a", tmp_path / "b")
    text = (tmp_path / "b").read_text()
    assert text == "text"
    st_nlink = (tmp_path / "a").stat().st_nlink
    assert st_nlink == 1


NO_FLOCK = """
#include <errno.h>
int flock(int descriptor, int how) { (void)descriptor; (void)how; errno = ENOLCK; return -1; }
"""


@pytest.fixture
def without_flock(tmp_path: Path) -> str:
    """A library under which every flock fails as on a file system that knows none."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    source = tmp_path / "flock.c"
    source.write_text(NO_FLOCK)
    library = tmp_path / "flock.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)
    return str(library)


def test_a_file_system_without_locks_costs_no_run(tmp_path: Path, without_flock: str) -> None:
    """Half of the runs failed for good: each job removed the folder of its living neighbour."""

    process = start(tmp_path, "seed=0", "rate=range(8)", LD_PRELOAD=without_flock, WORK_S="0.3")
    finish(process)
    expected = ["ok"] * 8
    assert statuses(tmp_path) == expected
    again = tmp_path / "two"
    again.mkdir()
    sweeps = [
        start(again, "seed=0,1", "rate=range(4)", LD_PRELOAD=without_flock, WORK_S="0.3")
        for _ in range(2)
    ]
    for sweep in sweeps:
        finish(sweep)
    expected = ["ok"] * 8
    assert statuses(again) == expected
    ledger_path = again / "results" / "ledger"
    text = ledger_path.read_text()
    ledger = text.split("\n")[:-1]
    expected = len(set(ledger))
    assert len(ledger) == expected == 2 + 8
