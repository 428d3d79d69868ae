"""What identifying a model leaves behind: the model, and the evidence that it fits."""

from dataclasses import dataclass

import numpy as np

from ssm_study.models.free_run import free_run
from ssm_study.models.identified import Simulator
from ssm_study.signals import DataSet, Trajectory, fit_percent


@dataclass(frozen=True, kw_only=True)
class Identification:
    """An identified model, the fits its stored numbers reproduce, and how they were reached.

    Fits are recomputed from `model` itself (float64, `free_run`), never taken from training. `curve` holds one
    row per epoch: `epoch, seconds, fit_training_percent, fit_validation_percent`. `ended` says why training stopped.
    `trained_together` is the number of trainings that shared the program; `seconds` is then this one's share.
    """

    model: Simulator
    fit_training_percent: float
    fit_validation_percent: float
    seconds: float
    curve: list[dict[str, float]]
    ended: str
    trained_together: int = 1


def mean_fit(model: Simulator, records: tuple[Trajectory, ...], data: DataSet) -> float:
    """Fit over all records taken as one, after each record's start-up samples, percent."""
    simulated = [free_run(model, record, data.start_up_samples)[data.start_up_samples :] for record in records]
    measured = [record.y[data.start_up_samples :] for record in records]
    return fit_percent(np.concatenate(measured), np.concatenate(simulated))
