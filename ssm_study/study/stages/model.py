"""Stage that identifies the model from the records, and stores the model as explicit numbers."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.durable import read_json
from ssm_study.engine.stages import Facts, Stage
from ssm_study.models.members import member_columns
from ssm_study.models.metrics import model_size_columns
from ssm_study.models.stored import model_from_json
from ssm_study.signals import DataSet
from ssm_study.study.stages.files import write_json
from ssm_study.training.metrics import training_columns

if TYPE_CHECKING:
    from ssm_study.models.spec import ModelSpec
    from ssm_study.training.training import Training


MEMBERS = "members.json"


@dataclass(frozen=True)
class TrainedModel:
    """Identified model, with the duration of its training in seconds and the reason why the
    training ended. `members` are the models whose mean predicts, empty for one model."""

    model: Any
    seconds: float
    ended: str
    baseline: dict[str, Any] | None = None
    chosen: str = ""
    members: tuple[Any, ...] = ()


def compute_model(
    folder: Path,
    data: DataSet,
    *,
    model: "ModelSpec",
    training: "Training",
    seed: int,
    progress: bool,
) -> None:
    """Train the model on the records and write its parameters as explicit numbers.

    A fit that left the finite is a gap in the curve: JSON has no infinity.
    """
    identified = training.identify(model, data, seed, folder, progress)
    write_json(folder / "model.json", identified.model.to_json())
    facts: dict[str, Any] = {"seconds": identified.seconds, "ended": identified.ended}
    if identified.chosen:
        facts["chosen"] = identified.chosen
    if data.metadata.get("source") == "recorded":
        from ssm_study.models.baseline_comparison import baseline_columns

        facts["baseline"] = baseline_columns(data)
    write_json(folder / "training.json", facts)
    write_json(folder / "training_curve.json", replace_nonfinite_by_none(identified.curve))
    if identified.members:
        write_json(folder / MEMBERS, [model.to_json() for model in identified.members])
    if identified.choice:
        write_json(folder / "choice.json", list(identified.choice))


def read_trained_model(folder: Path) -> TrainedModel:
    """Read the identified model, with the duration of its training and the reason why the training
    ended."""
    facts = read_json(folder / "training.json")
    return TrainedModel(read_model(folder), members=read_averaged_models(folder), **facts)


def training_result_columns(trained: TrainedModel, data: DataSet) -> Facts:
    """Table columns on a model's training: duration, reason for the end, model size, chosen
    settings, and the fit of a baseline."""
    facts = training_columns(trained.seconds, trained.ended) | model_size_columns(trained.model)
    if trained.chosen:
        facts["model_choice"] = trained.chosen
    return facts | member_columns(trained.members, data) | (trained.baseline or {})


def read_model(folder: Path) -> Any:
    """Read the identified model from its stored parameters, without torch."""
    return model_from_json(read_json(folder / "model.json"))


def read_averaged_models(folder: Path) -> tuple[Any, ...]:
    """Read the models whose mean output is the prediction; empty if a single model is used."""
    path = folder / MEMBERS
    return tuple(model_from_json(each) for each in read_json(path)) if path.exists() else ()


def replace_nonfinite_by_none(curve: list[dict[str, float]]) -> list[dict[str, float | None]]:
    """Copy of a training curve in which None replaces infinite and undefined values."""
    rows: list[dict[str, float | None]] = []
    for row in curve:
        rows.append({name: finite_or_none(value) for name, value in row.items()})
    return rows


def finite_or_none(value: float) -> float | None:
    """Given number, or None if the number is infinite or undefined."""
    return value if math.isfinite(value) else None


MODEL = Stage(
    "model",
    compute_model,
    read_trained_model,
    training_result_columns,
    ("training_curve.json", "choice.json", MEMBERS),
)
