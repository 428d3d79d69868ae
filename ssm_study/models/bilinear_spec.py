"""Settings of a bilinear model, and its fit from several initial parameters."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ssm_study.models.baselines.solved import SolvedSpec
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.metrics import Simulation
from ssm_study.models.spec import scale_records
from ssm_study.refusal import require, require_at_least
from ssm_study.signals import DataSet

if TYPE_CHECKING:
    from ssm_study.models.bilinear_problem import BilinearProblem, FitParameters

LARGEST_ORDER = 8
LARGEST_NODES = 15
SHORTEST = 40  # samples of the longest training record
SPREAD = 0.15  # random part of a further start's matrices


@dataclass(frozen=True, kw_only=True)
class BilinearSpec(SolvedSpec):
    """Settings of a bilinear model: its order and the number of input levels (nodes) at which its
    matrices are given.

    With a `rate` the matrices have norms below it, so that the model contracts in open loop; null
    leaves them free. Levenberg-Marquardt on the error of the free run, at most `steps` steps from
    each of `starts` starts: the linear model of ARX, and random matrices around it. The model with
    the best fit to the validation records is taken.
    """

    sizes: ClassVar = ("order", "starts", "steps")

    order: int = 2
    nodes: int = 3
    rate: float | None = None
    starts: int = 4
    steps: int = 60

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(3, "model.nodes", self.nodes, "use 3, which include the bilinear system")
        small = self.order <= LARGEST_ORDER and self.nodes <= LARGEST_NODES
        sizes = (self.order, self.nodes)
        problem = f"a matrix for each node is fitted, of at most {LARGEST_ORDER} states and"
        problem = f"{problem} {LARGEST_NODES} nodes"
        require(small, "model.order, model.nodes", sizes, problem, "use 3 states and 5 nodes")
        contracts = self.rate is None or 0 < self.rate < 1
        require(contracts, "model.rate", self.rate, "must lie in (0, 1)", "use 0.999 or null")

    def fit_model(self, data: DataSet) -> Bilinear:
        """Fit a bilinear model to the training records, from several initial parameters.

        Raises `BadRequest` for several inputs and for records that are too short.
        """
        from ssm_study.models.bilinear_problem import BilinearProblem  # loads numba

        inputs = data.scale.inputs
        problem = f"takes one input, and there are {inputs}"
        require(inputs == 1, "model", "bilinear", problem, "choose another model")
        lengths = (len(record) for record in data.training)
        longest = max(lengths)
        problem = f"the longest training record has {longest} samples, and {SHORTEST} are needed"
        require(longest >= SHORTEST, "model", "bilinear", problem, "log longer")
        records = scale_records(data)
        problem_of_fit = BilinearProblem.from_records(records, self.order, self.nodes, self.rate)
        rng = np.random.default_rng(0)
        candidates = []
        for start in range(self.starts):
            spread = SPREAD if start else 0.0
            try:
                parts = problem_of_fit.initial_parameters(rng, spread)
                candidate = self._fit_from_initial_parameters(problem_of_fit, parts, data)
                candidates.append(candidate)
            except np.linalg.LinAlgError:  # the records do not excite as many states
                continue
        problem = "the fit of the records diverges from every start"
        require(candidates, "model.order", self.order, problem, "use fewer states")
        return max(candidates, key=lambda model: validation_fit_percent(model, data))

    def _fit_from_initial_parameters(
        self, problem: "BilinearProblem", parts: "FitParameters", data: DataSet
    ) -> Bilinear:
        """Fit a bilinear model from given initial parameters."""
        fitted = problem.minimise(parts, self.steps)
        return problem.build_model(fitted, data.scale, data.step_s)


def validation_fit_percent(model: Bilinear, data: DataSet) -> float:
    """Fit of a bilinear model's free run to the validation records in percent; minus infinity if
    the run diverges."""
    with np.errstate(all="ignore"):
        simulation = Simulation.simulate_records(model, data.validation, data.start_up_samples)
        fit = simulation.fit_percent
    is_finite = np.isfinite(fit)
    return fit if is_finite else -np.inf
