"""Reduction of an identified model to fewer states before synthesis, by balanced truncation.
Source: Moore 1981."""

from dataclasses import dataclass
from typing import Any

from ssm_study.bounds.gramians import BALANCING_FLOOR, balanced_realization, hankel_singular_values
from ssm_study.refusal import require, require_at_least


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """Settings for the reduction of a model to fewer states by balanced truncation. `x = T z` with
    equal, diagonal Gramians, of which the states with the largest Hankel singular values stay:
    conf/reduction/balanced.yaml.

    `drop_below` acts in any case: on modes that the controller could hardly move, in coordinates
    that floats do not hold. `absorb` is `SSM.absorb_map_centres`, done first.
    """

    balanced: bool = True
    truncate_to: int | None = None
    drop_below: float = 1e-6
    absorb: bool = True

    def __post_init__(self) -> None:
        order = self.truncate_to
        require_at_least(1, "reduction.truncate_to", order, "use 1 or more, or null to drop none")
        share = self.drop_below
        remedy = "use 1e-6, which changes the output by about a millionth"
        inside = BALANCING_FLOOR <= share < 1
        problem = f"must lie in [{BALANCING_FLOOR:g}, 1)"
        require(inside, "reduction.drop_below", share, problem, remedy)
        problem = "states can be dropped in balanced coordinates only"
        remedy = "set it true, or reduction.truncate_to=null"
        require(
            self.balanced or order is None, "reduction.balanced", self.balanced, problem, remedy
        )

    def reduce_model(self, model: Any) -> Any:
        """Reduce a model to fewer states by balanced truncation.

        A model with neurons stays as it is: no state of its linear part can be dropped by itself
        (`BadRequest`).
        """
        if not hasattr(model, "with_system_and_disturbances"):
            problem = (
                "states can be dropped from a linear recurrence only, and this model has neurons"
            )
            remedy = "use reduction.truncate_to=null"
            require(
                self.truncate_to is None, "reduction.truncate_to", self.truncate_to, problem, remedy
            )
            return model
        if self.absorb and hasattr(model, "absorb_map_centres"):
            model = model.absorb_map_centres()
        if not self.balanced or (self.truncate_to is None and model.linear.spectral_radius >= 1):
            return model  # a model that integrates has no such coordinates
        system = (
            model.system_with_disturbances
        )  # a mode that only a measured disturbance moves stays, too
        hankel = hankel_singular_values(system)
        state_count = int((hankel > self.drop_below * hankel[0]).sum())
        order = min(state_count, self.truncate_to or system.order)
        return model.with_system_and_disturbances(balanced_realization(system, order))
