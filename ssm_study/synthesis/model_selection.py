"""Selection among trained models that fit the records about equally well. It takes the one with the
fastest certifiable control.

Models that fit as well differ much in the rate that can be certified: one of them may let a neuron
cut off the input.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.refusal import require, require_at_least
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, StateSpace, System

if TYPE_CHECKING:
    from ssm_study.training.metrics import Identification


SLOW = 1e-3  # a rate at which an observer is asked for: hardly more than that it converges


@dataclass(frozen=True, kw_only=True)
class LargestCertifiableRate:
    """Selection of the model for which the largest contraction rate can be certified, among models
    that fit about equally well.

    One layer, and `rate_enough`: docs/models.md, "Structured models". Of the rate: docs/theory.md,
    "The frontier".
    """

    within_percent: float = 0.3
    one_layer_within_percent: float = 1.0
    rate_enough: float | None = None

    def __post_init__(self) -> None:
        remedy = "use 0.3 and 1, or model.among_starts=null for the best fit"
        for name in ("within_percent", "one_layer_within_percent"):
            weight = getattr(self, name)
            require_at_least(0, f"model.among_starts.{name}", weight, remedy)
        if (rate := self.rate_enough) is not None:
            between = (
                "must lie between 0 and 1",
                "use 0.135 for a factor of 0.93, or null for the largest rate",
            )
            is_rate = 0 < rate < 1
            require(is_rate, "model.among_starts.rate_enough", rate, *between)

    def __call__(self, identified_models: "Sequence[Identification]") -> "Identification":
        """Choose the model with the largest certifiable contraction rate among those that fit about
        as well as the best."""
        best_fit = max(identified.fit_validation_percent for identified in identified_models)
        near = [
            identified
            for identified in identified_models
            if identified.fit_validation_percent >= best_fit - self._fit_tolerance(identified.model)
        ]
        if len(near) == 1:
            return near[0]

        models: list[Any] = [identified.model for identified in near]
        rates = [self.largest_certifiable_feedback_rate(model) for model in models]
        rate_enough = self.rate_enough or 1.0
        models_and_rates = zip(near, rates, strict=True)
        fast_enough = [identified for identified, rate in models_and_rates if rate >= rate_enough]
        if fast_enough:
            return max(fast_enough, key=lambda identified: identified.fit_validation_percent)
        fastest = np.argmax(rates)
        return near[int(fastest)]

    def largest_certifiable_feedback_rate(self, model: Any) -> float:
        """Largest contraction rate that can be certified for some state feedback of a model; zero
        if there is none."""
        ball = certified_balls(model).input
        certifiable_rate = largest_certifiable_rate(model.system, ball)
        return max(0.0, certifiable_rate)

    def has_certificates(self, model: Any) -> bool:
        """Whether some state feedback and some observer for a model can be certified."""
        rate_of_model = self.largest_certifiable_feedback_rate(model)
        return rate_of_model > 0.0 and can_certify_observer(model)

    def _fit_tolerance(self, model: Any) -> float:
        """Difference in fit, in percentage points, up to which two models count as equally good."""
        if isinstance(model.system, StateSpace):
            return self.one_layer_within_percent
        return self.within_percent


def can_certify_observer(model: Any) -> bool:
    """Whether some observer for a model can be certified. With one layer it always can, because its
    modes lie inside the unit circle."""
    system = model.system
    if isinstance(system, StateSpace):
        return True
    from ssm_study.synthesis.structured_lmi import finds_certificate  # CVXPY, as below

    synthesis = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.5)
    ball = certified_balls(model).output
    observer_problem = synthesis.problem(system, ball, is_observer=True)
    return finds_certificate(observer_problem, SLOW)


def largest_certifiable_rate(system: System, ball: JacobianBall) -> float:
    """Largest contraction rate that can be certified for a system by the best state feedback."""
    if isinstance(system, StateSpace):
        return controller_frontier(system, ball).rate_limit
    from ssm_study.synthesis.structured_lmi import (
        largest_rate_with_neurons,
    )  # CVXPY: only where there are neurons

    riccati_synthesis = RiccatiSynthesis(rate_controller=0.5, rate_observer=0.5)
    return largest_rate_with_neurons(riccati_synthesis.problem(system, ball))
