"""Result of an identification: the model, its validation fit, and columns on its training."""

from dataclasses import dataclass
from typing import Any

from ssm_study.columns import Column
from ssm_study.models.identified import Simulator
from ssm_study.models.metrics import Simulation
from ssm_study.signals import DataSet, Trajectories

NOT_REPEATED = "training is not repeated (see ssm-study reproduce)"

COLUMNS = (
    Column(
        "training_seconds",
        "Float64",
        "low",
        "train s",
        "Training time",
        "s",
        unchecked="depends on when it ran",
    ),
    Column("training_ended", "string", word="Training ended", unchecked=NOT_REPEATED),
    Column("model_choice", "string", word="Chosen by the log", unchecked=NOT_REPEATED),
)


@dataclass(frozen=True, kw_only=True)
class Identification:
    """Identified model with its validation fit and facts on how it was identified.

    The fit is recomputed from `model` itself (float64, `free_run`), never taken from training.
    `curve` holds one row per epoch: `epoch, seconds, fit_training_percent, fit_validation_percent`.
    `ended` says why training stopped. `choice` is the table of what was tried where sizes were
    chosen from the data, `chosen` the result in words; `refitted`: on training and validation
    records together. `members` are the models whose mean predicts, none for one model.
    """

    model: Simulator
    fit_validation_percent: float
    seconds: float
    curve: list[dict[str, float]]
    ended: str
    choice: tuple[dict[str, object], ...] = ()
    chosen: str = ""
    refitted: bool = False
    members: tuple[Simulator, ...] = ()

    @classmethod
    def from_model(cls, model: Simulator, data: DataSet, **how: Any) -> "Identification":
        """Identification result for a given model, with the fit to the validation records
        computed."""
        fit_validation_percent = records_fit_percent(model, data.validation, data)
        return cls(model=model, fit_validation_percent=fit_validation_percent, **how)


def records_fit_percent(model: Simulator, records: Trajectories, data: DataSet) -> float:
    """Fit of a model's free runs to several records, in percent."""
    simulation = Simulation.simulate_records(model, records, data.start_up_samples)
    return simulation.fit_percent


def training_columns(seconds: float, reason_of_end: str) -> dict[str, Any]:
    """Table columns on how long a training took and why it ended."""
    return {"training_seconds": seconds, "training_ended": reason_of_end}
