"""`verify` against lies about the form of a run: links, versions, kinds, errors, marks, bands."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssm_study.cli.main import main
from ssm_study.columns import Column
from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.study.form import has_declared_type
from ssm_study.study.verify import verify

Lie = Callable[[Path, dict[str, Any]], None]


def make_run(folder: Path, store: Path, *words: str) -> Path:
    (folder / ".store").symlink_to(store)
    place = [f"results_dir={folder}", "study=honest", "progress=false"]
    assert main(["run", "experiment=smoke", *words, *place]) == 0
    paths = (folder / "honest").glob("*/record.json")
    return next(path.parent for path in paths)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory, smoke_store: Path, made_once: None) -> Path:
    del made_once
    folder = tmp_path_factory.mktemp("results")
    return make_run(folder, smoke_store, "synthesis=riccati")


def wrong_claims(run: Path) -> set[str]:
    return {finding.claim for finding in verify(run) if not finding.holds}


def told(lie: Lie, run: Path, folder: Path) -> set[str]:
    """The claims that fail once a copy of the run has been altered and sealed anew."""
    copy = folder / "honest" / run.name
    shutil.copytree(run, copy)
    record = dict(read_record(copy) or {})
    lie(copy, record)
    write_run_manifest(copy)
    write_record(copy, record)
    return wrong_claims(copy)


def link_model(run: Path, _: dict[str, Any]) -> None:
    elsewhere = run.parents[1] / "model.json"
    (run / "model.json").rename(elsewhere)
    (run / "model.json").symlink_to(elsewhere)


def mark_model(run: Path, _: dict[str, Any]) -> None:
    model = (run / "model.json").read_text()
    (run / "model.json").write_text(model, encoding="utf-8-sig")


def shift_band(run: Path, _: dict[str, Any]) -> None:
    path = run / "closed_loop_model.mcap"
    groups, about = read_mcap(path)
    metadata = dict(about) | {"settling_band": "100.0"}
    write_mcap(path, tuple(groups), metadata)


def set_column(name: str, value: Any) -> Lie:
    return lambda _, record: record.update({name: value})


LIES: dict[str, tuple[Lie, str]] = {}


def add_lie_about_column(case: str, name: str, value: Any, claim: str = "") -> None:
    """Add the lie that a column has this value."""
    LIES[case] = (set_column(name, value), claim or name)


LIES["a link out of the folder"] = (link_model, "model.json")
LIES["a byte order mark"] = (mark_model, "model.json")
LIES["the band of the model's loop"] = (shift_band, "closed_loop_model.mcap settling_band")
add_lie_about_column("an error's message", "error_message", "x")
add_lie_about_column("an error's type", "error_type", "x")
add_lie_about_column("whether an error is transient", "failure_transient", False)
add_lie_about_column("a number as text", "seconds", "1.0", "seconds kind")
add_lie_about_column("a truth value as number", "git_dirty", 1, "git_dirty kind")
add_lie_about_column("a number as truth value", "pid", True, "pid kind")
add_lie_about_column("a fit before no reduction", "fit_test_before_reduction_percent", 12.0)


@pytest.mark.parametrize("case", LIES)
def test_a_lie_about_the_form_is_named(case: str, honest: Path, tmp_path: Path) -> None:
    lie, claim = LIES[case]
    assert claim in told(lie, honest, tmp_path)


def test_the_unaltered_run_is_accepted(honest: Path, tmp_path: Path) -> None:
    assert told(lambda *_: None, honest, tmp_path) == set()
    text = (honest / "record.json").read_text()
    content = json.loads(text)
    record_version = content["record_version"]
    assert record_version == 3


def test_an_infeasible_design_with_an_internal_model_is_accepted(
    tmp_path: Path, smoke_store: Path
) -> None:
    """It was accused: its limit is that of the model with the internal model."""
    run = make_run(
        tmp_path, smoke_store, "synthesis=auto_integral", "synthesis.rate_controller=0.58"
    )
    status = (read_record(run) or {})["status"]
    assert status == "infeasible"
    assert wrong_claims(run) == set()
    text = (run / "certificate.json").read_text()
    certificate = json.loads(text)
    certificate["state_feedback"]["reason"] = "proved for every plant\n" * 30
    text = json.dumps(certificate)
    (run / "certificate.json").write_text(text)
    assert "certificate.state_feedback reason" in wrong_claims(run)


KINDS = [
    ("Float64", 1.0, True),
    ("Float64", 1, True),
    ("Float64", "inf", True),
    ("Float64", None, True),
    ("Float64", "1.0", False),
    ("Float64", True, False),
    ("Int64", 1, True),
    ("Int64", 1.0, False),
    ("boolean", True, True),
    ("boolean", 0, False),
    ("string", "a", True),
    ("string", 1, False),
]


@pytest.mark.parametrize(("kind", "value", "expected"), KINDS)
def test_kinds_of_columns(kind: Any, value: Any, expected: bool) -> None:
    column = Column("x", kind)
    assert has_declared_type(column, value) is expected
