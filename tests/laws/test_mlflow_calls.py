"""Calls that write runs to MLflow, seen by a client in memory: no tracker need be installed."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from ssm_study.engine.records import write_record
from ssm_study.table import mlflow as module
from ssm_study.table.mlflow import export_mlflow


@dataclass
class StoredRun:
    """A run as the tracker holds it."""

    name: str
    start_time: int | None
    status: str = "RUNNING"
    end_time: int | None = None
    metrics: dict[str, float] = field(default_factory=dict)
    params: dict[str, str] = field(default_factory=dict)
    batches: list[int] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    @property
    def info(self) -> SimpleNamespace:
        return SimpleNamespace(run_id=self.name, status=self.status)

    @property
    def data(self) -> SimpleNamespace:
        return SimpleNamespace(tags=self.tags)


class Client:
    """Client of a tracker that holds everything in memory."""

    stored: ClassVar[dict[str, StoredRun]] = {}
    experiments: ClassVar[dict[str, str]] = {}
    addresses: ClassVar[list[str]] = []

    def __init__(self, tracking_uri: str) -> None:
        self.addresses.append(tracking_uri)

    def get_experiment_by_name(self, name: str) -> SimpleNamespace | None:
        return SimpleNamespace(experiment_id=name) if name in self.experiments else None

    def create_experiment(self, name: str, artefacts: str) -> str:
        assert name not in self.experiments
        self.experiments[name] = artefacts
        return name

    def search_runs(self, experiments: list[str], max_results: int) -> list[StoredRun]:
        assert experiments == ["study"]
        assert max_results == 50_000
        return list(self.stored.values())

    def create_run(self, experiment: str, start_time: int | None, run_name: str) -> StoredRun:
        assert experiment == "study"
        self.stored[run_name] = StoredRun(run_name, start_time)
        return self.stored[run_name]

    def log_batch(self, run: str, metrics: Any = (), params: Any = ()) -> None:
        self.stored[run].metrics |= {name: value for name, value, *_ in metrics}
        self.stored[run].params |= dict(params)
        if params:
            self.stored[run].batches.append(len(params))

    def log_artifact(self, run: str, path: str) -> None:
        self.stored[run].files.append(Path(path).name)

    def set_tag(self, run: str, name: str, value: str) -> None:
        self.stored[run].tags[name] = value

    def set_terminated(self, run: str, status: str, end_time: int | None) -> None:
        self.stored[run].status = status
        self.stored[run].end_time = end_time


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[Client]:
    package = ModuleType("mlflow")
    entities = ModuleType("mlflow.entities")
    package.__dict__["MlflowClient"] = Client
    entities.__dict__["Metric"] = lambda *words: words
    entities.__dict__["Param"] = lambda *words: words
    monkeypatch.setitem(sys.modules, "mlflow", package)
    monkeypatch.setitem(sys.modules, "mlflow.entities", entities)
    for name, empty in (("stored", {}), ("experiments", {}), ("addresses", [])):
        monkeypatch.setattr(Client, name, empty)
    return Client


RECORDS: list[dict[str, object]] = [
    {
        "run": "a",
        "status": "ok",
        "order": 8,
        "fit_test_percent": 91.5,
        "controller_certified": True,
        "predicted_stable": None,
        "started_utc": "2026-11-21T01:00:00+00:00",
        "ended_utc": "2026-11-21T01:00:30.5+00:00",
        "note": "n" * 600,
    },
    {"run": "b", "status": "failed", "error_message": "the solver gave up"},
    {"run": "c", "status": "running"},
    {"run": "d", "status": "infeasible"},
]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    folder = tmp_path / "study"
    for record in RECORDS:
        run = folder / str(record["run"])
        run.mkdir(parents=True)
        write_record(run, record)
    (folder / "a" / "model.json").touch()
    return folder


def test_finished_runs_are_written_with_their_times_and_files(
    study: Path, client: type[Client]
) -> None:
    assert export_mlflow(study) == 3
    assert client.addresses == [f"sqlite:///{study / 'mlflow.db'}"]
    expected = {"study": (study / ".mlflow").as_uri()}
    assert client.experiments == expected
    runs = client.stored
    statuses = {name: run.status for name, run in runs.items()}
    expected = {"a": "FINISHED", "b": "FAILED", "d": "FINISHED"}
    assert statuses == expected
    first = runs["a"]
    assert first.start_time == 1795222800000
    assert first.end_time == first.start_time + 30500
    assert runs["b"].end_time is None
    expected = {"fit_test_percent": 91.5, "controller_certified": 1.0}
    assert first.metrics == expected
    assert first.params["order"] == "8"
    expected = "n" * 500
    actual = first.params["note"]
    assert actual == expected
    assert first.params.keys().isdisjoint(first.metrics)
    assert "predicted_stable" not in first.params
    assert first.files == ["record.json", "model.json"]
    assert first.tags == {"ssm_study.run": "a"}


def test_a_run_that_was_not_written_to_its_end_is_written_again(
    study: Path, client: type[Client]
) -> None:
    export_mlflow(study)
    assert export_mlflow(study) == 0
    client.stored["a"].status = "RUNNING"
    actual = export_mlflow(study, "http://tracker")
    assert actual == 1
    assert client.addresses[-1] == "http://tracker"


def test_parameters_go_in_parts_that_the_tracker_takes(
    study: Path, client: type[Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AT_ONCE", 3)
    export_mlflow(study)
    batches = client.stored["a"].batches
    names = set(batches[:-1])
    assert names == {3}
    assert 0 < batches[-1] <= 3
    expected = len(client.stored["a"].params)
    assert sum(batches) == expected
