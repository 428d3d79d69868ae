"""Export of a finished study to MLflow (optional package `mlflow`).

Files come first, the tracker afterwards, as often as one likes.
"""

from datetime import datetime
from pathlib import Path
from typing import Any

from ssm_study.durable import file_lock
from ssm_study.engine.records import FAILED, FINAL
from ssm_study.refusal import BadRequest
from ssm_study.table.columns import BY_NAME
from ssm_study.table.gather import gather

RUN_TAG = "ssm_study.run"
ARTEFACTS = ("record.json", "model.json", "certificate.json", "traceback.txt")
AT_ONCE = 100  # parameters MLflow takes in one call
MOST = 50_000  # runs MLflow gives in one call


def export_mlflow(study: Path, store: str | None = None) -> int:
    """Write the finished runs of a study into an MLflow store, except runs that are already stored.

    Returns how many were written. `store` is a tracking address, by default
    `sqlite:///STUDY/mlflow.db`. Numbers with a better direction become metrics, everything else
    parameters. Raises `BadRequest` where MLflow is not installed.
    """
    try:
        from mlflow import MlflowClient
    except ImportError:
        remedy = "pip install 'ssm-study[mlflow]'"
        raise BadRequest("export-mlflow", study, "MLflow is not installed", remedy) from None
    address = store or f"sqlite:///{study.absolute() / 'mlflow.db'}"
    table = gather(study)  # the files are the truth, the tracker a copy
    with file_lock(
        study / ".mlflow.lock"
    ):  # two processes on a new database crash in its migration
        client = MlflowClient(tracking_uri=address)
        experiment = _experiment_id(client, study)
        runs = client.search_runs([experiment], max_results=MOST)
        written = {run.data.tags.get(RUN_TAG) for run in runs if run.info.status != "RUNNING"}
        finished = [row for _, row in table.iterrows() if row["status"] in FINAL]
        missing = [row for row in finished if row["run"] not in written]
        for row in missing:
            filled = row.dropna()
            values = {str(name): value for name, value in filled.items()}
            _write_run(client, experiment, study, values)
    return len(missing)


def _experiment_id(client: Any, study: Path) -> str:
    """Identifier of a study's experiment in MLflow, which is created if it does not exist."""
    name = study.resolve().name
    experiment = client.get_experiment_by_name(name)
    if experiment:
        return str(experiment.experiment_id)
    artefact_folder = study.absolute() / ".mlflow"
    artefacts = artefact_folder.as_uri()
    return str(client.create_experiment(name, artefacts))


def _write_run(client: Any, experiment: str, study: Path, row: dict[str, Any]) -> None:
    """Write one run of a study to MLflow: its metrics, parameters and files."""
    from mlflow.entities import Metric, Param

    start = _milliseconds_since_1970(row.get("started_utc"))
    end = _milliseconds_since_1970(row.get("ended_utc"))
    run = client.create_run(experiment, start_time=start, run_name=row["run"])
    number = run.info.run_id
    scored = [name for name in row if _is_metric(name)]
    metrics = [Metric(name, float(row[name]), end or 0, 0) for name in scored]
    client.log_batch(number, metrics=metrics)
    parameter_names = [name for name in row if name not in scored]
    parameters = [Param(name, str(row[name])[:500]) for name in parameter_names]
    parameter_count = len(parameters)
    for first in range(0, parameter_count, AT_ONCE):
        params = parameters[first : first + AT_ONCE]
        client.log_batch(number, params=params)
    for name in ARTEFACTS:
        artefact = study / row["run"] / name
        if artefact.is_file():
            client.log_artifact(number, str(artefact))
    # Last: a run without it was not written to its end.
    client.set_tag(number, RUN_TAG, row["run"])
    status = "FAILED" if row["status"] == FAILED else "FINISHED"
    client.set_terminated(number, status, end)


def _is_metric(name: str) -> bool:
    """Whether a table column holds numbers whose larger, or smaller, values are better."""
    column = BY_NAME.get(name)
    return column is not None and bool(column.better) and column.kind != "string"


def _milliseconds_since_1970(time: str | None) -> int | None:
    """Milliseconds since 1970 of a time in ISO format; None if there is no time."""
    if not time:
        return None
    moment = datetime.fromisoformat(time)
    seconds = moment.timestamp()
    return int(seconds * 1000)
