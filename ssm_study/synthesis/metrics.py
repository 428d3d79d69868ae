"""Result-table columns that describe a design: feasible, certified, distance from the largest rate,
predicted stability.

Rates and limits: docs/theory.md, [Z26]; margins: `robustness.prediction`.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design, Infeasible, Observer, StateFeedback
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.certificates.withdrawn_parts import TOLERANCE
from ssm_study.columns import EIGENVALUE, ITERATED, Column, iterative_result_column
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage_columns import COLUMNS as COVERAGE_COLUMNS
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sensitivity import noise_gain
from ssm_study.synthesis.deployed import SETS, RangeWithinLimits
from ssm_study.systems import JacobianBalls, StructuredSystem

OPINION = "another solver's opinion, which decides nothing"


def _gain_certificate_columns(side: str, short_name: str, gain_symbol: str) -> tuple[Column, ...]:
    """Declarations of the result-table columns that describe either the controller or the
    observer."""
    title = side.capitalize()
    rate = _rate_column(f"rate_{side}", f"{title} rate, ρ", setting=f"synthesis.rate_{side}")
    requested_rate = replace(rate, better="", head=f"r {short_name}")
    margin = f"{title} LMI margin"
    norm = f"{title} gain ‖{gain_symbol}‖"
    return (
        requested_rate,
        Column(f"{side}_feasible", "boolean", "high", word=f"{title} feasible"),
        Column(f"{side}_certified", "boolean", "high", f"{short_name} cert", f"{title} certified"),
        Column(f"{side}_reason", "string", word=f"Why there is no {side}"),
        Column(f"{side}_margin", "Float64", "high", "", margin, "", ITERATED, EIGENVALUE),
        _rate_column(f"{side}_rate_limit", f"{title} rate limit, ρ"),
        _rate_column(f"{side}_certified_rate", f"{title} rate proved"),
        iterative_result_column(f"{side}_gain_norm", "low", norm, "scaled"),
    )


def _rate_column(name: str, label: str, setting: str = "") -> Column:
    """Declaration of a table column that holds a contraction rate."""
    return Column(name, "Float64", "high", "", label, "1/sample", ITERATED, setting=setting)


CHOICE_COLUMNS = (
    Column("parent_run", "string", word="Refined from run"),
    Column("refinements", "Int64", word="Refined so many times"),
    Column("synthesis_method", "string", head="method", word="Synthesis", setting="synthesis"),
    Column("rates_chosen", "string", word="Rates chosen by auto", setting="synthesis.rate"),
)

PROOF_COLUMNS = (
    *_gain_certificate_columns("controller", "ctl", "K"),
    *_gain_certificate_columns("observer", "obs", "L"),
    Column("infeasible_reason", "string", word="Why it is infeasible"),
    Column("uncertified_reason", "string", word="Why it is not certified"),
    Column(
        "synthesis_seconds",
        "Float64",
        "low",
        word="Synthesis time",
        unit="s",
        unchecked="depends on when it ran",
    ),
    iterative_result_column("certified_tolerance", "high", "Mismatch gain tolerated in total"),
    *COVERAGE_COLUMNS,
)

LIMIT_COLUMNS = (
    iterative_result_column("limit_lower", "", "Input limited from", "unit of the input"),
    iterative_result_column("limit_upper", "", "Input limited to", "unit of the input"),
    iterative_result_column(
        "limited_rate", "high", "Rate proved from everywhere, input limited", "1/sample"
    ),
    iterative_result_column(
        "unlimited_from", "low", "Outputs with the full rates, lowest", "output unit"
    ),
    iterative_result_column(
        "unlimited_to", "high", "Outputs with the full rates, highest", "output unit"
    ),
)

MISMATCH_COLUMNS = (
    iterative_result_column(
        "noise_gain_model", "low", "Sensor noise on the model's output", "share of the noise"
    ),
    iterative_result_column("mismatch_gain", "low", "Model mismatch gain in total"),
    iterative_result_column("mismatch_seen", "low", "Largest mismatch gain of any record"),
    iterative_result_column("mismatch_in_loop", "low", "Mismatch gain of trials in closed loop"),
    iterative_result_column("mismatch_spread", "low", "Uncertainty of the mismatch"),
)

STABILITY_MARGIN = iterative_result_column(
    "resolved_margin", "high", "Stability margin", "–", "margin"
)
PREDICTION_COLUMNS = (
    iterative_result_column("mismatch_margin", "high", "Mismatch margin in total", "–", "in total"),
    replace(STABILITY_MARGIN, shown=True),
    iterative_result_column(
        "sine_margin", "high", "Stability margin with single sines after the choice", "–"
    ),
    iterative_result_column(
        "controller_radius", "low", "Spectral radius of the controller", "–", "ctl radius"
    ),
    iterative_result_column("noise_peak", "low", "Sensor noise at rest, its peak", "bands"),
    Column(
        "predicted_stable", "boolean", "high", "predicted", "Plant predicted stable", shown=True
    ),
    Column(
        "predicted_faster",
        "boolean",
        "high",
        word="Predicted to settle sooner than without control",
    ),
)

OPINION_COLUMNS = (
    Column("lmi_*_status", "string", unchecked=OPINION),
    Column("lmi_*_certified", "boolean", unchecked=OPINION),
)

COLUMNS = (
    *CHOICE_COLUMNS,
    *PROOF_COLUMNS,
    *LIMIT_COLUMNS,
    *MISMATCH_COLUMNS,
    *PREDICTION_COLUMNS,
    *OPINION_COLUMNS,
)


def design_columns(
    design: Design, model: Model, balls: JacobianBalls, mismatch: Mismatch
) -> dict[str, Any]:
    """Table columns of a design: feasible, certified, distance from the largest provable rate, gain
    sizes, predicted stability.
    """
    facts = proof_columns(design)
    if not design.feasible:
        return facts
    tolerance = design.extra_certificates.get(TOLERANCE)
    facts["certified_tolerance"] = getattr(tolerance, "tolerated_gain", None)
    facts |= input_limit_columns(design, model)
    facts["noise_gain_model"] = noise_gain(model.system, design.gain_pair, balls)
    facts |= model_error_columns(mismatch)
    prediction = predict_margins(model, design.gain_pair, balls, mismatch)
    facts |= vars(prediction)
    facts["predicted_stable"] = prediction.predicts_stability()
    return facts


def proof_columns(design: Design) -> dict[str, Any]:
    """Table columns of a design that follow from its certificates alone, such as rates and gain
    sizes."""
    feedback = design.state_feedback
    observer = design.observer
    facts = certificate_columns("controller", feedback)
    facts |= certificate_columns("observer", observer)
    facts["controller_certified_rate"] = design.certified_rate("state_feedback")
    facts["observer_certified_rate"] = design.certified_rate("observer")
    if not design.feasible:
        facts["infeasible_reason"] = infeasible_reason(design)
    elif not design.certified:
        facts["uncertified_reason"] = uncertified_reason(design)
    return facts


def infeasible_reason(design: Design) -> str:
    """Reasons why the controller or the observer of a design has no certificate, as one text."""
    parts = (design.state_feedback, design.observer)
    reasons = [part.reason for part in parts if isinstance(part, Infeasible)]
    return "; ".join(reasons)


def uncertified_reason(design: Design) -> str:
    """Text that names the certificates of a design that exact arithmetic does not confirm, and
    why."""
    sides = {"controller": design.state_feedback, "observer": design.observer}
    missed = []
    for side, part in sides.items():
        if not part.certified:
            missed.append(f"{side}: {part.solver_status}")
    return "; ".join(missed)


def model_error_columns(mismatch: Mismatch) -> dict[str, Any]:
    """Table columns with the sizes of the model error that the records show."""
    facts: dict[str, Any] = {
        "mismatch_gain": mismatch.gain,
        "mismatch_seen": mismatch.largest_recorded_gain,
        "mismatch_spread": mismatch.spread,
    }
    if mismatch.loop is not None:
        facts["mismatch_in_loop"] = mismatch.loop.gain
    return facts


def input_limit_columns(design: Design, model: Model) -> dict[str, Any]:
    """Table columns of what is proved under input limits; no columns if nothing is proved."""
    within_limits = RangeWithinLimits.from_certificate(model, design.extra_certificates)
    if within_limits is None:
        return {}
    limits: Any = design.extra_certificates[SETS]
    limit_rows = limits.limits.T
    lower, upper = model.scale.physical_input(limit_rows)
    everywhere = within_limits.everywhere
    limited_rate = everywhere and everywhere.rate
    facts: dict[str, Any] = {"limited_rate": limited_rate}
    facts |= common_range_columns("limit_lower", "limit_upper", lower, upper)
    outputs = within_limits.lower, within_limits.upper
    return facts | common_range_columns("unlimited_from", "unlimited_to", *outputs)


def common_range_columns(
    lower_column: str,
    upper_column: str,
    lower: Float[np.ndarray, "c"],
    upper: Float[np.ndarray, "c"],
) -> dict[str, float]:
    """Two table columns with the intersection of the channels' ranges; no columns if it is
    empty."""
    shared_lower = float(lower.max())
    shared_upper = float(upper.min())
    if shared_lower < shared_upper:
        return {lower_column: shared_lower, upper_column: shared_upper}
    return {}


def paper_feasibility_columns(design: Design, model: Model, balls: JacobianBalls) -> dict[str, Any]:
    """Table columns on whether an independent solver finds the matrix inequalities of Zakwan et al.
    feasible at a design's rates."""
    from ssm_study.synthesis.lmi import (
        certificate_from_paper_lmi,
    )  # CVXPY takes half a second to import

    feedback = design.state_feedback
    observer = design.observer
    # Of neurons [Z26] says nothing.
    linear_system = getattr(model, "system", None)
    has_neurons = isinstance(linear_system, StructuredSystem)
    if has_neurons or isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
        return {}
    controller_problem = ("controller", feedback.rate, StateFeedbackOfBall, balls.input)
    observer_problem = ("observer", observer.rate, ObserverOfBall, balls.output)
    problems: Any = (controller_problem, observer_problem)
    facts: dict[str, Any] = {}
    for side, rate, theorem, ball in problems:
        opinion = certificate_from_paper_lmi(model.linear, ball, rate, theorem)
        facts[f"lmi_{side}_status"] = opinion.solver_status
        facts[f"lmi_{side}_certified"] = opinion.certified
    return facts


def certificate_columns(
    side: str, certificate: StateFeedback | Observer | Infeasible
) -> dict[str, Any]:
    """Table columns that describe the certificate of the controller or of the observer; without
    values if there is no certificate."""
    facts: dict[str, Any] = {
        f"rate_{side}": certificate.rate,
        f"{side}_feasible": not isinstance(certificate, Infeasible),
        f"{side}_certified": certificate.certified,
        f"{side}_rate_limit": certificate.rate_limit,
    }
    if isinstance(certificate, Infeasible):
        facts[f"{side}_reason"] = certificate.reason
    else:
        facts[f"{side}_margin"] = certificate.margin
        facts[f"{side}_gain_norm"] = certificate.gain_norm
    return facts
