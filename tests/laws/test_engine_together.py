"""Runs whose models one program trains: dealt out over the processes, and none the worse when that program dies."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from test_engine_launcher import records, sweep

from ssm_study import members, study
from ssm_study.results.naming import register_resolver
from ssm_study.results.plan import PlannedStages, plan
from ssm_study.results.store import Store
from ssm_study.sweeps import groups
from ssm_study.sweeps.groups import Sharing, next_to_start, training_programs
from ssm_study.sweeps.sweep import Job

ROOT = Path(__file__).resolve().parents[2]


def programs(kinds: list[tuple[str, str] | None], at_once: int, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The names of the members of each program, for runs with these (kind, model key)."""
    shared = {f"run{i}": kind for i, kind in enumerate(kinds)}

    def hook(checked: str, _: object) -> Sharing | None:
        kind = shared[checked]
        return Sharing(*kind) if kind else None

    monkeypatch.setattr(groups, "task_hook", lambda *_: hook)
    jobs = [Job(overrides=[], config=OmegaConf.create(), folder=Path("/s") / name, checked=name) for name in shared]
    stages: Any = Store(Path("/nowhere"))
    made = training_programs(lambda _: None, jobs, stages, at_once)
    return [[member.name for member in program.members] for program in made]


def test_members_are_dealt_out_so_that_every_process_has_work(monkeypatch: pytest.MonkeyPatch) -> None:
    eight: list[tuple[str, str] | None] = [("a", f"{i}") for i in range(8)]
    assert [len(names) for names in programs(eight, 2, monkeypatch)] == [4, 4]
    assert [len(names) for names in programs(eight * 1, 1, monkeypatch)] == [8]
    twenty: list[tuple[str, str] | None] = [("a", f"{i}") for i in range(20)]
    assert [len(names) for names in programs(twenty, 2, monkeypatch)] == [7, 7, 6]
    assert programs(eight[:2], 2, monkeypatch) == [], "two processes train two models sooner apart"
    assert programs([("a", "0"), None, ("b", "1"), None], 1, monkeypatch) == []
    assert programs([("a", "0"), ("b", "1"), ("a", "2"), None], 1, monkeypatch) == [["run0", "run2"]]


def test_runs_of_one_model_are_one_member_and_wait_together(monkeypatch: pytest.MonkeyPatch) -> None:
    assert programs([("a", "0"), ("a", "0"), ("a", "0")], 1, monkeypatch) == []
    assert programs([("a", "0"), ("a", "1"), ("a", "0")], 1, monkeypatch) == [["run0", "run2", "run1"]]
    members = tuple(Job(overrides=[], config=OmegaConf.create(), folder=Path(name)) for name in ("a", "b"))
    program = Job(overrides=[], config=OmegaConf.create(), folder=Path("p"), members=members, models=2)
    free = Job(overrides=[], config=OmegaConf.create(), folder=Path("c"))
    waiting = [*members, program, free]
    assert next_to_start(waiting, []) is program
    assert next_to_start(waiting, [program]) is free
    assert next_to_start(waiting, [program]) is None
    assert next_to_start(waiting, []) is members[0]


@pytest.mark.parametrize(("ends", "limit"), [("well", "null"), ("killed", "null"), ("hangs", "4")])
def test_whatever_becomes_of_the_program_the_runs_are_done(ends: str, limit: str, tmp_path: Path) -> None:
    words = ["seed=range(5)", f"together={ends}", "hydra.launcher.n_jobs=2", f"hydra.launcher.timeout_s={limit}"]
    status, text = sweep(tmp_path, *words)
    assert status == 0, text
    assert [record["status"] for record in records(tmp_path)] == ["ok"] * 5
    told = sorted((tmp_path / "results" / "programs").read_text().splitlines())
    assert told == ["0 2 4", "1 3"], "two programs, each with every second member"
    ledger = (tmp_path / "results" / "ledger").read_text().split("\n")
    trained = [line for line in ledger if line.startswith("model")]
    assert len(trained) == len(set(trained)) == 5, "each model computed once"
    kept = (tmp_path / "results" / "study" / groups.FOLDER).exists()
    assert kept == (ends != "well"), "the log of a program stays if it failed"


def test_one_members_failure_is_left_to_its_own_run(capsys: pytest.CaptureFixture[str]) -> None:
    done: list[int] = []
    for number in (1, 0, 2):
        groups.attempt(lambda number=number: done.append(1 // number), f"member {number}")
    assert done == [1, 0]
    assert "member 0: left to its own run" in capsys.readouterr().err


def configured(results: Path, *words: str) -> DictConfig:
    register_resolver()
    short = ["experiment=smoke", "training.max_epochs=4", "data.validation_samples=300", f"results_dir={results}"]
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        return compose("study", overrides=[*short, *words])


def test_seeds_and_slope_bounds_share_other_settings_do_not(tmp_path: Path) -> None:
    stages = PlannedStages(Store(tmp_path / ".store"))
    members = (["seed=0"], ["seed=1"], ["seed=0", "model.slope_lower=0.1"])
    shared = [study.sharing(study.check(configured(tmp_path, *words)), stages) for words in members]
    assert len({one.kind for one in shared if one}) == 1
    assert len({one.key for one in shared if one}) == 3
    other = study.sharing(study.check(configured(tmp_path, "model.order=6")), stages)
    assert other is not None
    assert other.kind != (shared[0].kind if shared[0] else "")
    for alone in (["training/optimiser=adam"], ["data.samples=5000"], ["training.precision=32"]):
        assert study.sharing(study.check(configured(tmp_path, *alone)), stages) is None, alone
    lines = plan(Store(tmp_path), [], runs=8, finished=0, together=[4, 4]).lines()
    assert "trained together: 2 groups (4+4 models)" in lines
    assert not any("together" in line for line in plan(Store(tmp_path), [], runs=8, finished=0).lines())


def test_a_members_stage_holds_what_training_alone_gives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [["seed=0"], ["seed=1"], ["seed=2", "model.slope_lower=0.1"], ["seed=0", "synthesis.rate_controller=0.5"]]
    configs = [configured(tmp_path, *one) for one in words]
    study.train_members(configs)
    assert "left to its own run" not in capsys.readouterr().err
    numbers = []
    for config in configs[:3]:
        specification = study.check(config)
        assert study.sharing(specification, PlannedStages(Store(tmp_path / ".store"))) is None, "the model is there"
        stages = [Store(tmp_path / ".store"), Store(tmp_path / "alone")]
        found, alone = (study.model_stage(specification, s, study.dataset_stage(specification, s)) for s in stages)
        facts = study.read_json(found.result.path / "facts.json")
        assert found.result.reused
        assert found.result.seconds == facts["training_seconds"]
        numbers.append(facts["trained_together"])
        expected = study.read_json(alone.result.path / "facts.json")
        assert (facts["training_ended"], expected["trained_together"]) == (expected["training_ended"], 1)
        for matrix in "abc":
            mine, theirs = (getattr(one.value.linear, matrix) for one in (found, alone))
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)
    monkeypatch.setattr(members, "train_together", None)  # a second sweep's program finds them there
    study.train_members(configs)
    assert "left to its own run" not in capsys.readouterr().err
    assert max(numbers) > 1, "at least two of three seeds must have the same number of real modes"
