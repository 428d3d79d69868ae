"""Choice of the fastest design whose proof covers what the records show, among those that are
predicted to be stable.

Neighbours in the order of expected response are alike, so ever fewer of them are looked at: the
first, second, third, fifth, ... . Coverage is that of the frequency inequality, without filters and
P; the chosen design's is then decided exactly. Source: docs/theory.md, "Measured discs";
docs/closed_loop.md, "Rates chosen for you".
"""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np

from ssm_study.certificates.certificate import Design, StateFeedback
from ssm_study.certificates.problem import NoSolution, within_floats
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import Premise
from ssm_study.synthesis.measured_discs_run import exclusion_reason
from ssm_study.systems import Balls, StructuredSystem

LOOKED_AT = (0, 1, 2, 4, 7, 11, 16, 23, 32, 45, 60)  # places in the order, of one layer
FARTHER = (85, 120, 170, 240, 320)  # also, where more than one is asked for
WITH_NEURONS = (0, 3, 10, 25)  # each takes seconds
LOST = 1.02  # kappa by frequency over that of the certificate, at most (as a rule)
COVERED = "best expected response of those predicted to be stable and covered"
NOT_COVERED = (
    "best expected response of those predicted to be stable; no design looked at is covered"
)
LESS_COVERED = f"{COVERED}, though less than synthesis.cover asks for"
PREDICTED = "best expected response of those predicted to be stable"
Make = Callable[[Any], Design | None]


def prefer_covered(
    pairs: Iterator[Any],
    make: Make,
    model: Model,
    balls: Balls,
    premise: Premise | None,
    cover: float | None,
) -> tuple[Design | None, str]:
    """The first design among some of these pairs that is covered as asked for, else the first that
    is covered at all, else the first; and which of these it is.

    With neurons, where one look takes seconds, only where a coverage is asked for.
    """
    neurons = isinstance(model.system, StructuredSystem)
    places = WITH_NEURONS if neurons else LOOKED_AT + (FARTHER if cover is not None else ())
    looks = premise is not None and (cover is not None or not neurons)
    judged = premise is not None and looks and premise.missing(0.0) is None
    target = LOST * (1.0 if cover is None else cover)
    first: Design | None = None
    barely: Design | None = None
    for place, pair in enumerate(islice(pairs, places[-1] + 1)):
        if first is not None and place not in places:
            continue
        design = make(pair)
        if design is None:
            continue
        first = first or design
        if premise is None or not judged or exclusion_reason(design, model):
            return first, PREDICTED
        coverage = coverage_by_frequency(design, model, balls, premise, target)
        if coverage >= target:
            return design, COVERED
        if barely is None and coverage >= LOST:
            barely = design
    return (first, NOT_COVERED) if barely is None else (barely, LESS_COVERED)


def coverage_by_frequency(
    design: Design, model: Model, balls: Balls, premise: Premise, enough: float = np.inf
) -> float:
    """The largest kappa of the joint program over the centres; it ends at the first that is
    `enough`."""
    from ssm_study.synthesis.measured_discs_program import LoopForms
    from ssm_study.synthesis.measured_discs_search import CENTRES, theorem_of
    from ssm_study.synthesis.measured_discs_weights import WeightBasis, WeightProgram

    feedback = design.state_feedback
    assert isinstance(feedback, StateFeedback)
    context = VerificationContext(
        system=model.system,
        controlled=controlled_system(model, feedback),
        balls=balls,
        gains=design.gains,
    )
    forms = LoopForms.of(theorem_of(context), context, CENTRES)
    grid = forms.at(forms.angles)
    largest = 0.0
    for centre in CENTRES:
        items = tuple(item for item in premise.items(centre) if item.seen > 0)
        program = WeightProgram(
            forms=forms, grid=grid, centre=centre, items=items, basis=WeightBasis()
        )
        try:
            with within_floats():
                largest = max(largest, max(program.largest()[0], 0.0) ** 0.5)
        except NoSolution:
            continue
        if largest >= enough:
            break
    return largest
