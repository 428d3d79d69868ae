"""Findings on whether the plant comes to rest, and on input amplitudes and frequencies at which the
model error was not measured."""

from collections.abc import Iterator

import numpy as np

from ssm_study.evidence.finding import EvidenceCase, Finding, make_doubt, make_note
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.return_to_rest import (
    AT_REST,
    FAINT,
    is_return_to_rest,
    largest_equilibrium_difference,
    output_after_motion,
    remaining_offset,
)


def judge_return_to_rest(case: EvidenceCase, mismatch: Mismatch) -> Iterator[Finding]:
    """Findings on a plant that does not come to rest, or whose records do not show whether it does.
    A plant that does not come to rest gives a doubt; records that do not show whether it does give
    a note."""
    offset = max((*mismatch.stuck, *_remaining_offsets_of_test_records(case)), default=0.0)
    left = mismatch.left_at_rest
    if not mismatch.plant_comes_to_rest:
        statement = f"{left:.2g} output scales are left at rest input, more than {AT_REST:g}"
        yield make_doubt(
            f"The output does not come to rest by itself ({statement}): no loop is predicted to "
            "settle it."
        )
    elif offset > AT_REST:
        statement = (
            f"After the input has moved it, the output stays {offset:.2g} scales off at rest input"
        )
        yield make_doubt(
            f"{statement}: friction, play or several rests; a loop without integrators may stop "
            "as far off. "
            "Record more returns to rest."
        )
    elif left is None:
        yield _short_rest_finding(case)
    elif left > FAINT:
        statement = (
            f"{left:.2g} output scales are left at rest input: a small limit cycle, or a slow decay"
        )
        yield make_doubt(
            f"{statement}. A loop may swing farther, and settles in no narrower band. Record "
            "longer rests."
        )
    yield from _unmeasured_range_findings(case, mismatch)


def _remaining_offsets_of_test_records(case: EvidenceCase) -> list[float]:
    """Offset or oscillation of the output at the end of each test record whose input moves and is
    then constant for long."""
    response = case.model.linear.impulse_response_length()
    offsets = []
    for record in case.data.test:
        inputs, output = case.scale_record_with_disturbances(record)
        rest = output_after_motion(inputs, output, response)
        if len(rest):
            offsets.append(remaining_offset(rest))
    return offsets


def _short_rest_finding(case: EvidenceCase) -> Finding:
    """Finding that the input is constant too briefly in all records to show whether the plant comes
    to rest."""
    records = case.data.mismatch_records
    returns = [record for record in records if is_return_to_rest(record)]
    spread = largest_equilibrium_difference(case.model.scale, returns)
    problem = "No two returns to rest input outlast the model's response"
    # what the short ones show is no proof of friction, and no reason for silence
    if spread > AT_REST:
        statement = f"{problem}, and they end {spread:.2g} scales apart, where none seems to move"
        return make_doubt(f"{statement}: friction, play or a slow mode. Record longer ones.")
    return make_note(f"{problem}: whether the output rests by itself is unknown; add such returns.")


def _unmeasured_range_findings(case: EvidenceCase, mismatch: Mismatch) -> Iterator[Finding]:
    """Findings on amplitudes and frequencies of the input at which no record shows the model
    error."""
    if len(mismatch.views) == 1:
        amplitude = f"{mismatch.views[0].amplitude:.2g} input scales, rms"
        yield make_note(
            f"All records have one amplitude ({amplitude}): below it the mismatch is unknown."
        )
    if mismatch.unexcited:
        lowest = min(mismatch.unexcited)
        hertz = lowest / (2 * np.pi * case.data.step_s)
        bands = f"{len(mismatch.unexcited)} of {len(ANGLES)} bands, from {hertz:.3g} Hz"
        yield make_note(f"The input has no power in {bands}: the mismatch is poorly known there.")
