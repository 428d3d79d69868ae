"""The launcher against real processes: whatever one job does, the others are done and nothing lives
on."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ssm_study.engine.records import read_record
from ssm_study.table.gather import gather

PROGRAM = [sys.executable, str(Path(__file__).resolve().parents[1] / "engine_study.py"), "-m"]
REPOSITORY = Path(__file__).resolve().parents[2]


def environment(folder: Path, more: dict[str, str]) -> dict[str, str]:
    unwanted = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "MKL_NUM_THREADS")
    base = {name: value for name, value in os.environ.items() if name not in unwanted}
    path = os.pathsep.join([str(REPOSITORY), str(folder), os.environ.get("PYTHONPATH", "")])
    return base | {"PYTHONPATH": path, "HYDRA_FULL_ERROR": "1"} | more


def start(
    folder: Path, *words: str, into: Path | None = None, **more: str
) -> "subprocess.Popen[str]":
    command = [*PROGRAM, f"results_dir={folder / 'results'}", *words]
    command = (
        ["sh", "-c", 'echo $$ >"$0/cgroup.procs"; exec "$@"', str(into), *command]
        if into
        else command
    )
    env = environment(folder, more)
    return subprocess.Popen(
        command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def sweep(folder: Path, *words: str, **more: str) -> tuple[int, str]:
    process = start(folder, *words, **more)
    output, errors = process.communicate(timeout=120)
    return process.returncode, output + errors


def records(folder: Path) -> list[dict[str, Any]]:
    study_path = folder / "results" / "study"
    paths = sorted(study_path.glob("*/record.json"))
    found = [read_record(path.parent) for path in paths]
    return [record for record in found if record is not None]


def living(folder: Path) -> list[str]:
    """Processes that name the folder, or the sleep that only our jobs start."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            words = (
                (entry / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
                if entry.name.isdigit()
                else ""
            )
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0] if words else "Z"
        except OSError:
            continue
        if (
            state != "Z"
            and entry.name != str(os.getpid())
            and (str(folder) in words or "sleep 86399" in words)
        ):
            found.append(f"{entry.name} {words}")
    return found


def wait_for(condition: Any, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def nothing_lives_on(folder: Path) -> None:
    """Wait until no killed process lives: each dies in an instant, which can be seen on a busy
    machine."""
    wait_for(lambda: living(folder) == [], seconds=10)


BAD = {
    "raise": ("RuntimeError", "the bad job", False),
    "exit": ("SystemExit", "exited with status 3", False),
    "os_exit": ("ProcessExit", "ended with status 4", False),
    "kill": ("SIGKILL", "memory runs out", True),
    "terminate": ("SIGTERM", "stopped by SIGTERM", True),
    "realtime": ("signal 35", "stopped by signal 35", False),  # one that Python has no name for
    "interrupt": ("SIGINT", "stopped by SIGINT", True),
    "segfault": ("SIGSEGV", "a crash in native code", False),
    "memory": ("MemoryError", "MemoryError", True),
    "hang": ("Timeout", "timeout_s", False),
}


def test_the_failure_matrix(tmp_path: Path) -> None:
    """All misbehaviours in one sweep, among five good jobs and an infeasible one."""
    words = f"do={','.join([*BAD, 'infeasible', 'work'])}"
    assert sweep(tmp_path, words, "hydra.launcher.timeout_s=5")[0] == 0
    assert sweep(tmp_path, "do=work", "seed=1,2,3,4")[0] == 0
    by_label = {
        record.get("error_type"): record
        for record in records(tmp_path)
        if record["status"] == "failed"
    }
    bad = BAD.values()
    expected = {label for label, _, _ in bad}
    assert set(by_label) == expected
    for label, message, transient in BAD.values():
        record = by_label[label]
        assert message in record["error_message"]
        assert record["failure_transient"] is transient
        study_path = tmp_path / "results" / "study"
        traceback_path = study_path / record["run"] / "traceback.txt"
        text = traceback_path.read_text()
        assert text.strip()
    study = tmp_path / "results" / "study"
    status = gather(study)["status"]
    counts = status.value_counts().to_dict()
    expected = {"failed": len(BAD), "ok": 5, "infeasible": 1}
    assert counts == expected
    study_path = tmp_path / "results" / "study"
    run = by_label["SIGSEGV"]["run"]
    segfault = study_path / run / "traceback.txt"
    assert "in _segfault" in segfault.read_text()
    run = by_label["Timeout"]["run"]
    hang = study_path / run / "traceback.txt"
    assert "in _hang" in hang.read_text()
    nothing_lives_on(tmp_path)


MEMORY = {"/sys/fs/cgroup/memory": "memory.limit_in_bytes", "/sys/fs/cgroup": "memory.max"}


@pytest.fixture
def small_memory() -> Iterator[Path]:
    """A control group of 700 MB: enough for the sweep, not for a job that devours all it can
    get."""
    memory = MEMORY.items()
    found = [
        (Path(root) / f"ssm-study-{os.getpid()}", limit)
        for root, limit in memory
        if Path(root).is_dir()
    ]
    for group, limit in found:
        try:
            group.mkdir()
            (group / limit).write_text(f"{700 << 20}")
            yield group
            group.rmdir()
            return
        except OSError:
            continue
    pytest.skip("making a control group needs more rights")


def test_when_memory_runs_out_a_job_is_killed_and_neither_the_sweep_nor_another_job(
    tmp_path: Path, small_memory: Path
) -> None:
    """The kernel's own choice: the jobs have told it to prefer them."""
    process = start(tmp_path, "do=work,devour", "seed=0,1", into=small_memory, WORK_S="0.5")
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors + output
    by_status = {
        status: [r for r in records(tmp_path) if r["status"] == status]
        for status in ("ok", "failed")
    }
    expected = {"ok": 2, "failed": 2}
    assert {status: len(runs) for status, runs in by_status.items()} == expected
    for record in by_status["failed"]:
        assert record["error_type"] == "SIGKILL"
        assert record["failure_transient"] is True
        assert "memory runs out" in record["error_message"]
    nothing_lives_on(tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_sweep_that_is_stopped_leaves_no_process_and_is_finished_by_the_same_command(
    tmp_path: Path, number: int
) -> None:
    process = start(tmp_path, "do=wait,work")
    wait_for(lambda: any("sleep 86399" in line for line in living(tmp_path)))
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode != 0
    nothing_lives_on(tmp_path)
    # a process that is dying has no command line any more, and still its lock
    wait_for(
        lambda: "running" not in {record["status"] for record in records(tmp_path)}, seconds=10
    )
    before = {record["status"] for record in records(tmp_path)}
    assert {"lost"} <= before <= {"lost", "ok"}
    go_path = tmp_path / "results" / "go"
    go_path.touch()
    assert sweep(tmp_path, "do=wait,work")[0] == 0
    status = [record["status"] for record in records(tmp_path)]
    assert status == ["ok", "ok"]
    nothing_lives_on(tmp_path)


def test_a_sweep_computes_each_stage_once_and_repeats_nothing(tmp_path: Path) -> None:
    for _ in range(2):
        assert sweep(tmp_path, "seed=0,1", "rate=range(4)")[0] == 0
    ledger_path = tmp_path / "results" / "ledger"
    text = ledger_path.read_text()
    ledger = text.split("\n")[:-1]
    expected = len(set(ledger))
    assert len(ledger) == expected == 2 + 8
    attempts = {record["attempt"] for record in records(tmp_path)}
    assert attempts == {1}


def test_two_sweeps_at_once_do_everything_once(tmp_path: Path) -> None:
    both = [start(tmp_path, "seed=0,1", "rate=range(3)", WORK_S="0.1") for _ in range(2)]
    for process in both:
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    ledger_path = tmp_path / "results" / "ledger"
    text = ledger_path.read_text()
    ledger = text.split("\n")[:-1]
    expected = len(set(ledger))
    assert len(ledger) == expected == 2 + 6
    table = gather(tmp_path / "results" / "study")
    expected = ["ok"] * 6
    assert table["status"].to_list() == expected
    assert set(table["attempt"]) == {1}


def test_threads_times_jobs_stay_within_the_cores(tmp_path: Path) -> None:
    cores = len(os.sched_getaffinity(0))
    status, output = sweep(
        tmp_path, "seed=0,1", "hydra.launcher.n_jobs=2", f"hydra.launcher.threads={cores}"
    )
    assert status != 0
    assert "oversubscribed" in output
    assert records(tmp_path) == []
    status, output = sweep(tmp_path, "do=threads", WARM="torch")
    expected = (0, [1])
    assert (status, [record["threads_seen"] for record in records(tmp_path)]) == expected, output


def test_a_wrong_job_stops_the_sweep_before_any_starts(tmp_path: Path) -> None:
    status, output = sweep(tmp_path, "seed=0,1,-1")
    assert status != 0
    assert "BadRequest: seed (of the run" in output
    assert records(tmp_path) == []


def test_a_module_that_cannot_be_imported_for_the_jobs_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "halfway.py").write_text("raise RuntimeError('half edited')\n")
    status, output = sweep(tmp_path, "seed=0,1", WARM="halfway")
    assert status != 0
    lines = output.splitlines()
    assert "halfway.py:1: importing it for the jobs failed" in lines[-1]
    lines = output.splitlines()
    assert "RuntimeError: half edited" in lines[-1]
    assert "EOFError" not in output
    nothing_lives_on(tmp_path)


def test_failed_runs_wait_for_retry_and_are_then_the_only_ones(tmp_path: Path) -> None:
    assert sweep(tmp_path, "do=raise,work")[0] == 0
    assert sweep(tmp_path, "do=raise,work", "seed=0,1", "retry_failed=true")[0] == 0
    expected = [("failed", 2), ("ok", 1)]
    actual = sorted((record["status"], record["attempt"]) for record in records(tmp_path))
    assert actual == expected


def test_run_names_do_not_depend_on_the_launcher(tmp_path: Path) -> None:
    assert sweep(tmp_path, "seed=0,1")[0] == 0
    names = {record["run"] for record in records(tmp_path)}
    assert sweep(tmp_path, "seed=0,1", "study=basic", "hydra/launcher=basic")[0] == 0
    basic_path = tmp_path / "results" / "basic"
    paths = basic_path.glob("*/record.json")
    assert {path.parent.name for path in paths} == names


def test_a_plan_starts_nothing(tmp_path: Path) -> None:
    status, output = sweep(tmp_path, "seed=0,1", "rate=range(3)", "dry_run=true")
    assert status == 0
    assert records(tmp_path) == []
    paths = (tmp_path / "results").rglob("multirun.yaml")
    assert not list(paths)
    assert "6 runs: 0 finished, 6 to do" in output
    lines = output.splitlines()
    expected = [["data", "2", "0", "2"], ["model", "6", "0", "6"]]
    assert [line.split()[:4] for line in lines if line.startswith(("data", "model"))] == expected


JOBS = [
    ["seed=3"],
    ["seed=3", "model.order=6", "synthesis.rate_controller=0.5"],
    ["synthesis=riccati", "synthesis.rate_controller=0.5", "seed=1"],
    ["model.order=6", "synthesis=riccati", "synthesis.rate_controller=0.5"],
    ["+extra=1", "model.order=2", "study='a b'"],
    ["experiment=smoke", "data.samples=300"],
    ["experiment=smoke", "data.samples=400"],
    ["model._target_=os.system", "seed=${loop_seed}"],
]


def test_shared_compositions_are_hydras_own() -> None:
    """Every sweep of choices and values: the fast composition equals `load_sweep_config`, names
    included."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf, open_dict

    from ssm_study.engine.compose import Composer, set_hydra_config
    from ssm_study.engine.settings import plain_settings

    GlobalHydra.instance().clear()  # a run in this process may have left its own
    with initialize_config_dir(str(REPOSITORY / "conf"), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        sweep_config = loader.load_configuration("study", overrides=[], run_mode=RunMode.MULTIRUN)
        hydra_config = HydraConfig.instance()
        hydra_config.set_config(sweep_config)
        composer = Composer(loader, sweep_config, check_configuration=lambda _: None)
        hydras_own = [loader.load_sweep_config(sweep_config, overrides) for overrides in JOBS]
        for theirs in hydras_own:
            with open_dict(theirs):
                theirs.hydra.job.id = theirs.hydra.job.num = 0
        for overrides, theirs in [*zip(JOBS, hydras_own, strict=True)] * 2:
            set_hydra_config(theirs)
            settings = composer.compose_settings(overrides, 0)
            dict_config = composer.compose_configuration(overrides, 0)
            ours = OmegaConf.to_container(dict_config, resolve=False)
            assert ours == OmegaConf.to_container(theirs, resolve=False)
            set_hydra_config(theirs)
            expected = plain_settings(theirs)
            assert list(settings) == list(expected)
            assert settings == expected
        expected = len(JOBS) - 1
        assert len(composer.composed) == expected, "jobs of the same choices and names share one"
