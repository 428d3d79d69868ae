"""Stage that converts the model to coordinates for certification, and records the model's proved
properties."""

from ssm_study.bounds.metrics import model_bound_columns
from ssm_study.engine.stages import Facts, Stage
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.signals import DataSet
from ssm_study.study.stages.free_run import SIMULATED, ModelRun, compute_free_runs, free_run_columns
from ssm_study.study.stages.model import TrainedModel


def certified_model_columns(model_run: ModelRun, data: DataSet, trained: TrainedModel) -> Facts:
    """Table columns that describe a certified model: its fits, linear part and slopes."""
    facts = free_run_columns(model_run, data, trained)
    _, test_before_reduction = simulate_validation_and_test(trained.model, data)
    facts["fit_test_before_reduction_percent"] = test_before_reduction.fit_percent
    return facts | model_bound_columns(model_run.model)


BOUNDS = Stage("bounds", compute_free_runs, ModelRun, certified_model_columns, SIMULATED)
