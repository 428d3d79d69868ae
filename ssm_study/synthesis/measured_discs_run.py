"""Certificate that the deployed gains tolerate the recorded model error, and result-table columns
on this certificate.

`coverage` is kappa over what the run's own records need at the certificate's weights. Both are
derived from recordings by `verify`: weights that are stored larger need less and prove less, so no
stored number is trusted. Source: docs/trust.md, "Covered".
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ssm_study.certificates.certificate import Design, Observer, StateFeedback
from ssm_study.certificates.problem import NoSolution, linear_algebra_failures_as_no_solution
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import DiscWeights, ModelErrorSpectra, measure_error_spectra
from ssm_study.robustness.coverage_items import DiscRequirement
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import Trajectories
from ssm_study.systems import JacobianBalls

PART = MeasuredDiscs.part
INJECTED = "the observer injects into neurons that enter the output, and the theorem excludes that"
UNPROVED = "no proof was found for these gains"
# Only in records of earlier versions, which did not always look for a proof.
UNSOUGHT = (
    "a model with neurons: a proof takes a minute and more, so where no input repeats and noise "
    "counts as mismatch it is looked for only if synthesis.cover is given"
)
UNKNOWN = "{} the input has next to no power, so nothing separates mismatch from noise there"


def chooses_gains_by_coverage(
    model: Model, requested_coverage: float | None, premise: ModelErrorSpectra
) -> bool:
    """Whether the choice of gains also considers the model error that a certificate would tolerate.
    With neurons, where looking at many gains takes minutes, only if the records separate noise from
    model error, or a coverage is requested."""
    return isinstance(model, SSM) or requested_coverage is not None or premise.separates_noise


def add_coverage_certificate(
    design: Design, model: Model, balls: JacobianBalls, premise: ModelErrorSpectra
) -> Design:
    """Complete a design by a certificate that holds for as large a multiple of the recorded model
    error as possible. Without such a certificate the design stays unchanged."""
    if (
        not design.feasible
        or uncertifiable_loop_reason(design, model)
        or premise.insufficient_records_reason(0.0) is not None
    ):
        return design
    from ssm_study.synthesis import measured_discs_search  # slow to load

    feedback = design.state_feedback
    assert isinstance(feedback, StateFeedback)
    controlled = controlled_system(model, feedback)
    context = VerificationContext(
        system=model.system, controlled=controlled, balls=balls, gains=design.gains
    )
    find = partial(measured_discs_search.certify_largest_coverage, context, premise)
    try:
        with linear_algebra_failures_as_no_solution():
            certificate = find().certificate
    except NoSolution:
        certificate = None
    if certificate is None:
        return design
    extra = dict(design.extra_certificates) | {PART: certificate}
    return replace(design, extra_certificates=extra)


def uncertifiable_loop_reason(design: Design, model: Model) -> str | None:
    """Reason why a design's closed loop cannot be certified against model errors; None if it can
    be."""
    observer = design.observer
    injects = isinstance(observer, Observer) and np.any(getattr(observer, "l_z", 0.0))
    reaches_output = getattr(model.system, "h", np.zeros(1)).any()
    return INJECTED if injects and reaches_output else None


def coverage_columns(
    design: Design,
    model: Model,
    premise: ModelErrorSpectra,
    fresh_premise: ModelErrorSpectra | None = None,
) -> dict[str, Any]:
    """Table columns that compare the model error that a proof tolerates with the recorded one.
    `coverage` is their ratio, or null with its reason if nothing is covered."""
    if not design.feasible:
        return {}
    part = design.extra_certificates.get(PART)
    if not isinstance(part, MeasuredDiscs):
        reason = (
            uncertifiable_loop_reason(design, model)
            or premise.insufficient_records_reason(0.0)
            or UNPROVED
        )
        return {"coverage": None, "coverage_reason": reason}
    missing = premise.insufficient_records_reason(part.centre)
    if missing is not None:
        return {"coverage": None, "coverage_reason": missing}
    weights = disc_weights(part)
    items = premise.requirements(part.centre)
    need, where = weights.largest_required_radius(items)
    coverage = part.kappa / need
    facts: dict[str, Any] = {"coverage": coverage, "coverage_reference": where}
    if part.kappa < need:
        facts |= unknown_coverage_columns(part.kappa, weights, items)
    if fresh_premise is not None and fresh_premise.insufficient_records_reason(part.centre) is None:
        facts["coverage_needed"] = (
            weights.largest_required_radius(fresh_premise.requirements(part.centre))[0] / need
        )
    return facts


@runtime_checkable
class MismatchRecords(Protocol):
    """Interface of a data set's records from which the model error is measured."""

    @property
    def validation(self) -> Trajectories:
        """Records that are reserved for validation of the model."""
        ...

    @property
    def mismatch_records(self) -> Trajectories:
        """Records of the data set that were taken to measure the model error."""
        ...


def relative_radii_for_further_data(
    design: Design,
    model: Model,
    premise: ModelErrorSpectra,
    mismatch: Mismatch,
    fresh_sets: Iterable[MismatchRecords],
    start_up_samples: int,
) -> list[float]:
    """Disc radius that contains the model error in each further data set, relative to the radius
    for the run's own records; empty without a certificate."""
    part = design.extra_certificates.get(PART)
    if (
        not isinstance(part, MeasuredDiscs)
        or premise.insufficient_records_reason(part.centre) is not None
    ):
        return []
    weights = disc_weights(part)
    own_need, _ = weights.largest_required_radius(premise.requirements(part.centre))
    needs = []
    for records in fresh_sets:
        trials = records.mismatch_records
        fresh = measure_error_spectra(model, records.validation, mismatch, start_up_samples, trials)
        need, _ = weights.largest_required_radius(fresh.requirements(part.centre))
        needs.append(need / own_need)
    return needs


def coverage_needed_column(required_radii: Sequence[float]) -> dict[str, Any]:
    """Table column with the largest ratio of model error in new data sets, which no training used,
    to the recorded one."""
    return {"coverage_needed": max(required_radii)} if required_radii else {}


def unknown_coverage_columns(
    kappa: float, weights: DiscWeights, requirements: Sequence[DiscRequirement]
) -> dict[str, Any]:
    """Table columns that leave the coverage empty and name the frequency band in which the input
    had no power."""
    lit = [item for item in requirements if not item.dark]
    if kappa < weights.largest_required_radius(lit)[0]:
        return {}
    band = weights.largest_required_radius([item for item in requirements if item.dark])[1]
    coverage_reason = UNKNOWN.format(f"at {band}")
    return {"coverage": None, "coverage_reason": coverage_reason}


def disc_weights(certificate: MeasuredDiscs) -> DiscWeights:
    """Frequency weights of the disc of model errors for which a stored certificate holds."""
    return DiscWeights(
        floor=certificate.floor, output=certificate.weight_output, input=certificate.weight_input
    )
