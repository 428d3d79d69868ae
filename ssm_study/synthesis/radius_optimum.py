"""Optimum of the program for weights, multipliers and radius of a disc of model errors.

Source: docs/theory.md, "Measured discs".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.synthesis.measured_discs_program import LoopForms


@dataclass(frozen=True, kw_only=True)
class RadiusOptimum:
    """Largest squared radius of a disc of model errors that a loop tolerates, with the weights and
    multipliers that reach it.

    `angles` are the frequencies that were solved and `duals` the dual matrices there, None where
    the solver gives none.
    """

    squared_radius: float
    unknowns: Float[np.ndarray, "n"]
    basis_values: Float[np.ndarray, "K F"]
    angles: Float[np.ndarray, "F"]
    deciding_angles: Float[np.ndarray, "D"]
    duals: Complex[np.ndarray, "F G G"] | None

    @property
    def radius(self) -> float:
        """Largest radius of the disc of model errors that a loop tolerates."""
        return float(max(self.squared_radius, 0.0) ** 0.5)

    def constrained_matrices(self, forms: LoopForms, centre: float) -> Complex[np.ndarray, "F G G"]:
        """Matrices that the optimum's weights and multipliers make positive for its loop, computed
        for any other loop."""
        at_angles = forms.at_angles(self.angles)
        size = len(self.basis_values)
        on_model = self.unknowns[:size] @ self.basis_values
        on_input = self.unknowns[size : 2 * size] @ self.basis_values
        multipliers = self.unknowns[2 * size :]
        of_maps = np.tensordot(multipliers, at_angles.multipliers, axes=1)
        reference = on_model[:, None, None] * at_angles.model
        reference = reference + on_input[:, None, None] * at_angles.input
        return np.asarray(at_angles.centred[centre] - reference + of_maps)
