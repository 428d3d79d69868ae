"""Candidate gains from which a design is chosen, each with the synthesis settings that produced
them. Source: docs/theory.md."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ssm_study.certificates.problem import Solution
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains

GainCandidate = tuple[RiccatiSynthesis, Solution]


@dataclass(frozen=True, kw_only=True)
class GainCandidates:
    """Candidate gains of controller and observer on a grid of rates and weights, each with its
    synthesis settings."""

    feedback: tuple[RiccatiSynthesis, ...]
    ks: Float[np.ndarray, "C m s"]
    observing: tuple[RiccatiSynthesis, ...]
    ls: Float[np.ndarray, "O n p"]
    l_zs: Float[np.ndarray, "O q p"] | None = None
    internal: Float[np.ndarray, "z z"] | None = None
    unsolved: int = 0

    def gains(self, pair_indices: Int[np.ndarray, "*pairs 2"]) -> Gains:
        """Gains of one or many pairs of a controller and an observer, selected by their indices."""
        l_zs = None if self.l_zs is None else self.l_zs[pair_indices[..., 1]]
        controllers = pair_indices[..., 0]
        k = self.ks[controllers]
        observers = pair_indices[..., 1]
        return Gains(k=k, l=self.ls[observers], l_z=l_zs, internal=self.internal)

    def synthesis_settings(self, pair_indices: Int[np.ndarray, "2"]) -> RiccatiSynthesis:
        """Settings of the Riccati synthesis that gives the gains of one pair of controller and
        observer."""
        feedback = self.feedback[pair_indices[0]]
        observing = self.observing[pair_indices[1]]
        names = ("rate_observer", "input_noise", "state_noise", "output_noise")
        observer_fields: Any = {name: getattr(observing, name) for name in names}
        near = {**feedback.near, **observing.near}
        return replace(feedback, near=near, **observer_fields)
