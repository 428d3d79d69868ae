"""The engine knows no science: the program of docs/engine.md is a sweep with stages, resuming,
failures and a table."""

import os
import re
import subprocess
import sys
from collections.abc import Set
from pathlib import Path

import pytest
from engine_study import Badly

from ssm_study.engine import fingerprint as code
from ssm_study.engine.jobs import Job
from ssm_study.engine.launcher import preload_for_jobs
from ssm_study.engine.records import read_record
from ssm_study.engine.settings import Settings
from ssm_study.engine.store import Store
from ssm_study.study.preload import modules_to_preload
from ssm_study.table.gather import gather

ROOT = Path(__file__).resolve().parents[2]
ENGINE_PAGE = ROOT / "docs" / "engine.md"
PAGE = ENGINE_PAGE.read_text()
PROGRAMS = re.findall(r'```python title="dice.py"\n(.*?)```', PAGE, re.DOTALL)
PROGRAM = PROGRAMS[0]
FOREIGN = (
    "torch",
    "lightning",
    "cvxpy",
    "scipy",
    "ssm_study.signals",
    "ssm_study.study",
    "ssm_study.plants",
)
WATCHED = PROGRAM + f"    import sys\n    assert not set(sys.modules) & set({FOREIGN})\n"


def dice(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "dice.py", "-m", *words]
    variables = {"PYTHONPATH": str(ROOT), "HYDRA_FULL_ERROR": "1"}
    environment = os.environ | variables
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "dice.py").write_text(WATCHED)
    return tmp_path


def test_a_sweep_is_run_resumed_and_gathered(folder: Path) -> None:
    first_sweep = dice(folder, "seed=0,1", "sides=6")
    returncode = first_sweep.returncode
    assert returncode == 0
    planned = dice(folder, "seed=0,1,2", "sides=6", "dry_run=true")
    assert "3 runs: 2 finished, 1 to do" in planned.stdout, planned.stderr
    second_sweep = dice(folder, "seed=0,1,2", "sides=6")
    returncode = second_sweep.returncode
    assert returncode == 0
    table = gather(folder / "results" / "study")
    expected = ["ok"] * 3
    statuses = table["status"].to_list()
    assert statuses == expected
    expected = [1] * 3
    attempts = table["attempt"].to_list()
    assert attempts == expected
    is_a_mean = table["mean"].between(1, 6).all()
    assert is_a_mean


def test_a_failure_is_a_row_and_a_wrong_request_starts_nothing(folder: Path) -> None:
    refused = dice(folder, "sides=6,-1")
    assert "sides (of the run sides=-1) = -1: a die has sides" in refused.stderr
    study_path = folder / "results" / "study"
    assert not study_path.exists()
    watched = WATCHED.replace("random.Random(seed + i)", "random.Random(1 // seed)")
    (folder / "dice.py").write_text(watched)
    sweep = dice(folder, "seed=0,1", "sides=6")
    returncode = sweep.returncode
    assert returncode == 0
    record_paths = study_path.glob("*/record.json")
    paths = sorted(record_paths)
    records = [read_record(path.parent) for path in paths]
    expected = ["failed", "ok"]
    statuses = sorted((r or {})["status"] for r in records)
    assert statuses == expected
    (folder / "dice.py").write_text(WATCHED)
    sweep_again = dice(folder, "seed=0,1", "sides=6", "retry_failed=true")
    returncode = sweep_again.returncode
    assert returncode == 0
    study = folder / "results" / "study"
    status = gather(study)["status"]
    expected = ["ok", "ok"]
    assert status.to_list() == expected


def test_a_job_finds_the_versions_of_the_code_that_its_server_has_read(tmp_path: Path) -> None:
    """Read by every job for itself they were three quarters of what the engine costs a run."""
    settings = Settings(seed=1, do="work", rate=1, study="s", run="r", results_dir=str(tmp_path))
    task = Badly()
    r_path = tmp_path / "s" / "r"
    job = Job(overrides=[], settings=settings, folder=r_path)
    code.code_version.cache_clear()
    preload_for_jobs(task, [job])
    cache_before = code.code_version.cache_info()
    read = cache_before.misses
    stages = Store(tmp_path / ".store")
    task.run_stages(settings, stages)
    cache_after = code.code_version.cache_info()
    misses = cache_after.misses
    assert misses == read > 0


def test_what_several_jobs_compute_is_imported_for_all_of_them(tmp_path: Path) -> None:
    """Two jobs on one model: its training is one job's own matter, unlike the data of two seeds."""
    preloaded = []

    class Asked(Badly):
        def preload_modules(self, stages_to_compute: Set[str]) -> None:
            preloaded.append(stages_to_compute)

    def job(run: str, seed: int, rate: int) -> Job:
        made = Settings(
            seed=seed, do="work", rate=rate, study="s", run=run, results_dir=str(tmp_path)
        )
        job_folder = tmp_path / "s" / run
        return Job(overrides=[], settings=made, folder=job_folder)

    job_a = job("a", 1, 1)
    job_b = job("b", 1, 2)
    preload_for_jobs(Asked(), [job_a, job_b])
    job_c = job("c", 2, 1)
    preload_for_jobs(Asked(), [job_a, job_c])
    first = job("a", 1, 1)
    stages = Store(tmp_path / ".store")
    Asked().run_stages(first.settings, stages)
    preload_for_jobs(Asked(), [first, job("c", 2, 1)])
    both = {"data", "model"}
    expected = [{"model"}, both, set()]
    assert preloaded == expected


def test_a_sweep_that_trains_nothing_imports_nothing_that_trains() -> None:
    program = (
        "import sys; from ssm_study.study.preload import preload_modules; preload_modules(set()); "
    )
    program += "print({'cvxpy', 'torch', 'lightning'} & set(sys.modules))"
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert ended.stdout.strip() == "set()"


IMPORTED = [(set(), 0, 0), ({"synthesis"}, 1, 0), ({"model"}, 0, 1)]


@pytest.mark.parametrize(("again", "solver", "trainer"), IMPORTED)
def test_what_solves_and_what_trains_is_imported_where_several_jobs_do(
    again: set[str], solver: int, trainer: int
) -> None:
    modules = list(modules_to_preload(again))
    actual = modules.count("ssm_study.synthesis.lmi")
    assert actual == solver
    assert modules.count("ssm_study.training.fit") == trainer
    assert modules.count("ssm_study.loop.rollout") == 1
