"""Search for the largest disc of model errors, with frequency weights, that given gains are proved
to tolerate.

One convex program gives weights, multipliers and kappa (`measured_discs_program`); kappa is then
taken a little back and the weights widened where the loop does not mind, since weights that are
tight to one record overfit it. Spectral factors make filters of them, one Riccati equation the
matrix P, and exact arithmetic decides. Source: docs/theory.md, "Measured discs".
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.problem import NoSolution
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.certificates.theorems.measured_discs_structured import StructuredMeasuredDiscs
from ssm_study.robustness.coverage import DiscWeights, ModelErrorSpectra
from ssm_study.robustness.coverage_items import DiscRequirement
from ssm_study.synthesis.measured_discs_metric import first_exact_certificate
from ssm_study.synthesis.measured_discs_program import (
    MOST,
    VIOLATED,
    FormsAtAngles,
    FrequencyProgram,
    LoopForms,
    form_norms,
)
from ssm_study.synthesis.measured_discs_weights import (
    LARGEST,
    WeightBasis,
    WeightProgram,
    initial_weights,
)
from ssm_study.systems import StructuredSystem

Multipliers = Float[np.ndarray, "A"]
Unknowns = Float[np.ndarray, "n"]

CENTRES = (-0.25, 0.0)  # of discs, tried in turn; farther ones hold `e = 0` only when they are wide
INSIDE = (0.985, 0.96, 0.9, 0.8)  # shares of the largest kappa, in order of trial
COST_AT_GIVEN_WEIGHTS = 1e-10  # of each multiplier; small, so that kappa keeps seven digits
REFINED = 100  # relative change of nu, over the accuracy, by which a finer grid ends the refinement
ROUGH = 1e-6  # accuracy that is enough for a certificate inside the optimum
CLOSE = (0.999, 0.997, 0.99, 0.97, 0.9)  # likewise, where no weights have to be found
# `|e| <= kappa |u|` alone; a floor of this size lets no model output in.
_ONE = np.ones((1, 1))
INPUT_ALONE = DiscWeights(floor=1e-9, output=0 * _ONE, input=_ONE)
ROOMS = (1e-3, 1e-2)  # margins by frequency, in units of each free signal's own weight
SMALLEST = 1e-4  # of nu: below, nothing is worth a proof
FARTHEST = 30.0  # of a multiplier, over that of the optimum: one that costs nothing would run away


@dataclass(frozen=True, kw_only=True)
class CoverageResult:
    """Certificate against model errors with its coverage (ratio of proved to recorded model error),
    or the reason why there is none."""

    certificate: MeasuredDiscs | None
    coverage: float | None
    reason: str
    reference: str = ""

    @property
    def covers_records(self) -> bool:
        """Whether a certificate holds for at least the model error in the records."""
        return self.coverage is not None and self.coverage >= 1


def select_theorem(context: VerificationContext) -> type[MeasuredDiscs]:
    """Class of the theorem on closed loops with bounded model errors, one for models with neurons
    and another for models without."""
    neurons = isinstance(context.system, StructuredSystem)
    return StructuredMeasuredDiscs if neurons else MeasuredDiscs


def certify_largest_radius(
    context: VerificationContext,
    weights: DiscWeights = INPUT_ALONE,
    centre: float = 0.0,
    radius_factors: Sequence[float] = CLOSE,
) -> MeasuredDiscs | None:
    """Certificate with the largest radius of the disc of model errors for given weights; None if
    none is certified. Default weights are those of the tolerated gain."""
    started = time.perf_counter()
    theorem = select_theorem(context)
    try:
        optimum = _largest_squared_radius(theorem, context, weights, centre, ROUGH)
        nu, multipliers, deciding = optimum
        if not 0 < nu < LARGEST:
            return None
        forms = LoopForms.from_context(theorem, context, (centre,))
        for share in radius_factors:
            smaller_nu = nu * share**2
            multipliers, margin = _maximise_margin(
                forms, weights, centre, smaller_nu, multipliers, deciding
            )
            kappa = smaller_nu**0.5
            numbers = _theorem_variables(forms, weights, centre, kappa, multipliers)
            proof = first_exact_certificate(theorem, context, numbers, margin, started)
            if proof is not None:
                return proof
    except NoSolution:
        return None
    return None


def optimum_for_weights(
    theorem: type[MeasuredDiscs], context: VerificationContext, weights: DiscWeights, centre: float
) -> tuple[float, Multipliers]:
    """Largest squared radius of the disc of model errors for given weights, computed frequency by
    frequency, and its multipliers. `kappa^2`. Raises `NoSolution`."""
    nu, multipliers, _ = _largest_squared_radius(theorem, context, weights, centre, VIOLATED)
    return nu, multipliers


def _largest_squared_radius(
    theorem: type[MeasuredDiscs],
    context: VerificationContext,
    weights: DiscWeights,
    centre: float,
    accuracy: float,
) -> tuple[float, Multipliers, list[int]]:
    """Largest squared disc radius and multipliers for given weights, with the grid frequencies that
    decide them."""
    forms = LoopForms.from_context(theorem, context, (centre,))
    grid = forms.at_angles(forms.frequency_grid)
    coarse = len(grid.angles)
    chosen = list[int]()
    nu = np.inf
    for _ in range(3):  # finer around the angles that decide
        before = nu
        program, scale = _program_at_fixed_weights(grid, weights, centre)
        goal = np.full(program.linear.shape[0], -COST_AT_GIVEN_WEIGHTS)
        goal[0] = 1.0
        x, chosen = program.maximise(goal, accuracy, first_angles=chosen)
        nu = float(x[0] / scale[0])
        if abs(before - nu) <= REFINED * accuracy * nu:
            break
        lowest = program.smallest_eigenvalues(x)
        tightest = np.argsort(lowest)[:4]
        deciding = grid.angles[tightest]
        finer = additional_grid_frequencies(deciding, grid.angles)
        fresh = np.setdiff1d(finer, grid.angles)
        grid = grid.combine_with(forms.at_angles(fresh))
    multipliers = np.maximum(x[1:] / scale[1:], 0.0)
    return nu, multipliers, [index for index in chosen if index < coarse]


def additional_grid_frequencies(
    deciding: Float[np.ndarray, "D"], angles: Float[np.ndarray, "F"]
) -> Float[np.ndarray, "N"]:
    """Additional grid frequencies around each frequency whose constraint limits the disc radius."""
    ascending = np.sort(angles)
    last = len(ascending) - 1
    fine = []
    for angle in deciding:
        place = int(np.searchsorted(ascending, angle))
        lower = ascending[max(place - 1, 0)]
        upper = ascending[min(place + 1, last)]
        fine.append(np.linspace(lower, upper, 41))
    return np.concatenate(fine)


def _reference_form_at(grid: FormsAtAngles, weights: DiscWeights) -> Any:
    """Weighted quadratic form of model output and input, to which the model error is compared, at
    each frequency of a grid."""
    on_model = weights.output_weight(grid.angles)[:, None, None]
    on_input = weights.input_weight(grid.angles)[:, None, None]
    return on_model * grid.model + on_input * grid.input


def _box_constrained_program(
    constant: Any, linear: Any, scale: Unknowns, upper_bounds: Unknowns
) -> FrequencyProgram:
    """Optimisation problem with one matrix constraint per grid frequency and scaled unknowns
    between zero and given bounds."""
    unknowns = len(scale)
    identity = np.eye(unknowns)
    rows = np.concatenate([identity, -identity])
    bounds = np.concatenate([np.zeros(unknowns), -upper_bounds])
    scaled = linear / scale[:, None, None, None]
    return FrequencyProgram(constant=constant, linear=scaled, rows=rows, bounds=bounds)


def _program_at_fixed_weights(
    grid: FormsAtAngles, weights: DiscWeights, centre: float
) -> tuple[FrequencyProgram, Unknowns]:
    """Optimisation problem for the radius of a disc of model errors and the multipliers at fixed
    weights, with constraints at the frequencies of a grid."""
    reference = _reference_form_at(grid, weights)
    linear = np.concatenate([-reference[None], grid.multipliers])
    scale = form_norms(linear)
    most = np.full(len(scale), MOST)
    most[0] = LARGEST * scale[0]
    program = _box_constrained_program(grid.centred[centre], linear, scale, most)
    return program, scale


def _maximise_margin(
    forms: LoopForms,
    weights: DiscWeights,
    centre: float,
    squared_radius: float,
    multipliers: Multipliers,
    first_angles: Sequence[int],
) -> tuple[Multipliers, float]:
    """Multipliers that prove a given radius of the disc of model errors with the largest margin,
    and this margin. The margin is in units of each free signal's own weight."""
    grid = forms.at_angles(forms.frequency_grid)
    own_weights = initial_weights(forms, centre, multipliers)
    root = 1 / np.sqrt(own_weights)
    units = np.outer(root, root)  # each free signal in units of its own weight
    disc = grid.centred[centre] - squared_radius * _reference_form_at(grid, weights)
    constant = disc * units
    identity = np.eye(len(root))
    margin_form = -np.broadcast_to(identity, grid.model.shape)
    linear = np.concatenate([grid.multipliers * units, margin_form[None]])
    scale = form_norms(linear)
    unknowns = len(scale)
    most = np.full(unknowns, FARTHEST)
    program = _box_constrained_program(constant, linear, scale, most)
    goal = np.zeros(unknowns)
    goal[-1] = 1.0
    x, _ = program.maximise(goal, ROUGH, first_angles=first_angles)
    unscaled = x / scale
    margin = float(unscaled[-1])
    best_multipliers = np.maximum(unscaled[:-1], 0.0)
    return best_multipliers, margin


def _theorem_variables(
    forms: LoopForms, weights: DiscWeights, centre: float, kappa: float, multipliers: Multipliers
) -> dict[str, Any]:
    """Variables of the theorem on discs of model errors as a certificate stores them, except the
    metric P."""
    numbers: dict[str, Any] = {"centre": centre, "kappa": kappa, "floor": weights.floor}
    numbers |= {"weight_output": weights.output, "weight_input": weights.input}
    numbers["lambda_out"] = np.zeros(0)
    least = 1e-9 * multipliers.max()  # a multiplier is positive; one at zero moves nothing
    positive_multipliers = np.maximum(multipliers, least)
    for (name, _), value in zip(forms.names, positive_multipliers, strict=True):
        if name == "lambda_p":
            numbers[name] = float(value)
        else:
            values_so_far = numbers.get(name, np.zeros(0))
            numbers[name] = np.append(values_so_far, value)
    return numbers


def certify_largest_coverage(
    context: VerificationContext,
    premise: ModelErrorSpectra,
    centres: Sequence[float] = CENTRES,
    basis: WeightBasis | None = None,
) -> CoverageResult:
    """Certificate with the largest ratio of proved to recorded model error over given disc centres,
    or the reason why there is none.

    If only bands without excitation prevent that the records are covered, the certificate is the
    one for the other bands. Its coverage is below one as soon as all bands count.
    """
    for centre in centres:
        missing = premise.insufficient_records_reason(centre)
        if missing:
            return CoverageResult(certificate=None, coverage=None, reason=missing)
    items = {}
    excited_items = {}
    for centre in centres:
        requirements = premise.requirements(centre)
        items[centre] = [item for item in requirements if item.seen > 0]
        excited_items[centre] = [item for item in items[centre] if not item.dark]
    basis = basis or WeightBasis()
    whole = _certify_largest_coverage_at_centres(context, items, basis)
    has_both = all(excited_items.values()) and excited_items != items
    if whole.covers_records or not has_both:
        return whole
    partial = _certify_largest_coverage_at_centres(context, excited_items, basis)
    return partial if partial.covers_records else whole


def _certify_largest_coverage_at_centres(
    context: VerificationContext,
    requirements: dict[float, list[DiscRequirement]],
    basis: WeightBasis,
) -> CoverageResult:
    """Certificate with the largest ratio of proved to recorded model error, among bounds that are
    discs around given centres."""
    started = time.perf_counter()
    theorem = select_theorem(context)
    forms = LoopForms.from_context(theorem, context, tuple(requirements))
    grid = forms.at_angles(forms.frequency_grid)
    optima = list[tuple[float, Any, WeightProgram]]()
    for centre, some in requirements.items():
        program = WeightProgram(
            forms=forms, grid=grid, centre=centre, items=tuple(some), basis=basis
        )
        try:
            nu, unknowns = program.maximise_radius()
        except NoSolution:
            continue
        if nu > SMALLEST:
            optima.append((nu, unknowns, program))
    optima.sort(key=lambda optimum: -optimum[0])
    for nu, unknowns, program in optima:
        coverage = _certify_optimum(context, theorem, program, nu, unknowns, started)
        if coverage is not None:
            return coverage
    return CoverageResult(
        certificate=None, coverage=None, reason="nothing is proved at these gains"
    )


def _certify_optimum(
    context: VerificationContext,
    theorem: type[MeasuredDiscs],
    program: WeightProgram,
    squared_radius: float,
    unknowns: Unknowns,
    start_time: float,
) -> CoverageResult | None:
    """Certificate made from jointly optimised weights and multipliers; None if exact arithmetic
    refuses it."""
    for inside in INSIDE:
        scaled = squared_radius * inside**2
        for room in ROOMS:
            try:
                chosen = program.widen_weights(scaled, unknowns, room)
                weights = program.weights_from_unknowns(scaled, chosen)
            except NoSolution:
                continue
            unscaled_multipliers = chosen[program.coefficient_count :]
            multipliers = np.maximum(unscaled_multipliers, 0.0)
            kappa = scaled**0.5
            numbers = _theorem_variables(program.forms, weights, program.centre, kappa, multipliers)
            proof = first_exact_certificate(theorem, context, numbers, room, start_time)
            if proof is not None:
                need, where = weights.largest_required_radius(program.items)
                covered = proof.kappa / need
                return CoverageResult(
                    certificate=proof, coverage=covered, reason="", reference=where
                )
    return None
