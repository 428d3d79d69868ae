"""Weights of the measured disc as cosine polynomials over fixed poles, and their optimisation.

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
from ssm_study.robustness.coverage import Weights
from ssm_study.robustness.coverage_items import Item
from ssm_study.synthesis.measured_discs_program import (
    MOST,
    AngleProgram,
    FormsAtAngles,
    LoopForms,
    form_sizes,
)

POLES = (0.5, 0.9)  # of the weights, with as many at zero
ORDER = 4  # of each weight
WIDEST = 2.25  # times what records show, in power: weights are widened up to here
ROOM = 0.02  # the model lies inside the disc by this share
NEAR_ZERO = 1e-2  # share of its mean over the circle below which a squared gain never falls
CEPSTRUM = 2**15  # points of the circle for a spectral factor
LARGEST = 1e6  # of nu = kappa^2: beyond it, nothing that e does matters
JOINT = 3e-5  # by how much angles of the joint program may miss: far less than kappa is taken back
COARSE = 1e-3  # likewise, where many gains with neurons are compared
DECIDING = 6  # angles that decide one program and are solved first in the next
NO_ANGLES = np.zeros(0)
CIRCLE = np.union1d(np.linspace(0, np.pi, 65), np.geomspace(1e-3, 0.1, 12))
EVENLY = np.linspace(0, np.pi, 2001)


def initial_weights(
    forms: LoopForms, centre: float, multipliers: Float[np.ndarray, "A"]
) -> Float[np.ndarray, "G"]:
    """Weight of each free signal in the loop's quadratic form, taken alone. It is one for |e|^2,
    its multiplier for |p|^2, and so on."""
    order = len(forms.a)
    whole = forms.centred[centre] + np.tensordot(multipliers, forms.multipliers, axes=1)
    own = np.abs(np.diagonal(whole)[order:])
    return np.asarray(np.maximum(own, 1e-9 * own.max()))


@dataclass(frozen=True, kw_only=True)
class WeightBasis:
    """Cosine functions in which the squared gains of the weights are expanded."""

    poles: tuple[float, ...] = POLES
    order: int = ORDER

    def denominator(self, angles: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
        """Squared gain `|den|^2` of the weights' denominator at each frequency."""
        if not self.poles:
            return np.ones(len(angles))
        delay = np.exp(-1j * angles)
        factors = [np.abs(1 - pole * delay) ** 2 for pole in self.poles]
        return np.asarray(np.prod(factors, axis=0))

    def values_at(self, angles: Float[np.ndarray, "F"]) -> Float[np.ndarray, "K F"]:
        """Value of each basis function at each frequency."""
        return self.numerators(angles) / self.denominator(angles)

    def numerators(self, angles: Float[np.ndarray, "F"]) -> Float[np.ndarray, "K F"]:
        """Numerators of the basis functions at each frequency: one, and `2 cos(j w)`."""
        rows = [np.ones(len(angles))]
        for j in range(1, self.order + 1):
            rows.append(2 * np.cos(j * angles))
        return np.stack(rows)

    def filter_from_coefficients(
        self, coefficients: Float[np.ndarray, "K"]
    ) -> Float[np.ndarray, "v v"]:
        """Minimum-phase filter whose squared gain has given basis coefficients. It is `[A, B; C,
        D]`; raises `NoSolution` if there is none."""
        if coefficients[0] <= 0:
            return np.zeros((1, 1))
        if self.order == 0 and not self.poles:
            return np.array([[np.sqrt(coefficients[0])]])
        numerator = spectral_factor(coefficients)
        denominator = np.real(np.poly(self.poles)) if self.poles else np.ones(1)
        size = max(len(numerator), len(denominator))
        numerator = np.pad(numerator, (0, size - len(numerator)))
        denominator = np.pad(denominator, (0, size - len(denominator)))
        a, b, c, d = scipy.signal.tf2ss(numerator, denominator)
        return np.block([[a, b], [c, d]])


def spectral_factor(coefficients: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
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
    factor = np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real[: order + 1]
    again = np.convolve(factor, factor[::-1])[order:]
    if np.abs(again - coefficients).max() > 1e-3 * coefficients[0]:
        raise NoSolution("a squared gain has no spectral factor")
    return np.asarray(factor)


@dataclass(frozen=True, kw_only=True)
class WeightProgram:
    """Convex program that optimises weights, multipliers and disc radius together, for one disc
    centre.

    Angles may miss the inequality by `tolerance`.

    Unknowns: nu, x and y (the coefficients of X and Y), the multipliers; in stage two nu is fixed
    and each band has a `widening` of its own.
    """

    forms: LoopForms
    grid: FormsAtAngles
    centre: float
    items: tuple[Item, ...]
    basis: WeightBasis
    tolerance: float = JOINT

    @property
    def unknown_matrices(self) -> Any:
        """Matrix that each unknown multiplies in the constraint at each frequency."""
        angles = self.grid.angles
        phi = self.basis.values_at(angles)[:, :, None, None]
        of_x = -phi * self.grid.model
        of_y = -phi * self.grid.input
        multipliers = self.grid.multipliers
        return np.concatenate([of_x, of_y, multipliers])

    def requirement_coefficients(self) -> Float[np.ndarray, "I n"]:
        """Coefficients of the weights in each linear inequality that the records impose on the
        weights."""
        rows = []
        for item in self.items:
            phi = self.basis.values_at(item.angles)
            row = np.concatenate([phi @ item.model_power, phi @ item.input_power])
            rows.append(row / item.seen)
        return np.array(rows)

    def weight_rows(self) -> tuple[Float[np.ndarray, "R n"], Float[np.ndarray, "R"]]:
        """Linear constraints on the weights' coefficients, with their bounds. X exceeds `c^2`, so
        that the disc contains `e = 0`, and neither comes near zero."""
        mean = self.basis.values_at(EVENLY).mean(axis=1)
        clear = self.basis.values_at(CIRCLE).T - NEAR_ZERO * mean
        none = np.zeros_like(clear)
        least = np.full(len(CIRCLE), self.centre**2 * (1 + ROOM))
        on_x = np.hstack([clear, none])
        on_y = np.hstack([none, clear])
        rows = np.concatenate([on_x, on_y])
        bounds = np.concatenate([least, np.zeros(len(CIRCLE))])
        return rows, bounds

    def maximise_radius(self) -> tuple[float, Float[np.ndarray, "n"]]:
        """Largest squared disc radius, with the weights and multipliers that reach it. Raises
        `NoSolution`."""
        nu, unknowns, _ = self.maximise_radius_from()
        return nu, unknowns

    def maximise_radius_from(
        self, angles: Float[np.ndarray, "D"] = NO_ANGLES, least: float = -np.inf
    ) -> tuple[float, Float[np.ndarray, "n"], Float[np.ndarray, "D2"]]:
        """Largest squared disc radius, with the weights and multipliers that reach it, and the
        frequencies that decide it. Raises `NoSolution`.

        The search begins at the given angles, such as those that decided similar gains. Where the
        radius is below `least`, an upper bound that is below it, too, is returned.
        """
        linear = self.unknown_matrices
        scale = form_sizes(linear)
        count = len(scale)
        rows, bounds = self._rows_with_nu(scale)
        constant = self.grid.centred[self.centre]
        angle_program_linear = np.concatenate(
            [np.zeros_like(linear[:1]), scale_unknowns(linear, scale)]
        )
        program = AngleProgram(
            constant=constant, linear=angle_program_linear, rows=rows, bounds=bounds
        )
        goal = np.zeros(1 + count)
        goal[0] = 1.0
        distances = np.abs(self.grid.angles - angles[:, None])
        first = np.unique(distances.argmin(axis=1)).tolist()
        x, chosen = program.maximise(goal, self.tolerance, first, least)
        lowest = program.smallest_eigenvalues(x)[chosen]
        deciding = self.grid.angles[chosen][np.argsort(lowest)[:DECIDING]]
        return float(x[0]), x[1:] / scale, deciding

    @property
    def coefficient_count(self) -> int:
        """Number of coefficients of both weights together."""
        return 2 * (self.basis.order + 1)

    def _rows_with_nu(
        self, scale: Float[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "R N"], Float[np.ndarray, "R"]]:
        """Linear constraints on disc radius, weights and multipliers, with their bounds.

        Each item needs nu at most; the weights stay clear of zero; a multiplier is at least zero
        and at most `MOST`; nu is at most `LARGEST`.
        """
        weights = self.coefficient_count
        multipliers = len(scale) - weights
        rows_xy, least_xy = self.weight_rows()
        requirement_rows = self.requirement_coefficients()
        on_weights = np.concatenate([requirement_rows, rows_xy]) / scale[:weights]
        top = np.zeros((len(on_weights), 1 + len(scale)))
        top[: len(requirement_rows), 0] = -1.0
        top[:, 1 : 1 + weights] = on_weights
        identity = np.eye(1 + len(scale))
        at_least_zero = identity[1 + weights :]
        at_most = -at_least_zero
        nu_at_most = -identity[:1]
        rows = np.concatenate([top, at_least_zero, at_most, nu_at_most])
        zeros = np.zeros(multipliers)
        most = np.full(multipliers, -MOST)
        largest_nu = np.array([-LARGEST])
        bounds = [np.zeros(len(requirement_rows)), least_xy, zeros, most, largest_nu]
        return rows, np.concatenate(bounds)

    def widen_weights(
        self, nu: float, unknowns: Float[np.ndarray, "n"], room: float
    ) -> Float[np.ndarray, "n"]:
        """Enlarge the weights in each frequency band as far as the proof allows, at a fixed disc
        radius. A margin of `room` times each free signal's own weight is left in the loop."""
        multipliers = np.maximum(unknowns[self.coefficient_count :], 0.0)
        own = initial_weights(self.forms, self.centre, multipliers)
        root = 1 / np.sqrt(own)
        units = np.outer(root, root)  # each free signal in units of its own weight
        linear = self.unknown_matrices * units
        scale = form_sizes(linear)
        rows, bounds, bands = self._rows_with_bands(scale, nu)
        none = np.zeros((bands, *linear.shape[1:]))
        centred = self.grid.centred
        constant = centred[self.centre] * units - room * np.eye(len(own))
        angle_program_linear = np.concatenate([scale_unknowns(linear, scale), none])
        program = AngleProgram(
            constant=constant, linear=angle_program_linear, rows=rows, bounds=bounds
        )
        goal = np.concatenate([np.zeros(len(scale)), np.ones(bands)])
        x, _ = program.maximise(goal, self.tolerance)
        return np.asarray(x[: len(scale)] / scale)

    def _rows_with_bands(
        self, scale: Float[np.ndarray, "n"], nu: float
    ) -> tuple[Float[np.ndarray, "R N"], Float[np.ndarray, "R"], int]:
        """Linear constraints on weights, multipliers and the widening of each frequency band.

        Each item needs its band's widening times nu at most; a widening lies between one and
        `WIDEST`.
        """
        weights = self.coefficient_count
        multipliers = len(scale) - weights
        rows_xy, least_xy = self.weight_rows()
        requirement_rows = self.requirement_coefficients()
        places = {item.place for item in self.items}
        bands = sorted(places)
        band_of_item = np.array([bands.index(item.place) for item in self.items])
        total = len(scale) + len(bands)
        top = np.zeros((len(requirement_rows) + len(rows_xy), total))
        top[:, :weights] = np.concatenate([requirement_rows, rows_xy]) / scale[:weights]
        top[np.arange(len(requirement_rows)), len(scale) + band_of_item] = -nu
        unit_rows = np.eye(total)[weights:]
        rows = np.concatenate([top, unit_rows, -unit_rows])
        least = np.concatenate([np.zeros(multipliers), np.ones(len(bands))])
        most = np.concatenate([np.full(multipliers, MOST), np.full(len(bands), WIDEST)])
        bounds = np.concatenate([np.zeros(len(requirement_rows)), least_xy, least, -most])
        return rows, bounds, len(bands)

    def weights_from_unknowns(self, nu: float, unknowns: Float[np.ndarray, "n"]) -> Weights:
        """Weighting filters from the program's solution. Raises `NoSolution`."""
        size = self.basis.order + 1
        x = unknowns[:size] / nu
        y = unknowns[size : 2 * size] / nu
        floor = abs(self.centre) * (1 + ROOM / 4) / np.sqrt(nu)
        if floor == 0:
            floor = 1e-6 * float(np.sqrt(max(x[0], 1e-12)))
        poles = self.basis.poles
        above_floor = x - floor**2 * denominator_coefficients(poles, size)
        output = self.basis.filter_from_coefficients(above_floor)
        weights_input = self.basis.filter_from_coefficients(y)
        return Weights(floor=float(floor), output=output, input=weights_input)


def scale_unknowns(forms: Any, scale: Float[np.ndarray, "n"]) -> Any:
    """Matrices that multiply the unknowns, each divided by the size of its unknown."""
    return forms / scale[:, None, None, None]


def denominator_coefficients(poles: Sequence[float], size: int) -> Float[np.ndarray, "K"]:
    """Cosine coefficients of the weights' squared denominator, from its poles."""
    denominator = np.real(np.poly(poles)) if len(poles) else np.ones(1)
    whole = np.convolve(denominator, denominator[::-1])[len(denominator) - 1 :]
    return np.pad(whole, (0, size - len(whole)))
