"""Derivatives of a loop's coverage with respect to its gains, and predictions of the coverage of
other gains.

At the optimum of the program for weights, multipliers and kappa, `F_k(x; gains) >= 0` at the angles
`w_k`, the dual matrices Z_k say how the optimum changes with the gains:

    d nu / d gain = sum_k <Z_k, dF_k / d gain>,    nu = kappa^2

so one solution gives the slopes along all entries of K and L. The optimum is the least of many
smooth functions, with a kink where they meet. So the prediction is the smallest of those by the
slopes at several gains, as in bundle methods (Kiwiel, Methods of Descent for Nondifferentiable
Optimization, 1985). Source: docs/theory.md, "Measured discs".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.synthesis.measured_discs_choice import LoopCoverage
from ssm_study.synthesis.measured_discs_program import LoopForms
from ssm_study.synthesis.measured_discs_search import select_theorem
from ssm_study.systems import Gains

CHANGE = 1e-4  # of each entry, relative, for the slope of the matrices
LATEST = 12  # samples by which coverage is predicted
SMALLEST_COVERAGE = 1e-6  # whose logarithm stands for no coverage

Position = Float[np.ndarray, "n"]


@dataclass(frozen=True, kw_only=True)
class GainCoordinates:
    """Coordinates of gains: logarithms of all entries of K and L, relative to those of the first
    gains."""

    first: Gains

    @property
    def entry_count(self) -> int:
        """Number of entries of all gain matrices together, which is the number of coordinates."""
        return sum(matrix.size for matrix in self.first.matrices_by_symbol.values())

    def matrices_at(self, position: Position) -> dict[str, Float[np.ndarray, "r c"]]:
        """Gain matrices of controller and observer, keyed by symbol, at a position in these
        coordinates."""
        factors = np.exp(position)
        start = 0
        moved = {}
        for name, matrix in self.first.matrices_by_symbol.items():
            own_factors = factors[start : start + matrix.size]
            moved[name] = matrix * own_factors.reshape(matrix.shape)
            start += matrix.size
        return moved

    def gains_at(self, position: Position) -> Gains:
        """Gains of controller and observer at a position in these coordinates."""
        return replace(self.first, **self.matrices_at(position))


@dataclass(frozen=True, kw_only=True)
class CoverageSample:
    """Logarithm of the coverage with the gains at one position, and its derivatives with respect to
    all coordinates."""

    position: Position
    log_coverage: float
    slopes: Position

    def log_coverage_at(self, position: Position) -> float:
        """Prediction of the logarithm of the coverage at another position, linear in the distance
        from this one."""
        return float(self.log_coverage + self.slopes @ (position - self.position))


def sample_coverage(
    loop: LoopCoverage,
    coordinates: GainCoordinates,
    position: Position,
    centre: float,
    least_radius: float = 0.0,
) -> CoverageSample | None:
    """Compute the coverage with the gains at a position, and its derivatives; None where the solver
    gives none. Below `least_radius` both may be those of an upper bound."""
    matrices = coordinates.matrices_at(position)
    optimum = loop.radius_optimum_at_centre(matrices, centre, least_radius)
    if optimum is None or optimum.duals is None:
        return None

    def constrained_matrices_at(moved: Position) -> Complex[np.ndarray, "A G G"]:
        """Constrained matrices of moved gains at the weights and multipliers of the optimum."""
        context = replace(loop.context, gains=coordinates.matrices_at(moved))
        forms = LoopForms.from_context(select_theorem(context), context, (centre,))
        return optimum.constrained_matrices(forms, centre)

    duals = np.conj(optimum.duals)
    unmoved = constrained_matrices_at(position)
    slopes = np.zeros(coordinates.entry_count)
    for i in range(coordinates.entry_count):
        moved = position.copy()
        moved[i] += CHANGE
        change = (constrained_matrices_at(moved) - unmoved) / CHANGE
        slopes[i] = (duals * change).sum().real
    radius = max(optimum.radius, SMALLEST_COVERAGE)
    log_slopes = slopes / (2 * radius**2)
    log_coverage = float(np.log(radius))
    return CoverageSample(position=position, log_coverage=log_coverage, slopes=log_slopes)


def predict_log_coverage(
    samples: Sequence[CoverageSample], best: CoverageSample, positions: Float[np.ndarray, "P n"]
) -> Float[np.ndarray, "P"]:
    """Predict the logarithm of the coverage at several positions, as the smallest of the
    predictions from earlier samples. A sample that predicts less than the coverage computed at the
    best position is shifted up to it."""
    lowest = np.full(len(positions), np.inf)
    steps = positions - best.position
    for sample in (best, *samples[-LATEST:]):
        at_best = max(sample.log_coverage_at(best.position), best.log_coverage)
        lowest = np.minimum(lowest, at_best + steps @ sample.slopes)
    return lowest
