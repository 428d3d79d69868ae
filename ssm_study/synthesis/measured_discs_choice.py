"""Choice of the fastest design whose certificate holds for the recorded model error, among designs
predicted stable.

Neighbours in the order of expected response are alike, so ever fewer of them are looked at: the
first, second, third, fifth, ... . Coverage is that of the frequency inequality, without filters and
P; the chosen design's is then decided exactly. Source: docs/theory.md, "Measured discs";
docs/closed_loop.md, "Rates chosen for you".
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design, StateFeedback
from ssm_study.certificates.problem import NoSolution, linear_algebra_failures_as_no_solution
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.robustness.coverage_items import DiscRequirement
from ssm_study.synthesis.measured_discs_run import (
    chooses_gains_by_coverage,
    uncertifiable_loop_reason,
)
from ssm_study.systems import JacobianBalls, StructuredSystem

if TYPE_CHECKING:
    from ssm_study.synthesis.radius_optimum import RadiusOptimum

LOOKED_AT = (0, 1, 2, 4, 7, 11, 16, 23, 32, 45, 60, 85, 120, 170, 240, 320)  # of one layer
WITH_NEURONS = (0, 3, 10, 25)  # each takes a second
FARTHER = (60, 120, 240)  # also, with neurons, where a coverage is asked for
NEAR = 60  # gains are searched around pairs up to here before farther ones are looked at
OVERESTIMATE = 1.02  # coverage by frequency over the proved one, at most (as a rule)
OVERESTIMATE_WITH_NEURONS = 1.03  # their larger programs are solved less exactly
COVERED = "best expected response of those predicted to be stable and covered"
SEARCHED = "gains searched around the grid's, predicted to be stable and covered"
NOT_COVERED = (
    "best expected response of those predicted to be stable; no design looked at is covered"
)
LESS_COVERED = f"{COVERED}, though less than synthesis.cover asks for"
PREDICTED = "best expected response of those predicted to be stable"
Make = Callable[[Any], Design | None]
Search = Callable[[Design, Design, float], Design | None]


def choose_covering_design(
    pairs: Iterator[Any],
    make_design: Make,
    model: Model,
    balls: JacobianBalls,
    premise: ModelErrorSpectra | None,
    requested_coverage: float | None,
    search: Search | None = None,
) -> tuple[Design | None, str]:
    """First design that tolerates the recorded model error, or else the best design that does not,
    and a text that says which of them it is. Substitutes are the result of a search around the
    design that covers most, then the first that is covered at all, then the first.

    `search(first, most, cover)` is given the first design, the one that covers most, and the
    coverage wanted of its certificate. With neurons, where one look takes a second, fewer pairs
    are looked at, and none where the records cannot tell noise from mismatch unless a coverage is
    asked for.
    """
    places: tuple[int, ...] = LOOKED_AT
    if isinstance(model.system, StructuredSystem):
        places = WITH_NEURONS if requested_coverage is None else WITH_NEURONS + FARTHER
    excess = coverage_overestimate_factor(model)
    target = excess * (1.0 if requested_coverage is None else requested_coverage)
    walk = GainPairSearch(
        pairs=iter(enumerate(pairs)), make=make_design, places=places, excess=excess, target=target
    )
    first = walk.first_certified_design()
    if first is None or premise is None:
        return first, PREDICTED
    if not chooses_gains_by_coverage(model, requested_coverage, premise):
        return first, PREDICTED
    if premise.insufficient_records_reason(0.0) is not None or uncertifiable_loop_reason(
        first, model
    ):
        return first, PREDICTED

    deciding: dict[float, Any] = {}

    def compute_coverage(design: Design, least: float) -> float:
        """Coverage of one design (ratio of tolerated to recorded model error), computed frequency
        by frequency."""
        return tolerated_disc_radius(design, model, balls, premise, target, least, deciding)

    covered = walk.first_covered_design(compute_coverage, NEAR)
    if covered is not None:
        return covered, COVERED
    wanted_coverage = target / excess
    substitute = walk.search_near_best_design(search, wanted_coverage)
    if substitute is not None:
        return substitute, SEARCHED
    covered = walk.first_covered_design(compute_coverage, walk.places[-1])
    if covered is None:
        return walk.best_design_below_target()
    substitute = walk.search_near_best_design(search, wanted_coverage)
    return (covered, COVERED) if substitute is None else (substitute, SEARCHED)


def coverage_overestimate_factor(model: Model) -> float:
    """Largest factor by which a coverage computed frequency by frequency usually exceeds the proved
    one. Both are ratios of tolerated to recorded model error."""
    return OVERESTIMATE_WITH_NEURONS if isinstance(model.system, StructuredSystem) else OVERESTIMATE


@dataclass(kw_only=True)
class GainPairSearch:
    """Search through pairs of controller and observer gains, fastest response first, for one that
    tolerates the recorded model error.

    Kept are the first design, the first that is covered `barely`, and the one with the `largest`
    coverage, `most`. `excess` is the factor by which a coverage computed frequency by
    frequency may exceed the proved one.
    """

    pairs: Iterator[tuple[int, Any]]
    make: Make
    places: tuple[int, ...]
    excess: float
    target: float
    first: Design | None = None
    barely: Design | None = None
    most: Design | None = None
    largest: float = 0.0
    unseen: Design | None = None

    def first_certified_design(self) -> Design | None:
        """Design of the first pair of gains that can be certified, in order of expected response;
        `None` if no pair near the fastest can be."""
        for place, pair in self.pairs:
            design = self.make(pair)
            if design is not None:
                self.first = design
                self.unseen = design
                return design
            if place >= NEAR:
                break
        return None

    def first_covered_design(
        self, compute_coverage: Callable[[Design, float], float], last_place: int
    ) -> Design | None:
        """First design in a search that tolerates the target multiple of the recorded model error;
        None if no design up to a given index does."""
        for design in self._examined_designs(last_place):
            coverage = compute_coverage(design, self.largest)
            self._add_design(design, coverage)
            if coverage >= self.target:
                return design
        return None

    def _examined_designs(self, last_place: int) -> Iterator[Design]:
        """Designs, up to a given index in the search, for which the tolerated model error is to be
        computed."""
        if self.unseen is not None:
            design = self.unseen
            self.unseen = None
            yield design
        last = max(place for place in self.places if place <= last_place)
        for place, pair in self.pairs:
            design_here = self.make(pair) if place in self.places else None
            if design_here is not None:
                yield design_here
            if place >= last:
                return

    def _add_design(self, design: Design, coverage: float) -> None:
        """Store a design if its coverage (ratio of tolerated to recorded model error) is the
        largest so far or the first sufficient one."""
        if self.barely is None and coverage >= self.excess:
            self.barely = design
        if self.most is None or coverage > self.largest:
            self.most = design
            self.largest = coverage

    def best_design_below_target(self) -> tuple[Design | None, str]:
        """Best design of a search in which no design tolerates the required model error, and a text
        that says what is proved for the best one."""
        if self.barely is not None:
            return self.barely, LESS_COVERED
        return self.first, NOT_COVERED

    def search_near_best_design(
        self, search_near_design: Search | None, target_coverage: float
    ) -> Design | None:
        """Design from a random search near the design that tolerates the largest model error; None
        if the search finds none."""
        if search_near_design is None or self.first is None or self.most is None:
            return None
        return search_near_design(self.first, self.most, target_coverage)


@dataclass(frozen=True, kw_only=True)
class LoopCoverage:
    """Coverage (ratio of tolerated to recorded model error) of any gains in one closed loop,
    computed frequency by frequency. `deciding` holds the angles around each centre that decided the
    last gains, where solving is slow."""

    context: VerificationContext
    items: dict[float, tuple[DiscRequirement, ...]]
    deciding: dict[float, Float[np.ndarray, "D"]]

    @classmethod
    def from_model(
        cls,
        model: Model,
        controlled_system: Any,
        balls: JacobianBalls,
        premise: ModelErrorSpectra,
        deciding_angles: dict[float, Float[np.ndarray, "D"]] | None = None,
    ) -> "LoopCoverage":
        """Prepare the data from which the model error that any gains tolerate in one closed loop is
        computed."""
        from ssm_study.synthesis.measured_discs_search import CENTRES

        context = VerificationContext(
            system=model.system, controlled=controlled_system, balls=balls, gains={}
        )
        items = {}
        for centre in CENTRES:
            items[centre] = tuple(item for item in premise.requirements(centre) if item.seen > 0)
        return cls(
            context=context,
            items=items,
            deciding={} if deciding_angles is None else deciding_angles,
        )

    def largest_disc_radius_at_centre(
        self, gains: dict[str, Any], centre: float, least_radius: float = 0.0
    ) -> float:
        """Largest radius of a disc of model errors, with a given centre, that given gains tolerate.
        If it is below `least_radius`, it may be an upper bound."""
        optimum = self.radius_optimum_at_centre(gains, centre, least_radius)
        return 0.0 if optimum is None else optimum.radius

    def radius_optimum_at_centre(
        self, gains: dict[str, Any], centre: float, least_radius: float = 0.0
    ) -> "RadiusOptimum | None":
        """Largest disc of model errors, with a given centre, that given gains tolerate; None if
        they tolerate none. If it is below `least_radius`, it may be an upper bound."""
        from ssm_study.synthesis.measured_discs_program import LoopForms
        from ssm_study.synthesis.measured_discs_search import select_theorem
        from ssm_study.synthesis.measured_discs_weights import (
            COARSE,
            JOINT,
            NO_ANGLES,
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
        start_angles = self.deciding.get(centre, NO_ANGLES)
        try:
            with linear_algebra_failures_as_no_solution():
                optimum = program.maximise_radius_from(start_angles, least_radius**2)
        except NoSolution:
            return None
        if is_large:
            self.deciding[centre] = optimum.deciding_angles
        return optimum

    def largest_disc_radius(
        self, gains: dict[str, Any], sufficient_radius: float = np.inf, least_radius: float = 0.0
    ) -> tuple[float, float]:
        """Largest radius of a disc of model errors that given gains tolerate, and the centre of
        this disc. The search ends at the first radius that is `sufficient_radius`; below
        `least_radius` the radius may be an upper bound."""
        best = (0.0, next(iter(self.items)))
        for centre in self.items:
            radius = self.largest_disc_radius_at_centre(gains, centre, max(best[0], least_radius))
            best = max(best, (radius, centre))
            if best[0] >= sufficient_radius:
                break
        return best


def tolerated_disc_radius(
    design: Design,
    model: Model,
    balls: JacobianBalls,
    premise: ModelErrorSpectra,
    sufficient_radius: float = np.inf,
    least_radius: float = 0.0,
    deciding_angles: dict[float, Float[np.ndarray, "D"]] | None = None,
) -> float:
    """Largest radius of a disc of model errors that a design tolerates, computed frequency by
    frequency. The search ends at the first radius that is `sufficient_radius`; below `least_radius`
    the radius may be an upper bound."""
    feedback = design.state_feedback
    assert isinstance(feedback, StateFeedback)
    system = controlled_system(model, feedback)
    loop = LoopCoverage.from_model(model, system, balls, premise, deciding_angles)
    return loop.largest_disc_radius(design.gains, sufficient_radius, least_radius)[0]
