"""A run that cannot be exported says so in one sentence."""

import json
from pathlib import Path

import pytest
from report_runs import random_run

from ssm_study.export.targets import write_controller
from ssm_study.refusal import BadRequest

NO_MODEL = r"it has no model\.json; name the folder of a run"
BEYOND_FRONTIER = r"rate 0\.9 lies beyond the frontier 0\.2; export another"
INFEASIBLE_PART = {
    "theorem": "state_feedback",
    "alpha": 0.5,
    "beta": 0.4,
    "rate": 0.9,
    "rate_limit": 0.2,
    "seconds": 0.0,
}
INFEASIBLE_OUTCOME = {
    "proved": True,
    "feasible": False,
    "certified": False,
    "reason": "rate 0.9 lies beyond the frontier 0.2",
    "method": "frontier",
    "solver_status": "none",
}


def test_a_run_without_controller(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match=NO_MODEL):
        write_controller(tmp_path, tmp_path / "out")


def test_an_infeasible_run_gives_its_reason(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="linear", channels=1, seed=0)
    text = (run / "certificate.json").read_text()
    certificate = json.loads(text)
    certificate["state_feedback"] = INFEASIBLE_PART | INFEASIBLE_OUTCOME
    text = json.dumps(certificate)
    (run / "certificate.json").write_text(text)
    with pytest.raises(BadRequest, match=BEYOND_FRONTIER):
        write_controller(run, tmp_path / "out")


def test_a_file_in_the_way(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="linear", channels=1, seed=0)
    (tmp_path / "out").write_text("mine")
    with pytest.raises(BadRequest, match="is a file; name a folder"):
        write_controller(run, tmp_path / "out")
    text = (tmp_path / "out").read_text()
    assert text == "mine"


def test_a_certificate_of_another_model(tmp_path: Path) -> None:
    run = random_run(tmp_path / "run", kind="linear", channels=1, seed=0)
    text = (run / "model.json").read_text()
    model = json.loads(text)
    a = [[0.5]]
    b = [[1.0]]
    c = [[1.0]]
    model |= {"a": a, "b": b, "c": c}
    text = json.dumps(model)
    (run / "model.json").write_text(text)
    with pytest.raises(BadRequest, match="the model has order 1"):
        write_controller(run, tmp_path / "out")
