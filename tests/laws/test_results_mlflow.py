"""A study in MLflow: every finished run once, numbers as metrics, settings as parameters."""

import builtins
from pathlib import Path
from typing import Any

import pytest

from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.table.mlflow import export_mlflow

RECORDS = (
    {
        "run": "a",
        "status": "ok",
        "order": 8,
        "fit_test_percent": 91.5,
        "controller_certified": True,
    },
    {"run": "b", "status": "failed", "error_message": "the solver gave up"},
    {"run": "c", "status": "running"},
)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for record in RECORDS:
        run = str(record["run"])
        folder = tmp_path / "study" / run
        folder.mkdir(parents=True)
        times = {
            "started_utc": "2026-11-21T01:00:00+00:00",
            "ended_utc": "2026-11-21T01:00:30+00:00",
        }
        write_record(folder, record | times)
    return tmp_path / "study"


def test_every_finished_run_is_written_once(study: Path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="the extra `mlflow` is not installed")
    expected = [2, 0]
    assert [export_mlflow(study), export_mlflow(study)] == expected
    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{study / 'mlflow.db'}")
    experiment_id = client.get_experiment_by_name("study").experiment_id
    runs = {run.info.run_name: run for run in client.search_runs([experiment_id])}
    expected = {"a", "b"}
    assert set(runs) == expected
    metrics = runs["a"].data.metrics
    fit_test_percent = metrics["fit_test_percent"]
    assert fit_test_percent == 91.5
    params = runs["a"].data.params
    order = params["order"]
    assert order == "8"
    metrics = runs["b"].data.metrics
    assert "fit_test_percent" not in metrics
    status = runs["a"].info.status
    assert status == "FINISHED"
    status = runs["b"].info.status
    assert status == "FAILED"
    end_time = runs["a"].info.end_time
    start_time = runs["a"].info.start_time
    difference = end_time - start_time
    assert difference == 30_000
    run_id = runs["a"].info.run_id
    files = client.list_artifacts(run_id)
    paths = [file.path for file in files]
    assert paths == ["record.json"]
    record = {"run": "c", "status": "ok"}
    write_record(study / "c", record)
    assert export_mlflow(study) == 1


def test_without_mlflow_it_says_what_to_install(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *arguments: Any, **options: Any) -> Any:
        if name.split(".")[0] == "mlflow":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(BadRequest, match=r"pip install 'ssm-study\[mlflow\]'"):
        export_mlflow(study)
