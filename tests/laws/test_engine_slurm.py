"""A job that the scheduler ends is a row of the table; its results are otherwise what it
returned."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus

from ssm_study.engine.jobs import Job
from ssm_study.engine.records import read_record
from ssm_study.engine.runs import Run, execute_run
from ssm_study.engine.stages import Stage
from ssm_study.engine.task import RunStages
from ssm_study.table.gather import gather

submitit = pytest.importorskip("submitit", reason="the extra `slurm` is not installed")

from hydra_plugins.ssm_study_slurm import SlurmLauncher  # noqa: E402
from ssm_study.engine.settings import Settings  # noqa: E402
from ssm_study.engine.slurm import submitit_executor, wait_for_outcome  # noqa: E402


def begun(folder: Path, how: str) -> JobReturn:
    """Run the job of a node: a whole run, or one that is killed in the middle of it."""

    def work(_: Any) -> dict[str, float]:
        if how == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        while how == "waits":
            time.sleep(0.1)
        return {"fit_test_percent": 50.0}

    returned = JobReturn(status=JobStatus.COMPLETED)
    returned.return_value = execute_run(folder, {"seed": 1}, work)
    return returned


@pytest.fixture(autouse=True)
def _interrupts_count() -> Iterator[None]:
    """Jobs are cancelled as by Ctrl-C, which whoever began this process may ignore or block for all
    below it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    yield
    signal.signal(signal.SIGINT, before)


def submitted(folder: Path, how: str) -> Any:
    """submitit's own local scheduler: real processes that return, die and are cancelled as Slurm's
    do."""
    local = submitit.AutoExecutor(cluster="local", folder=folder / "logs")
    # Half a minute before its end submitit would ask the job to stop.
    local.update_parameters(timeout_min=10)
    return local.submit(begun, folder / "study" / how, how)


def test_what_the_scheduler_ends_is_a_failed_run_that_the_same_command_does_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Where the jobs find `begun`.
    parent = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", parent, prepend=os.pathsep)
    # Of 15 s for a file that a dead job never leaves.
    monkeypatch.setattr(submitit.Job, "_results_timeout_s", 1)
    hows = ("returns", "killed", "waits")
    jobs = {how: submitted(tmp_path, how) for how in hows}
    deadline = time.monotonic() + 60
    while read_record(tmp_path / "study" / "waits") is None:
        assert time.monotonic() < deadline, "the job never began"
        time.sleep(0.05)
    while not jobs["waits"].done():
        assert time.monotonic() < deadline, "the job was not cancelled"
        jobs["waits"].cancel(check=False)
        for _ in range(50):
            seconds = 0.0 if jobs["waits"].done() else 0.1
            time.sleep(seconds)
    for how, running in jobs.items():
        folder = tmp_path / "study" / how
        job = Job(overrides=[], settings=Settings(), folder=folder)
        # Submitit's local scheduler has no accounts to ask.
        outcome = wait_for_outcome(job, running, patience_s=600.0)
        expected = "ok" if how == "returns" else "failed"
        assert outcome.status == expected
    rows = gather(tmp_path / "study").set_index("run")
    expected = {"returns": "ok", "killed": "failed", "waits": "failed"}
    assert rows["status"].to_dict() == expected
    assert rows.loc[["killed", "waits"], "failure_transient"].all(), rows["error_message"].to_dict()
    assert rows.loc[["killed", "waits"], "error_message"].str.startswith("Slurm ended job").all()
    traceback_path = tmp_path / "study" / "killed" / "traceback.txt"
    text = traceback_path.read_text()
    assert text.strip()
    folder = tmp_path / "study" / "killed"
    job_return = begun(folder, "returns")
    return_value = job_return.return_value
    status = return_value.status
    assert status == "ok"


def refusing(folder: Path) -> JobReturn:
    """Return of a node's job that raises before the run has a record."""
    overrides = [str(folder)]
    returned = JobReturn(overrides=overrides, status=JobStatus.FAILED)
    returned.return_value = ValueError("no such thing on this node")
    return returned


def test_what_a_job_raises_on_its_node_is_a_failed_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", parent, prepend=os.pathsep)
    local = submitit.AutoExecutor(cluster="local", folder=tmp_path / "logs")
    local.update_parameters(timeout_min=10)
    folder = tmp_path / "study" / "run"
    job = Job(overrides=[], settings=Settings(), folder=folder)
    outcome = wait_for_outcome(job, local.submit(refusing, job.folder), patience_s=600.0)
    status = outcome.status
    assert status == "failed"
    record = read_record(job.folder)
    assert record is not None
    assert record["error_type"] == "ValueError"
    assert record["failure_transient"] is False
    traceback_path = job.folder / "traceback.txt"
    text = traceback_path.read_text()
    assert "no such thing" in text


def count(folder: Path, *, calls: str) -> None:
    with Path(calls).open("a") as stream:
        stream.write("computed\n")
    (folder / "n").write_text("1")


COUNTED = Stage("counted", count, lambda folder: int((folder / "n").read_text()))


class Requeued(SlurmLauncher):  # type: ignore[misc]
    """Submitted as a sweep submits its jobs; the first time its second stage takes longer than its
    limit."""

    def __call__(self, folder: Path) -> JobReturn:  # type: ignore[override]
        def work(run: Run) -> dict[str, float]:
            run_stages = RunStages(folder / "store", run)
            calls = str(folder / "calls")
            settings = {"calls": calls}
            run_stages.run_stage(COUNTED, settings)
            (begun := folder / "begun").open("a").write("begun\n")
            while begun.read_text().count("begun") == 1:
                time.sleep(0.05)
            return {"fit_test_percent": 50.0}

        returned = JobReturn(status=JobStatus.COMPLETED)
        run_path = folder / "study" / "run"
        returned.return_value = execute_run(run_path, {"seed": 1}, work)
        return returned


def test_a_job_past_its_time_limit_is_queued_again_and_finds_its_stages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal that Slurm sends before the limit ends the attempt, not the run."""
    parent = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", parent, prepend=os.pathsep)
    local = submitit.AutoExecutor(cluster="local", folder=tmp_path / "logs")
    local.update_parameters(timeout_min=10)
    local._executor.max_num_timeout = 1
    running = local.submit(Requeued(), tmp_path)
    begun = tmp_path / "begun"
    deadline = time.monotonic() + 60
    # There before it is written: the signal must find it counted.
    while not (begun.exists() and begun.read_text()):
        assert time.monotonic() < deadline, "the job never began"
        time.sleep(0.05)
    folder = tmp_path / "study" / "run"
    job = Job(overrides=[], settings=Settings(), folder=folder)
    pid = (read_record(job.folder) or {})["pid"]
    os.kill(pid, signal.SIGUSR2)
    outcome = wait_for_outcome(job, running, patience_s=600.0)
    status = outcome.status
    assert status == "ok"
    record = read_record(job.folder)
    assert record is not None
    assert record["status"] == "ok"
    assert record["attempt"] == 2
    assert record["stage_counted_reused"] is True
    text = (tmp_path / "calls").read_text()
    assert text.count("computed") == 1


class Unheard(submitit.Job):  # type: ignore[misc, name-defined]
    """A job cancelled while it waited, where Slurm keeps no accounts."""

    job_id = "1_3"
    state = "PENDING"

    def __init__(self) -> None:
        self._cancel_at_deletion = False
        slurm = submitit.slurm.slurm
        self.watcher = slurm.SlurmInfoWatcher()

    def done(self, force_check: bool = False) -> bool:
        del force_check
        return False


def test_a_job_that_slurm_has_forgotten_is_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sacct").write_text(
        "#!/bin/sh\necho 'JobID|State|NodeList'\necho '1_0|RUNNING|n1'\n"
    )
    (tmp_path / "sacct").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    folder = tmp_path / "study" / "never"
    job = Job(overrides=["seed=3"], settings=Settings(), folder=folder)
    wait_for_outcome(job, Unheard(), patience_s=0.0)
    record = read_record(job.folder)
    assert record is not None
    assert record["status"] == "failed"
    assert record["error_type"] == "Forgotten"
    assert record["failure_transient"] is True


def test_the_settings_go_where_submitit_wants_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "srun").touch(mode=0o755)
    (tmp_path / "sbatch").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    submitit_folder = str(tmp_path / "%j")
    params = {
        "submitit_folder": submitit_folder,
        "max_num_timeout": 0,
        "cpus_per_task": 2,
        "partition": "debug",
    }
    made = submitit_executor(
        params | {"array_parallelism": 3, "timeout_min": 9, "setup": ["export A=1"]}
    )
    parameters = made._executor.parameters
    expected = {
        "cpus_per_task": 2,
        "partition": "debug",
        "array_parallelism": 3,
        "time": 9,
        "setup": ["export A=1"],
    }
    assert parameters == expected
