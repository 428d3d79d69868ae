"""Choice of the fastest design whose proof covers the records, among designs that are predicted to
be stable.

Neighbours in the order of expected response are alike, so ever fewer of them are looked at: the
first, second, third, fifth, ... . Coverage is that of the frequency inequality, without filters and
P; the chosen design's is then decided exactly. Source: docs/theory.md, "Measured discs";
docs/closed_loop.md, "Rates chosen for you".
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design, StateFeedback
from ssm_study.certificates.problem import NoSolution, linear_algebra_failures_as_no_solution
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import Premise
from ssm_study.robustness.coverage_items import Item
from ssm_study.synthesis.measured_discs_run import exclusion_reason, is_coverage_sought
from ssm_study.systems import Balls, StructuredSystem

LOOKED_AT = (0, 1, 2, 4, 7, 11, 16, 23, 32, 45, 60, 85, 120, 170, 240, 320)  # of one layer
NEAR = 60  # a covered pair from farther down the order is made faster by the search
WITH_NEURONS = (0, 3, 10, 25)  # each takes seconds
LOST = 1.02  # kappa by frequency over that of the certificate, at most (as a rule)
LOST_WITH_NEURONS = 1.03  # their larger programs are solved less exactly
COVERED = "best expected response of those predicted to be stable and covered"
SEARCHED = "gains searched around the grid's, predicted to be stable and covered"
NOT_COVERED = (
    "best expected response of those predicted to be stable; no design looked at is covered"
)
LESS_COVERED = f"{COVERED}, though less than synthesis.cover asks for"
PREDICTED = "best expected response of those predicted to be stable"
Make = Callable[[Any], Design | None]
Search = Callable[[Design, Design, float], Design | None]


def prefer_covered(
    pairs: Iterator[Any],
    make: Make,
    model: Model,
    balls: Balls,
    premise: Premise | None,
    cover: float | None,
    search: Search | None = None,
) -> tuple[Design | None, str]:
    """First design whose proof covers the records, otherwise the best substitute, and which of
    these it is. Substitutes are the result of a search around the design that covers most, then the
    first that is covered at all, then the first.

    `search(first, most, cover)` is given the first design, the one that covers most, and the
    coverage wanted of its certificate. With neurons, where one look takes a second, fewer pairs
    are looked at, and none where the records cannot tell noise from mismatch unless a coverage is
    asked for.
    """
    neurons = isinstance(model.system, StructuredSystem)
    places = WITH_NEURONS if neurons else LOOKED_AT
    sought = premise is not None and is_coverage_sought(model, cover, premise)
    judged = premise is not None and sought and premise.missing(0.0) is None
    lost = proof_loss(model)
    target = lost * (1.0 if cover is None else cover)
    seen = SeenDesigns(lost=lost)
    for place, pair in enumerate(islice(pairs, places[-1] + 1)):
        if seen.first is not None and place not in places:
            continue
        design = make(pair)
        if design is None:
            continue
        if premise is None or not judged or exclusion_reason(design, model):
            return seen.first or design, PREDICTED
        coverage = coverage_by_frequency(design, model, balls, premise, target, seen.largest)
        if coverage >= target and place <= NEAR:
            return design, COVERED
        seen.add_design(design, coverage)
        if coverage >= target:
            break
    if search is not None:
        searched = seen.search_around(search, target / lost)
        if searched is not None:
            return searched, SEARCHED
    return seen.best_substitute(target)


def proof_loss(model: Model) -> float:
    """Coverage by frequency over that of its certificate, at most (as a rule)."""
    return LOST_WITH_NEURONS if isinstance(model.system, StructuredSystem) else LOST


@dataclass(kw_only=True)
class SeenDesigns:
    """Designs considered so far: the first, the first that is covered at all, and the one with the
    `largest` coverage, `most`. `lost` is the loss of a proof."""

    lost: float = LOST
    first: Design | None = None
    barely: Design | None = None
    most: Design | None = None
    largest: float = 0.0

    def add_design(self, design: Design, coverage: float) -> None:
        """Add a design with its coverage to the designs considered."""
        self.first = self.first or design
        if self.barely is None and coverage >= self.lost:
            self.barely = design
        if self.most is None or coverage > self.largest:
            self.most = design
            self.largest = coverage

    def best_substitute(self, target: float) -> tuple[Design | None, str]:
        """Design to take where no search has led to another, and which one it is."""
        if self.largest >= target:
            return self.most, COVERED
        if self.barely is not None:
            return self.barely, LESS_COVERED
        return self.first, NOT_COVERED

    def search_around(self, search: Search, target: float) -> Design | None:
        """Design found by a random search around the one with the largest coverage; None if there
        is none."""
        if self.first is None or self.most is None:
            return None
        return search(self.first, self.most, target)


@dataclass(frozen=True, kw_only=True)
class LoopCoverage:
    """Coverage of any gains of one loop, frequency by frequency, for the records of one premise.
    `deciding` holds the angles around each centre that decided the last gains, where solving is
    slow."""

    context: VerificationContext
    items: dict[float, tuple[Item, ...]]
    deciding: dict[float, Float[np.ndarray, "D"]]

    @classmethod
    def from_premise(
        cls, model: Model, controlled: Any, balls: Balls, premise: Premise
    ) -> "LoopCoverage":
        """Prepare the computation of the coverage for one loop, with the requirements that the
        records make."""
        from ssm_study.synthesis.measured_discs_search import CENTRES

        context = VerificationContext(
            system=model.system, controlled=controlled, balls=balls, gains={}
        )
        items = {}
        for centre in CENTRES:
            items[centre] = tuple(item for item in premise.items(centre) if item.seen > 0)
        return cls(context=context, items=items, deciding=dict.fromkeys(CENTRES, np.zeros(0)))

    def largest_radius_around(
        self, gains: dict[str, Any], centre: float, least: float = 0.0
    ) -> float:
        """Largest radius of a disc of model errors around one centre that given gains tolerate;
        zero if there is none. Where it is below `least`, an upper bound that is, too."""
        from ssm_study.synthesis.measured_discs_program import LoopForms
        from ssm_study.synthesis.measured_discs_search import select_theorem
        from ssm_study.synthesis.measured_discs_weights import (
            COARSE,
            JOINT,
            WeightBasis,
            WeightProgram,
        )

        context = replace(self.context, gains=gains)
        forms = LoopForms.from_context(select_theorem(context), context, (centre,))
        grid = forms.at_angles(forms.frequency_grid)
        is_large = isinstance(self.context.system, StructuredSystem)
        program = WeightProgram(
            forms=forms,
            grid=grid,
            centre=centre,
            items=self.items[centre],
            basis=WeightBasis(),
            tolerance=COARSE if is_large else JOINT,
        )
        try:
            with linear_algebra_failures_as_no_solution():
                nu, _, deciding = program.maximise_radius_from(self.deciding[centre], least**2)
        except NoSolution:
            return 0.0
        if is_large:
            self.deciding[centre] = deciding
        return float(max(nu, 0.0) ** 0.5)

    def largest_radius(
        self, gains: dict[str, Any], enough: float = np.inf, least: float = 0.0
    ) -> tuple[float, float]:
        """Largest radius of a disc of model errors that given gains tolerate, over all centres, and
        the best centre. The search ends at the first radius that is `enough`; below `least` the
        radius may be an upper bound."""
        best = (0.0, next(iter(self.items)))
        for centre in self.items:
            radius = self.largest_radius_around(gains, centre, max(best[0], least))
            best = max(best, (radius, centre))
            if best[0] >= enough:
                break
        return best


def coverage_by_frequency(
    design: Design,
    model: Model,
    balls: Balls,
    premise: Premise,
    enough: float = np.inf,
    least: float = 0.0,
) -> float:
    """Largest radius of a disc of model errors that a design tolerates, computed frequency by
    frequency. The search ends at the first radius that is `enough`; below `least` the radius may be
    an upper bound."""
    feedback = design.state_feedback
    assert isinstance(feedback, StateFeedback)
    system = controlled_system(model, feedback)
    loop = LoopCoverage.from_premise(model, system, balls, premise)
    return loop.largest_radius(design.gains, enough, least)[0]
