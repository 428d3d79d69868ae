"""Random search near given gains for other gains whose certificate tolerates a larger model error.

Each round scales every entry of K and L at random (`exp(step * normal)`), drops what is slower than
allowed, and keeps the best of the rest: the largest coverage until the target is met, then the
smallest area at which it still is. The step grows where a round helps and shrinks where none does.
Rounds beyond those planned follow while their pace would reach the target.
Coverage is that of the frequency inequality around one centre; what comes out is certified exactly.
Rounds and random numbers are fixed, so the outcome is the same on every run.
Source: docs/closed_loop.md, "Rates chosen for you"; docs/theory.md, "Measured discs".
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design, Observer, StateFeedback
from ssm_study.certificates.problem import NoSolution, linear_algebra_failures_as_no_solution
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.models.structured import Model
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sensitivity import controller_spectral_radius
from ssm_study.signals import Ends, Trajectories
from ssm_study.synthesis.decay_response import NO_DECAYS, largest_settling_time_ratios
from ssm_study.synthesis.deployed import certificate_at_largest_rate
from ssm_study.synthesis.expected_response import FASTER
from ssm_study.synthesis.integrated_error import relative_response_areas
from ssm_study.synthesis.measured_discs_choice import LoopCoverage, coverage_overestimate_factor
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate, coverage_columns
from ssm_study.synthesis.slope_search import (
    EVALUATED,
    FIRST_STEP,
    LARGEST_STEP,
    LENGTHEN,
    SHORTEN,
    SMALLEST_STEP,
    ScoredGains,
    SlopeSearch,
)
from ssm_study.systems import Gains, JacobianBalls, StructuredSystem

PROPOSALS = 8  # pairs of gains in one round
CERTIFICATES = 3  # proofs of coverage tried
MORE = 1.01  # by which the search aims beyond what the last proof lost
LEAST_PROVED = 0.8  # of the target: what proves less is no small loss
LEAST_RATE = 1e-9  # any larger one is stored
SEED = 0


@dataclass(frozen=True, kw_only=True)
class GainSearch:
    """Random search near the gains of a design for gains that tolerate a larger model error or
    respond faster.

    `largest_area` is the slowest response allowed, in areas of the open loop on the model; `margin`
    the stability margin that the prediction must exceed. For a model with neurons, where one
    coverage takes tenths of a second, the slopes of coverage guide the search (`slope_search`), if
    the solver gives them.
    """

    model: Model
    balls: JacobianBalls
    premise: ModelErrorSpectra
    mismatch: Mismatch
    validation: Trajectories
    limits: Ends | None
    margin: float
    decays: Float[np.ndarray, "N T p"] = field(default_factory=lambda: NO_DECAYS)

    def improve_design(
        self, start_design: Design, target_coverage: float, rounds: int, largest_area: float
    ) -> Design | None:
        """Fastest certified design of a random search that has the required coverage (ratio of
        proved to recorded model error); None if there is none.

        A proof covers a little less than the computation by frequency suggests, so the search aims
        beyond the target. If it ends between target and aim, the proof is tried nevertheless. If a
        proof covers too little, the search aims higher by what was missing, and ends if it finds
        nothing better.
        """
        wanted_coverage = coverage_overestimate_factor(self.model) * target_coverage
        proved_gains: Gains | None = None
        for _ in range(CERTIFICATES):
            best = self.search_best_gains(start_design, wanted_coverage, rounds, largest_area)
            nothing_better = proved_gains is not None and has_equal_gains(best.gains, proved_gains)
            if best.coverage < target_coverage or nothing_better:
                return None
            design = self.certify_gains(start_design, best.gains)
            if design is None:
                return None
            proved = self.proved_coverage(design)
            if proved > wanted_coverage and isinstance(self.model.system, StructuredSystem):
                return self._faster_design(design, target_coverage, rounds)
            if proved >= target_coverage:
                return design
            if best.coverage < wanted_coverage:
                return None
            start_design = design
            proved_gains = start_design.gain_pair
            proved_or_least = max(proved, LEAST_PROVED * target_coverage)
            wanted_coverage = MORE * wanted_coverage * target_coverage / proved_or_least
        return None

    def _faster_design(self, covered: Design, target_coverage: float, rounds: int) -> Design:
        """Search for a faster design near one that covers more than required; the same design if
        none covers enough. The search looks at one disc centre, and a proof around another may
        cover more."""
        aim = coverage_overestimate_factor(self.model) * target_coverage
        area = self.response_area(covered.gain_pair)
        best = self.search_best_gains(covered, aim, rounds, area)
        if best.coverage < aim or has_equal_gains(best.gains, covered.gain_pair):
            return covered
        faster = self.certify_gains(covered, best.gains)
        if faster is None or self.proved_coverage(faster) < target_coverage:
            return covered
        return faster

    def proved_coverage(self, design: Design) -> float:
        """Coverage of a design (ratio of proved to recorded model error), decided exactly; zero
        without a certificate."""
        proved = add_coverage_certificate(design, self.model, self.balls, self.premise)
        columns = coverage_columns(proved, self.model, self.premise)
        return columns.get("coverage") or 0.0

    def response_area(self, gains: Gains) -> float:
        """Area under the simulated closed-loop response with given gains, relative to the open
        loop."""
        return self._response_areas([gains])[0]

    def search_best_gains(
        self, start_design: Design, aimed_coverage: float, rounds: int, largest_area: float
    ) -> ScoredGains:
        """Search for the fastest gains whose coverage (ratio of tolerated to recorded model error)
        reaches the aimed one; the gains are not yet certified."""
        feedback = start_design.state_feedback
        assert isinstance(feedback, StateFeedback)
        controlled = controlled_system(self.model, feedback)
        loop = LoopCoverage.from_model(self.model, controlled, self.balls, self.premise)
        start_gains = start_design.gain_pair.matrices_by_symbol
        coverage, centre = loop.largest_disc_radius(start_gains)
        area = self.response_area(start_design.gain_pair)
        best = ScoredGains(gains=start_design.gain_pair, area=area, coverage=coverage)
        allowed = max(largest_area, area)
        random = np.random.default_rng(SEED)
        first_ratios = self._settling_time_ratios([start_design.gain_pair])
        slowest = max(FASTER, first_ratios[0])
        if isinstance(self.model.system, StructuredSystem):
            guided = SlopeSearch(
                loop=loop,
                centre=centre,
                aimed_coverage=aimed_coverage,
                largest_area=allowed,
                response_areas=self._response_areas,
                is_acceptable=lambda gains: self._is_acceptable(gains, slowest),
                evaluations=rounds * EVALUATED,
                random=random,
            )
            best_by_slopes = guided.search_from(best)
            if best_by_slopes is not None:
                return best_by_slopes
        step = FIRST_STEP
        reached = [best.coverage]
        while is_worth_another_round(reached, aimed_coverage, rounds):
            proposal_numbers = range(PROPOSALS)
            proposals = [scale_gains_at_random(best.gains, step, random) for _ in proposal_numbers]
            fast = self._faster_proposals(proposals, slowest)
            trials = self._score_proposals(fast, loop, centre, best, aimed_coverage, allowed)
            better = self._best_stable_proposal(trials, best, aimed_coverage)
            step *= SHORTEN if better is None else LENGTHEN
            large_step = max(step, SMALLEST_STEP)
            step = min(large_step, LARGEST_STEP)
            best = better or best
            reached.append(best.coverage)
        return best

    def _is_acceptable(self, gains: Gains, slowest_ratio: float) -> bool:
        """Whether gains may be deployed: stable controller, predicted stability on the plant, and a
        faster response than recorded decays."""
        ratios = self._settling_time_ratios([gains])
        if ratios[0] >= slowest_ratio:
            return False
        if controller_spectral_radius(self.model.system, gains, self.balls) >= 1:
            return False
        prediction = predict_margins(self.model, gains, self.balls, self.mismatch)
        return prediction.predicts_stability(self.margin)

    def _score_proposals(
        self,
        proposals: list[Gains],
        loop: "LoopCoverage",
        centre: float,
        best: ScoredGains,
        aimed_coverage: float,
        largest_area: float,
    ) -> list[ScoredGains]:
        """Score proposed gains whose simulated response is fast enough and whose controller is
        itself stable."""
        if not proposals:
            return []
        is_covered = best.coverage >= aimed_coverage
        allowed = best.area if is_covered else largest_area
        least = min(best.coverage, aimed_coverage)
        trials = []
        areas = self._response_areas(proposals)
        for gains, area in zip(proposals, areas, strict=True):
            if (
                area > allowed
                or controller_spectral_radius(self.model.system, gains, self.balls) >= 1
            ):
                continue
            matrices = gains.matrices_by_symbol
            coverage = loop.largest_disc_radius_at_centre(matrices, centre, least)
            scored_gains = ScoredGains(gains=gains, area=area, coverage=coverage)
            trials.append(scored_gains)
        return trials

    def _best_stable_proposal(
        self, proposals: list[ScoredGains], best: ScoredGains, aimed_coverage: float
    ) -> ScoredGains | None:
        """Best of the proposed gains that are predicted to be stable and surpass the best gains so
        far; None if there are none."""
        leader: ScoredGains | None = None
        for trial in proposals:
            if not trial.is_better_than(leader or best, aimed_coverage):
                continue
            prediction = predict_margins(self.model, trial.gains, self.balls, self.mismatch)
            if prediction.predicts_stability(self.margin):
                leader = trial
        return leader

    def _faster_proposals(self, proposals: list[Gains], largest_ratio: float) -> list[Gains]:
        """Proposed gains with which the closed loop settles faster, by a required factor, than the
        plant did in records without control."""
        ratios = self._settling_time_ratios(proposals)
        proposals_and_ratios = zip(proposals, ratios, strict=True)
        return [gains for gains, ratio in proposals_and_ratios if ratio < largest_ratio]

    def _settling_time_ratios(self, proposals: list[Gains]) -> list[float]:
        """Settling times of the closed loops with proposed gains, relative to those of the recorded
        decays without control."""
        stacked_gains = stack_gains(proposals)
        band = self.mismatch.scaled_settling_band
        ratios = largest_settling_time_ratios(
            self.model, stacked_gains, self.decays, band, self.limits
        )
        return [float(ratio) for ratio in ratios]

    def _response_areas(self, proposals: list[Gains]) -> list[float]:
        """Area under the simulated closed-loop response with each of several proposed gains,
        divided by the area in open loop."""
        stacked_gains = stack_gains(proposals)
        areas = relative_response_areas(self.model, stacked_gains, self.validation, self.limits)
        return [float(area) for area in areas]

    def certify_gains(self, start_design: Design, gains: Gains) -> Design | None:
        """Design with given gains, certified at the largest contraction rates that can be proved
        for them. None if a certificate is missing."""
        feedback, observer = start_design.controller_and_observer()
        new_feedback = certify_replaced_gains(feedback, k=gains.k)
        injected: dict[str, Any] = {"l": gains.l}
        if gains.l_z is not None:
            injected["l_z"] = gains.l_z
        new_observer = certify_replaced_gains(observer, **injected)
        if not isinstance(new_feedback, StateFeedback) or not isinstance(new_observer, Observer):
            return None
        return Design(state_feedback=new_feedback, observer=new_observer)


def has_equal_gains(first: Gains, second: Gains) -> bool:
    """Whether two pairs of controller and observer have equal gain matrices."""
    ones = first.matrices_by_symbol
    others = second.matrices_by_symbol
    if ones.keys() != others.keys():
        return False
    return all(np.array_equal(ones[symbol], others[symbol]) for symbol in ones)


def is_worth_another_round(coverages: Sequence[float], target_coverage: float, rounds: int) -> bool:
    """Whether a random search for gains is worth a further round, given the best coverage (ratio of
    tolerated to recorded model error) after each round.

    The first `rounds` always are. After them a round is worth it only if as many rounds again, at
    the pace of the last `rounds`, would reach the target.
    """
    done = len(coverages) - 1
    if done < rounds:
        return True
    last = coverages[-1]
    earlier = coverages[done - rounds]
    return earlier > 0 and last < target_coverage <= last * (last / earlier)


def certify_replaced_gains(certificate: Any, **gains: Any) -> Any:
    """Certificate of changed gains for the largest contraction rate that the theorem of a given
    certificate proves; None if it proves none."""
    try:
        with linear_algebra_failures_as_no_solution():
            slow_part = replace(certificate, rate=LEAST_RATE, **gains)
            return certificate_at_largest_rate(slow_part)
    except NoSolution:
        return None


def scale_gains_at_random(gains: Gains, step: float, random: np.random.Generator) -> Gains:
    """Multiply every entry of given controller and observer gains by its own random factor."""

    def scale_entries_at_random(matrix: Any) -> Any:
        """Multiply every entry of a matrix by its own random factor."""
        normal_draws = random.standard_normal(matrix.shape)
        factors = np.exp(step * normal_draws)
        return matrix * factors

    l_z = None if gains.l_z is None else scale_entries_at_random(gains.l_z)
    k = scale_entries_at_random(gains.k)
    l_of_plant = scale_entries_at_random(gains.l)
    return replace(gains, k=k, l=l_of_plant, l_z=l_z)


def stack_gains(proposals: list[Gains]) -> Gains:
    """Stack the gains of several pairs of controller and observer into one batch."""
    injections = [gains.l_z for gains in proposals if gains.l_z is not None]
    controller_gains = [gains.k for gains in proposals]
    k = np.stack(controller_gains)
    observer_gains = [gains.l for gains in proposals]
    l_ = np.stack(observer_gains)
    l_z = np.stack(injections) if injections else None
    return replace(proposals[0], k=k, l=l_, l_z=l_z)
