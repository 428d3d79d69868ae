"""A finished study in MLflow: files first, the tracker afterwards, as often as one likes (extra `mlflow`)."""

from datetime import datetime
from pathlib import Path
from typing import Any

import pandas as pd

from ssm_study.refusal import BadRequest
from ssm_study.results.columns import BY_NAME
from ssm_study.results.durable import locked
from ssm_study.results.gather import gather
from ssm_study.results.records import FAILED, FINAL

RUN_TAG = "ssm_study.run"
ARTEFACTS = ("record.json", "model.json", "certificate.json", "traceback.txt")
AT_ONCE = 100  # parameters MLflow takes in one call


def export_mlflow(study: Path, store: str | None = None) -> int:
    """Write the finished runs of `study` that are not there yet into the MLflow store; returns how many were written.

    `store` is a tracking address, by default `sqlite:///STUDY/mlflow.db`. Numbers with a better direction become
    metrics, everything else parameters. Raises `BadRequest` where MLflow is not installed.
    """
    try:
        from mlflow import MlflowClient
    except ImportError:
        raise BadRequest("export-mlflow", study, "MLflow is not installed", "pip install 'ssm-study[mlflow]'") from None
    table = gather(study)
    with locked(study / ".mlflow.lock"):  # two processes on a new database crash in its migration
        client = MlflowClient(tracking_uri=store or f"sqlite:///{study.absolute() / 'mlflow.db'}")
        experiment = _experiment(client, study)
        there = _exported(client, experiment)
        rows = [row for _, row in table.iterrows() if row["status"] in FINAL and row["run"] not in there]
        for row in rows:
            _write(client, experiment, study, {str(name): value for name, value in row.dropna().items()})
    return len(rows)


def _experiment(client: Any, study: Path) -> str:
    name = study.resolve().name
    found = client.get_experiment_by_name(name)
    if found is not None:
        return str(found.experiment_id)
    return str(client.create_experiment(name, artifact_location=(study.absolute() / ".mlflow").as_uri()))


def _exported(client: Any, experiment: str) -> set[str]:
    names: set[str] = set()
    token = None
    while True:
        page = client.search_runs([experiment], max_results=1000, page_token=token)
        names |= {run.data.tags[RUN_TAG] for run in page if run.info.status != "RUNNING" and RUN_TAG in run.data.tags}
        token = page.token
        if not token:
            return names


def _write(client: Any, experiment: str, study: Path, row: dict[str, Any]) -> None:
    from mlflow.entities import Metric, Param

    run = client.create_run(experiment, start_time=_milliseconds(row.get("started_utc")), run_name=row["run"])
    end = _milliseconds(row.get("ended_utc"))
    metrics = {name: float(value) for name, value in row.items() if _is_metric(name)}
    parameters = {name: str(value)[:500] for name, value in row.items() if not _is_metric(name)}
    client.log_batch(run.info.run_id, metrics=[Metric(name, value, end or 0, 0) for name, value in metrics.items()])
    items = [Param(name, value) for name, value in parameters.items()]
    for start in range(0, len(items), AT_ONCE):
        client.log_batch(run.info.run_id, params=items[start : start + AT_ONCE])
    for name in ARTEFACTS:
        if (study / row["run"] / name).is_file():
            client.log_artifact(run.info.run_id, str(study / row["run"] / name))
    client.set_tag(run.info.run_id, RUN_TAG, row["run"])  # last: a run without it was not written to its end
    client.set_terminated(run.info.run_id, "FAILED" if row["status"] == FAILED else "FINISHED", end)


def _is_metric(name: str) -> bool:
    column = BY_NAME.get(name)
    return column is not None and bool(column.better) and column.kind in ("Float64", "Int64", "boolean")


def _milliseconds(moment: Any) -> int | None:
    return None if moment is None or pd.isna(moment) else int(datetime.fromisoformat(moment).timestamp() * 1000)
