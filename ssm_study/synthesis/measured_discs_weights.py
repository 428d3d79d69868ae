"""Frequency weights of a disc of model errors, as cosine polynomials over fixed poles, and their
optimisation.

`WeightProgram` gives the largest kappa with its weights and multipliers, and widens the weights
where the loop does not mind. Source: docs/theory.md, "Measured discs".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import NoSolution
from ssm_study.robustness.coverage import DiscWeights
from ssm_study.robustness.coverage_items import DiscRequirement
from ssm_study.synthesis.measured_discs_program import (
    MOST,
    FormsAtAngles,
    FrequencyProgram,
    LoopForms,
    form_norms,
)
from ssm_study.synthesis.radius_optimum import RadiusOptimum

Unknowns = Float[np.ndarray, "n"]
Angles = Float[np.ndarray, "F"]
Coefficients = Float[np.ndarray, "K"]
Bounds = Float[np.ndarray, "R"]
BasisValues = Float[np.ndarray, "K F"]
ConstraintRows = Float[np.ndarray, "R N"]

POLES = (0.5, 0.9)  # of the weights, with as many at zero
ORDER = 4  # of each weight
WIDEST = 2.25  # times what records show, in power: weights are widened up to here
ROOM = 0.02  # the model lies inside the disc by this share
NEAR_ZERO = 1e-2  # share of its mean over the circle below which a squared gain never falls
CEPSTRUM = 2**15  # points of the circle for a spectral factor
LARGEST = 1e6  # of nu = kappa^2 at given weights: beyond it, nothing that e does matters
LARGEST_AT_FREE_WEIGHTS = 100.0  # of nu: no more than ten times the recorded error is looked for
MULTIPLIER_COST = 1e-6  # of each multiplier: without one, idle multipliers grow without bound
JOINT = 3e-5  # by how much angles of the joint program may miss: far less than kappa is taken back
COARSE = 1e-3  # likewise, where many gains with neurons are compared
DECIDING = 6  # angles that decide one program and are solved first in the next
NO_ANGLES = np.zeros(0)
CIRCLE = np.union1d(np.linspace(0, np.pi, 65), np.geomspace(1e-3, 0.1, 12))
EVENLY = np.linspace(0, np.pi, 2001)


def initial_weights(
    forms: LoopForms, centre: float, multipliers: Float[np.ndarray, "A"]
) -> Float[np.ndarray, "G"]:
    """Initial weight of each free signal of the closed loop, such as the model error: its diagonal
    element in the loop's quadratic form. The weight of the model error e is one; that of a signal
    of a static map is the map's multiplier."""
    order = len(forms.a)
    map_forms = np.tensordot(multipliers, forms.multipliers, axes=1)
    whole = forms.centred[centre] + map_forms
    free_signals = np.diagonal(whole)[order:]
    own = np.abs(free_signals)
    smallest = 1e-9 * own.max()
    return np.asarray(np.maximum(own, smallest))


@dataclass(frozen=True, kw_only=True)
class WeightBasis:
    """Cosine basis functions in which the squared gains of a model-error disc's weighting filters
    are expanded."""

    poles: tuple[float, ...] = POLES
    order: int = ORDER

    def squared_denominator(self, angles: Angles) -> Angles:
        """Squared gain `|den|^2` of the weighting filters' common denominator at each frequency."""
        if not self.poles:
            return np.ones(len(angles))
        delay = np.exp(-1j * angles)
        factors = [np.abs(1 - pole * delay) ** 2 for pole in self.poles]
        return np.asarray(np.prod(factors, axis=0))

    def basis_values(self, angles: Angles) -> BasisValues:
        """Value of each basis function of the squared weights at each frequency."""
        return self.cosine_values(angles) / self.squared_denominator(angles)

    def cosine_values(self, angles: Angles) -> BasisValues:
        """Values of the cosine basis, one and `2 cos(k w)`, at each frequency `w`. The squared
        weights are sums of these, over a common denominator."""
        rows = [np.ones(len(angles))]
        for j in range(1, self.order + 1):
            cosine = np.cos(j * angles)
            rows.append(2 * cosine)
        return np.stack(rows)

    def filter_from_coefficients(self, coefficients: Coefficients) -> Float[np.ndarray, "v v"]:
        """Minimum-phase filter whose squared gain has given basis coefficients. It is `[A, B; C,
        D]`; raises `NoSolution` if there is none."""
        mean = coefficients[0]
        if mean <= 0:
            return np.zeros((1, 1))
        is_constant = self.order == 0 and not self.poles
        if is_constant:
            gain = np.sqrt(mean)
            return np.array([[gain]])
        numerator = spectral_factor(coefficients)
        denominator = np.real(np.poly(self.poles)) if self.poles else np.ones(1)
        size = max(len(numerator), len(denominator))
        numerator = np.pad(numerator, (0, size - len(numerator)))
        denominator = np.pad(denominator, (0, size - len(denominator)))
        a, b, c, d = scipy.signal.tf2ss(numerator, denominator)
        return np.block([[a, b], [c, d]])


def spectral_factor(coefficients: Coefficients) -> Coefficients:
    """Minimum-phase spectral factor of a cosine polynomial. Raises `NoSolution`.

    By the cepstrum: the causal half of `log |n|^2` is the logarithm of a factor without zeros or
    poles outside (Oppenheim & Schafer, Discrete-Time Signal Processing, chapter 13).
    """
    order = len(coefficients) - 1
    circle = np.zeros(CEPSTRUM)
    circle[: order + 1] = coefficients
    circle[len(circle) - order :] = coefficients[:0:-1]
    power = np.fft.fft(circle).real
    if power.min() <= 0:
        raise NoSolution("a squared gain is not positive everywhere")
    cepstrum = np.fft.ifft(np.log(power)).real
    cepstrum[0] /= 2
    cepstrum[CEPSTRUM // 2 :] = 0.0
    logarithm = np.fft.fft(cepstrum)
    impulse_response = np.fft.ifft(np.exp(logarithm)).real
    factor = impulse_response[: order + 1]
    again = np.convolve(factor, factor[::-1])[order:]
    largest_error = np.abs(again - coefficients).max()
    if largest_error > 1e-3 * coefficients[0]:
        raise NoSolution("a squared gain has no spectral factor")
    return np.asarray(factor)


@dataclass(frozen=True, kw_only=True)
class WeightProgram:
    """Convex program that optimises weights, multipliers and radius of a disc of model errors
    together, for one disc centre.

    Angles may miss the inequality by `tolerance`.

    Unknowns: nu, x and y (the coefficients of X and Y), the multipliers; in stage two nu is fixed
    and each band has a `widening` of its own.
    """

    forms: LoopForms
    grid: FormsAtAngles
    centre: float
    items: tuple[DiscRequirement, ...]
    basis: WeightBasis
    tolerance: float = JOINT

    @property
    def coefficient_matrices(self) -> Any:
        """Coefficient matrix of each unknown in the linear matrix inequality, at each frequency."""
        angles = self.grid.angles
        basis_values = self.basis.basis_values(angles)
        phi = basis_values[:, :, None, None]
        of_x = -phi * self.grid.model
        of_y = -phi * self.grid.input
        multipliers = self.grid.multipliers
        return np.concatenate([of_x, of_y, multipliers])

    def requirement_coefficients(self) -> Float[np.ndarray, "I n"]:
        """Coefficients of the linear inequalities by which the weights of the model error's bound
        must reach every recorded model error."""
        rows = []
        for item in self.items:
            phi = self.basis.basis_values(item.angles)
            of_x = phi @ item.model_power
            of_y = phi @ item.input_power
            reference = np.concatenate([of_x, of_y])
            rows.append(reference / item.seen)
        return np.array(rows)

    def weight_positivity_rows(self) -> tuple[Float[np.ndarray, "R n"], Bounds]:
        """Linear constraints, as coefficient rows with lower bounds, that keep both weights of a
        disc of model errors positive. X exceeds `c^2`, so that the disc contains `e = 0`, and
        neither comes near zero."""
        mean = self.basis.basis_values(EVENLY).mean(axis=1)
        on_circle = self.basis.basis_values(CIRCLE).T
        clear = on_circle - NEAR_ZERO * mean
        none = np.zeros_like(clear)
        count = len(CIRCLE)
        least_x = self.centre**2 * (1 + ROOM)
        on_x = np.hstack([clear, none])
        on_y = np.hstack([none, clear])
        rows = np.concatenate([on_x, on_y])
        bounds = np.concatenate([np.full(count, least_x), np.zeros(count)])
        return rows, bounds

    def maximise_radius(self) -> tuple[float, Unknowns]:
        """Largest squared radius of the disc of model errors, with the weights and multipliers that
        reach it. Raises `NoSolution`."""
        optimum = self.maximise_radius_from()
        return optimum.squared_radius, optimum.unknowns

    def maximise_radius_from(
        self,
        start_angles: Float[np.ndarray, "D"] = NO_ANGLES,
        least_squared_radius: float = -np.inf,
    ) -> RadiusOptimum:
        """Largest radius of the disc of model errors that a loop tolerates. Raises `NoSolution`.

        The search begins at the given angles, such as those that decided similar gains. Where the
        radius is below `least_squared_radius`, an upper bound that is below it, too, is returned.
        """
        linear = self.coefficient_matrices
        scale = form_norms(linear)
        count = len(scale)
        rows, bounds = self._constraints_with_radius(scale)
        constant = self.grid.centred[self.centre]
        of_nu = np.zeros_like(linear[:1])
        scaled = scale_unknowns(linear, scale)
        with_nu = np.concatenate([of_nu, scaled])
        program = FrequencyProgram(constant=constant, linear=with_nu, rows=rows, bounds=bounds)
        goal = np.full(1 + count, -MULTIPLIER_COST)
        goal[: 1 + self.coefficient_count] = 0.0
        goal[0] = 1.0
        differences = self.grid.angles - start_angles[:, None]
        distances = np.abs(differences)
        nearest = distances.argmin(axis=1)
        first = np.unique(nearest).tolist()
        x, chosen, duals = program.maximise_with_duals(
            goal, self.tolerance, first, least_squared_radius
        )
        lowest = program.smallest_eigenvalues(x)[chosen]
        tightest = np.argsort(lowest)[:DECIDING]
        chosen_angles = self.grid.angles[chosen]
        return RadiusOptimum(
            squared_radius=float(x[0]),
            unknowns=x[1:] / scale,
            basis_values=self.basis.basis_values(chosen_angles),
            angles=chosen_angles,
            deciding_angles=chosen_angles[tightest],
            duals=duals,
        )

    @property
    def coefficient_count(self) -> int:
        """Total number of coefficients in the output weight and the input weight of a disc of model
        errors."""
        return 2 * (self.basis.order + 1)

    def _constraints_with_radius(self, scale: Unknowns) -> tuple[ConstraintRows, Bounds]:
        """Linear constraints on the radius and weights of a disc of model errors and on the
        multipliers, with their bounds.

        Each item needs nu at most; the weights stay clear of zero; a multiplier is at least zero
        and at most `MOST`; nu is at most `LARGEST_AT_FREE_WEIGHTS`.
        """
        weights = self.coefficient_count
        multipliers = len(scale) - weights
        rows_xy, least_xy = self.weight_positivity_rows()
        requirement_rows = self.requirement_coefficients()
        requirements = len(requirement_rows)
        unscaled_rows = np.concatenate([requirement_rows, rows_xy])
        on_weights = unscaled_rows / scale[:weights]
        unknowns = 1 + len(scale)
        first_multiplier = 1 + weights
        top = np.zeros((len(on_weights), unknowns))
        top[:requirements, 0] = -1.0
        top[:, 1:first_multiplier] = on_weights
        identity = np.eye(unknowns)
        at_least_zero = identity[first_multiplier:]
        at_most = -at_least_zero
        nu_at_most = -identity[:1]
        rows = np.concatenate([top, at_least_zero, at_most, nu_at_most])
        zeros = np.zeros(multipliers)
        most = np.full(multipliers, -MOST)
        largest_nu = np.array([-LARGEST_AT_FREE_WEIGHTS])
        no_bound = np.zeros(requirements)
        bounds = np.concatenate([no_bound, least_xy, zeros, most, largest_nu])
        return rows, bounds

    def widen_weights(
        self, squared_radius: float, unknowns: Unknowns, margin_fraction: float
    ) -> Unknowns:
        """Enlarge the weights of a disc of model errors, at a fixed radius, as far as the proof
        allows in each frequency band. A margin of `margin_fraction` times each free signal's own
        weight is left in the loop."""
        unscaled_multipliers = unknowns[self.coefficient_count :]
        multipliers = np.maximum(unscaled_multipliers, 0.0)
        own = initial_weights(self.forms, self.centre, multipliers)
        root = 1 / np.sqrt(own)
        units = np.outer(root, root)  # each free signal in units of its own weight
        linear = self.coefficient_matrices * units
        scale = form_norms(linear)
        count = len(scale)
        rows, bounds, bands = self._constraints_with_widening(scale, squared_radius)
        matrix_shape = linear.shape[1:]
        of_widenings = np.zeros((bands, *matrix_shape))
        margin = margin_fraction * np.eye(len(own))
        constant = self.grid.centred[self.centre] * units - margin
        scaled = scale_unknowns(linear, scale)
        with_widenings = np.concatenate([scaled, of_widenings])
        program = FrequencyProgram(
            constant=constant, linear=with_widenings, rows=rows, bounds=bounds
        )
        goal = np.full(count + bands, -MULTIPLIER_COST)
        goal[: self.coefficient_count] = 0.0
        goal[count:] = 1.0
        x, _ = program.maximise(goal, self.tolerance)
        scaled_unknowns = x[:count]
        return np.asarray(scaled_unknowns / scale)

    def _constraints_with_widening(
        self, scale: Unknowns, squared_radius: float
    ) -> tuple[ConstraintRows, Bounds, int]:
        """Linear constraints on the weights of a disc of model errors, on the multipliers, and on
        the factors by which the weights are enlarged.

        Each item needs its band's widening times nu at most; a widening lies between one and
        `WIDEST`.
        """
        weights = self.coefficient_count
        multipliers = len(scale) - weights
        rows_xy, least_xy = self.weight_positivity_rows()
        requirement_rows = self.requirement_coefficients()
        requirements = len(requirement_rows)
        places = sorted({item.place for item in self.items})
        band_of_item = np.array([places.index(item.place) for item in self.items])
        bands = len(places)
        total = len(scale) + bands
        unscaled_rows = np.concatenate([requirement_rows, rows_xy])
        top = np.zeros((requirements + len(rows_xy), total))
        top[:, :weights] = unscaled_rows / scale[:weights]
        items = np.arange(requirements)
        widening_of_item = len(scale) + band_of_item
        top[items, widening_of_item] = -squared_radius
        unit_rows = np.eye(total)[weights:]
        rows = np.concatenate([top, unit_rows, -unit_rows])
        least = np.concatenate([np.zeros(multipliers), np.ones(bands)])
        largest_multipliers = np.full(multipliers, MOST)
        largest_widenings = np.full(bands, WIDEST)
        most = np.concatenate([largest_multipliers, largest_widenings])
        no_bound = np.zeros(requirements)
        bounds = np.concatenate([no_bound, least_xy, least, -most])
        return rows, bounds, bands

    def weights_from_unknowns(self, squared_radius: float, unknowns: Unknowns) -> DiscWeights:
        """Weighting filters of a disc of model errors, from the solution of the convex program.
        Raises `NoSolution`."""
        size = self.basis.order + 1
        x = unknowns[:size] / squared_radius
        y = unknowns[size : 2 * size] / squared_radius
        floor = abs(self.centre) * (1 + ROOM / 4) / np.sqrt(squared_radius)
        if floor == 0:
            mean = max(x[0], 1e-12)
            floor = 1e-6 * float(np.sqrt(mean))
        denominator = denominator_coefficients(self.basis.poles, size)
        above_floor = x - floor**2 * denominator
        output = self.basis.filter_from_coefficients(above_floor)
        weights_input = self.basis.filter_from_coefficients(y)
        return DiscWeights(floor=float(floor), output=output, input=weights_input)


def scale_unknowns(forms: Any, scale: Unknowns) -> Any:
    """Divide the coefficient matrix of each unknown in an optimisation by the scale of the
    unknown."""
    return forms / scale[:, None, None, None]


def denominator_coefficients(poles: Sequence[float], coefficient_count: int) -> Coefficients:
    """Cosine coefficients of the squared denominator of a filter with given poles."""
    denominator = np.real(np.poly(poles)) if len(poles) else np.ones(1)
    squared = np.convolve(denominator, denominator[::-1])
    middle = len(denominator) - 1
    cosine_coefficients = squared[middle:]
    missing = coefficient_count - len(cosine_coefficients)
    return np.pad(cosine_coefficients, (0, missing))
