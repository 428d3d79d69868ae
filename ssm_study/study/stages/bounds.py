"""The model in the coordinates in which it is certified, and what is proved of it alone."""

from ssm_study.bounds.metrics import bound_facts
from ssm_study.engine.stages import Facts, Stage
from ssm_study.signals import DataSet
from ssm_study.study.stages.free_run import SIMULATED, ModelRun, compute_simulated, measure_score
from ssm_study.study.stages.model import Trained
from ssm_study.training.metrics import mean_fit


def measure_bounds(simulated: ModelRun, data: DataSet, trained: Trained) -> Facts:
    """Columns of the certified model: fits, linear part, slopes."""
    facts = measure_score(simulated, data, trained)
    facts["fit_test_before_reduction_percent"] = mean_fit(trained.model, data.test, data)
    return facts | bound_facts(simulated.model)


BOUNDS = Stage("bounds", compute_simulated, ModelRun, measure_bounds, SIMULATED)
