"""Stage that simulates the model on the validation and test records, and scores the simulations."""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.data.metrics import benchmark_rmse
from ssm_study.engine.stages import Facts, Stage
from ssm_study.models.metrics import Simulation, fit_columns
from ssm_study.models.warm_start import initial_state_columns, simulate_validation_and_test
from ssm_study.signals import DataSet
from ssm_study.study.recordings import initial_states_to_text, read_free_runs, write_records
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.model import TrainedModel, read_model
from ssm_study.training.metrics import records_fit_percent

if TYPE_CHECKING:
    from ssm_study.bounds.reduction import Reduction

SIMULATED = ("model.json", "validation.mcap", "test.mcap")


class ModelRun:
    """Identified model with its free runs on the validation and test records, each read when it is
    first needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def model(self) -> Any:
        """Identified model of a run, read from its file."""
        return read_model(self.folder)

    @cached_property
    def validation(self) -> Simulation:
        """Free run of the model on the validation records, with the measured outputs."""
        return read_free_runs(self.folder / "validation.mcap")

    @cached_property
    def test(self) -> Simulation:
        """Free run of the model on the test records, with the measured outputs."""
        return read_free_runs(self.folder / "test.mcap")


def compute_free_runs(
    folder: Path, data: DataSet, trained: TrainedModel, *, reduction: "Reduction | None" = None
) -> None:
    """Simulate the identified model on the validation and test records, and write both free runs.

    In balanced coordinates it is what is certified; a baseline has no `reduction`, and nothing is
    claimed of it.
    """
    model = trained.model if reduction is None else reduction.reduce_model(trained.model)
    write_json(folder / "model.json", model.to_json())
    validation, test = simulate_validation_and_test(model, data)
    for name, run in (("validation", validation), ("test", test)):
        about: dict[str, Any] = {"start_up_samples": str(data.start_up_samples)}
        if any(state is not None for state in run.starts):
            about["start_states"] = initial_states_to_text(run.starts)
        path = folder / f"{name}.mcap"
        write_records(path, data, run.records, simulated=run.simulated, **about)


def free_run_columns(model_run: ModelRun, data: DataSet, _: TrainedModel) -> Facts:
    """Table columns on the free runs of a model: fits in percent, errors in the output's unit, and
    a benchmark's score."""
    scores = benchmark_rmse(data, model_run.test.simulated) if "benchmark" in data.metadata else ()
    train = {"fit_train_percent": records_fit_percent(model_run.model, data.training, data)}
    fits = fit_columns(model_run.validation, model_run.test, scores)
    return train | fits | initial_state_columns(model_run.model, data, model_run.test)


SCORE = Stage("score", compute_free_runs, ModelRun, free_run_columns, SIMULATED)
