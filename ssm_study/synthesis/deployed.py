"""Certificates for the chosen gains of controller and observer: largest rates, tolerated model
error, limited inputs.

All are about the very gains that are deployed: `theorems/deployed_rate.py`, `measured_discs.py`,
`limited_input.py`, `unlimited_start.py`; docs/theory.md, "The gains that are deployed".
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import invert_map
from ssm_study.certificates.certificate import (
    OF_LIMITS,
    Design,
    GainTheorem,
    Infeasible,
    ProblemCertificate,
    StateFeedback,
)
from ssm_study.certificates.problem import NoSolution, linear_algebra_failures_as_no_solution
from ssm_study.certificates.theorem import Theorem, VerificationContext
from ssm_study.certificates.theorems import deployed_rate
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.limited_input import LimitedFeedback, certify_under_limits
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.unlimited_start import certify_unlimited_start
from ssm_study.certificates.withdrawn_parts import TOLERANCE
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import JacobianBalls

Inputs = Float[np.ndarray, "m"]
Outputs = Float[np.ndarray, "p"]
EVERYWHERE, SETS = OF_LIMITS  # as `certificate.json` names them


def add_gain_certificates(
    design: Design, model: Model, balls: JacobianBalls, limits: tuple[Inputs, Inputs] | None = None
) -> Design:
    """Complete a design by all further certificates that can be proved for its gains, each decided
    in exact arithmetic. They are largest rates, tolerance, and the effect of physical input
    `limits`."""
    bare_design = replace(design, extra_certificates={})
    design = add_largest_rate_certificates(bare_design)
    tolerance = tolerance_certificate(design, model, balls)
    extra = dict(design.extra_certificates)
    if tolerance is not None:
        extra[TOLERANCE] = tolerance
    design = replace(design, extra_certificates=extra)
    if limits is None:
        return design
    limited = certify_under_input_limits(model, design, *limits)
    return replace(design, extra_certificates=extra | limited)


def add_largest_rate_certificates(design: Design) -> Design:
    """Complete a design by certificates of the largest contraction rates that can be proved for its
    gains, each decided in exact arithmetic."""
    certificates = dict(design.extra_certificates)
    sides = {"state_feedback": design.state_feedback, "observer": design.observer}
    for side, part in sides.items():
        if isinstance(part, Infeasible) or not part.certified:
            continue
        find = partial(certificate_at_largest_rate, part)
        fastest = certificate_or_none(find)
        if fastest is not None:
            certificates[f"{side}_deployed"] = fastest
    return replace(design, extra_certificates=certificates)


def tolerance_certificate(design: Design, model: Model, balls: JacobianBalls) -> Theorem | None:
    """Certificate of the largest model error, as a gain from the input, with which the closed loop
    is proved to come to rest. None for gains certified by another class, and if none is proved."""
    feedback = design.state_feedback
    observer = design.observer
    if isinstance(observer, ObserverOfBall):
        is_known = isinstance(feedback, StateFeedbackOfBall)
    else:
        is_known = isinstance(observer, StructuredObserver)
    if not is_known or not isinstance(feedback, StateFeedback):
        return None
    controlled = controlled_system(model, feedback)
    context = VerificationContext(
        system=model.system, controlled=controlled, balls=balls, gains=design.gains
    )
    from ssm_study.synthesis import measured_discs_search  # slow to load

    find = partial(measured_discs_search.certify_largest_radius, context)
    return certificate_or_none(find)


def certificate_at_largest_rate(certificate: GainTheorem) -> GainTheorem | None:
    """Certificate of the largest contraction rate for a gain that is certified at a smaller one;
    None if no larger rate is proved.

    A plug-in's theorem says itself how (`GainTheorem.certificate_at_largest_rate`).
    """
    if not isinstance(certificate, ProblemCertificate):
        return certificate.certificate_at_largest_rate()
    if hasattr(certificate, "lambda_"):
        from ssm_study.synthesis import structured_lmi  # CVXPY only with neurons

        return structured_lmi.certify_largest_rate(certificate)
    return deployed_rate.certificate_at_largest_rate(certificate)


def certify_under_input_limits(
    model: Model, design: Design, lower: Inputs, upper: Inputs
) -> dict[str, Any]:
    """Certificates, keyed by name, of what a design's gains achieve when the input is limited.
    Empty for neurons, without a certificate, or for limits that do not enclose the equilibrium."""
    extra = design.extra_certificates
    deployed_feedback = extra.get("state_feedback_deployed")
    limited_feedback = extra.get("state_feedback_limited")
    parts = (design.state_feedback, deployed_feedback, limited_feedback)
    feedbacks = [part for part in parts if isinstance(part, StateFeedbackOfBall) and part.certified]
    ends = (lower, upper)
    scaled_ends = [model.scale.scaled_input(end) for end in ends]
    limits = np.stack(scaled_ends, axis=1)
    can_fall = limits[:, 0] < 0
    can_rise = limits[:, 1] > 0
    hold_rest = (can_fall & can_rise).all()
    if not feedbacks or not isinstance(model, SSM) or not hold_rest:
        return {}
    find = partial(certify_under_limits, feedbacks[0])
    everywhere = certificate_or_none(find)
    certificates: dict[str, Any] = {EVERYWHERE: everywhere}
    if isinstance(everywhere, StateFeedbackOfBall):
        feedbacks.append(everywhere)
    corners = equilibrium_corners(model)
    if corners is not None:
        feedbacks_k = feedbacks[0].k
        internal_states = feedbacks_k.shape[1] - model.order
        internal_rows = (0, internal_states)
        no_columns = (0, 0)
        corners = np.pad(corners, (internal_rows, no_columns))
        certify = partial(certify_unlimited_start, feedbacks, corners, limits)
        certificates[SETS] = certificate_or_none(certify)
    return {label: part for label, part in certificates.items() if part is not None}


def equilibrium_corners(model: SSM) -> Float[np.ndarray, "n j"] | None:
    """Equilibrium states of a model at which the outputs are the corners of a box around zero; None
    if there is no such box. Of two corners opposite to each other one is returned.

    Their hull with the mirror images holds every rest point whose outputs lie in the box. With
    outputs that answer at once (D), several rest points of one output, or outputs that a nonlinear
    S_y couples there is no such box: None.
    """
    inverse = invert_map(model.scaffold_out.as_portable())
    rest, _, gain = model.linear.equilibrium_basis()
    outputs, dimension = gain.shape
    has_known_dimension = dimension in (1, outputs)
    tells_state = has_known_dimension and np.linalg.matrix_rank(gain) == dimension
    linear_d = model.linear.d
    if linear_d.any() or inverse is None or not tells_state:
        return None
    sign_rows = [(1.0, *more) for more in product((-1.0, 1.0), repeat=outputs - 1)]
    signs = np.array(sign_rows).T
    if inverse.matrix is not None:
        diagonal = np.diagonal(inverse.matrix)
        off_diagonal = inverse.matrix - np.diag(diagonal)
        if np.count_nonzero(off_diagonal):
            signs = inverse.matrix @ signs
    pseudo_inverse = np.linalg.pinv(gain)
    corners: Float[np.ndarray, "n j"] = rest @ pseudo_inverse @ signs
    return corners


def scaled_equilibrium_states(
    model: SSM, stored_starts: Float[np.ndarray, "s j"]
) -> Float[np.ndarray, "s j"] | None:
    """Equilibrium states of a model, scaled to the size of a certificate's initial states; None if
    they cannot be computed."""
    corners = equilibrium_corners(model)
    if corners is None or not corners.any() or len(stored_starts) < len(corners):
        return None
    largest_start = np.abs(stored_starts).max()
    largest_corner = np.abs(corners).max()
    share = largest_start / largest_corner
    internal_states = len(stored_starts) - len(corners)
    internal_rows = (0, internal_states)
    no_columns = (0, 0)
    padded: Float[np.ndarray, "s j"] = np.pad(share * corners, (internal_rows, no_columns))
    return padded


@dataclass(frozen=True, kw_only=True, repr=False)
class RangeWithinLimits:
    """Range of initial outputs from which a closed loop is proved never to reach its input limits.
    `everywhere` is the proof with inputs cut at the limits, or None."""

    lower: Outputs
    upper: Outputs
    everywhere: LimitedFeedback | None

    def __repr__(self) -> str:
        lower = np.array2string(self.lower, precision=4)
        upper = np.array2string(self.upper, precision=4)
        rate = "at no rate"
        if self.everywhere is not None:
            rate = f"at rate {math.floor(1e4 * self.everywhere.rate) / 1e4:g} per sample"
        lines = (
            "RangeWithinLimits",
            f"  at the full rate  from equilibria with outputs from {lower} to {upper}",
            f"  globally          {rate}, inputs cut at the limits",
        )
        return "\n".join(lines)

    @classmethod
    def from_certificate(
        cls, model: Model, certificates: Mapping[str, Any]
    ) -> "RangeWithinLimits | None":
        """Range of initial outputs from which stored certificates prove that no input limit is
        reached; None if no such range is certified."""
        if SETS not in certificates or not isinstance(model, SSM):
            return None
        stored_starts = certificates[SETS].starts
        starts = scaled_equilibrium_states(model, stored_starts)
        if starts is None:
            return None
        low, high = initial_output_range(model, starts)
        everywhere = certificates.get(EVERYWHERE)
        return cls(lower=low, upper=high, everywhere=everywhere)


def prove_within_input_limits(
    model: SSM, design: Design, lower: Inputs, upper: Inputs
) -> RangeWithinLimits:
    """Prove what a design achieves while its input stays within given physical limits. Raises
    `BadRequest` if nothing can be proved."""
    design.controller_and_observer()
    rest = model.scale.input_equilibrium
    lowest = lower.tolist()
    highest = upper.tolist()
    limits = (lowest, highest)
    problem = "do not enclose the input at rest"
    remedy = "widen them or choose another operating point"
    holds_rest = (lower < rest) & (rest < upper)
    require(holds_rest.all(), "input limits", limits, problem, remedy)
    certificates = certify_under_input_limits(model, design, lower, upper)
    proof = RangeWithinLimits.from_certificate(model, certificates)
    if proof is None:
        raise BadRequest(
            "input limits", limits, "nothing is proved within them", "request smaller rates"
        )
    return proof


def initial_output_range(
    model: SSM, initial_states: Float[np.ndarray, "s j"]
) -> tuple[Outputs, Outputs]:
    """Smallest and largest initial output, in physical units, over given initial states and their
    mirror images about the equilibrium."""
    linear_c = model.linear.c
    start_states = initial_states[: model.order]
    read = (linear_c @ start_states).T
    both_signs = [read, -read]
    mirrored = np.concatenate(both_signs)
    ends = model.scale.physical_output(model.scaffold_out(mirrored))
    lowest_output = ends.min(axis=0)
    highest_output = ends.max(axis=0)
    return lowest_output, highest_output


def certificate_or_none(find_certificate: Callable[[], Theorem | None]) -> Theorem | None:
    """Call a function that searches for a certificate; None if it raises `NoSolution`. Numbers that
    exceed floating point end it, too; the design remains."""
    try:
        with linear_algebra_failures_as_no_solution():
            return find_certificate()
    except NoSolution:
        return None
