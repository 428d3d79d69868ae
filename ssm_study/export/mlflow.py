"""A finished study in MLflow: files first, the tracker afterwards, as often as one likes (extra
`mlflow`)."""

from datetime import datetime
from pathlib import Path
from typing import Any

from ssm_study.engine.durable import locked
from ssm_study.engine.records import FAILED, FINAL
from ssm_study.refusal import BadRequest
from ssm_study.table.columns import BY_NAME
from ssm_study.table.gather import gather

RUN_TAG = "ssm_study.run"
ARTEFACTS = ("record.json", "model.json", "certificate.json", "traceback.txt")
AT_ONCE = 100  # parameters MLflow takes in one call
MOST = 50_000  # runs MLflow gives in one call


def export_mlflow(study: Path, store: str | None = None) -> int:
    """Write the finished runs of `study` that are not there yet into the MLflow store; returns how
    many were written.

    `store` is a tracking address, by default `sqlite:///STUDY/mlflow.db`. Numbers with a better
    direction become
    metrics, everything else parameters. Raises `BadRequest` where MLflow is not installed.
    """
    try:
        from mlflow import MlflowClient
    except ImportError:
        raise BadRequest(
            "export-mlflow", study, "MLflow is not installed", "pip install 'ssm-study[mlflow]'"
        ) from None
    table = gather(study)  # the files are the truth, the tracker a copy
    with locked(study / ".mlflow.lock"):  # two processes on a new database crash in its migration
        client = MlflowClient(tracking_uri=store or f"sqlite:///{study.absolute() / 'mlflow.db'}")
        found, artefacts = (
            client.get_experiment_by_name(study.resolve().name),
            (study.absolute() / ".mlflow").as_uri(),
        )
        experiment = (
            found.experiment_id
            if found
            else client.create_experiment(study.resolve().name, artefacts)
        )
        runs = client.search_runs([experiment], max_results=MOST)
        there = {run.data.tags.get(RUN_TAG) for run in runs if run.info.status != "RUNNING"}
        rows = [
            row for _, row in table.iterrows() if row["status"] in FINAL and row["run"] not in there
        ]
        for row in rows:
            _write(
                client,
                experiment,
                study,
                {str(name): value for name, value in row.dropna().items()},
            )
    return len(rows)


def _write(client: Any, experiment: str, study: Path, row: dict[str, Any]) -> None:
    from mlflow.entities import Metric, Param

    times = (row.get(name) for name in ("started_utc", "ended_utc"))
    # Milliseconds.
    start, end = (time and int(datetime.fromisoformat(time).timestamp() * 1000) for time in times)
    run = client.create_run(experiment, start_time=start, run_name=row["run"])
    scored = [
        name
        for name in row
        if name in BY_NAME and BY_NAME[name].better and BY_NAME[name].kind != "string"
    ]
    client.log_batch(
        run.info.run_id, metrics=[Metric(name, float(row[name]), end or 0, 0) for name in scored]
    )
    parameters = [
        Param(name, str(value)[:500]) for name, value in row.items() if name not in scored
    ]
    for first in range(0, len(parameters), AT_ONCE):
        client.log_batch(run.info.run_id, params=parameters[first : first + AT_ONCE])
    for name in ARTEFACTS:
        if (study / row["run"] / name).is_file():
            client.log_artifact(run.info.run_id, str(study / row["run"] / name))
    # Last: a run without it was not written to its end.
    client.set_tag(run.info.run_id, RUN_TAG, row["run"])
    client.set_terminated(run.info.run_id, "FAILED" if row["status"] == FAILED else "FINISHED", end)
