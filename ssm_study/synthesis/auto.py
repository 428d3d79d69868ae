"""Automatic choice of contraction rates and cost weights from the model and the records alone. It
takes the certified design with the best expected response.

Nothing of the closed-loop test enters. The order of the candidates: `synthesis.expected_response`.
Source: docs/closed_loop.md, "Rates chosen for you"; docs/theory.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.integral_action import count_modes_by_frequency
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model
from ssm_study.refusal import require, require_positive
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sensitivity import gain_peaks_on_grid
from ssm_study.signals import Ends, Trajectories
from ssm_study.synthesis.candidate_grid import CandidateGrid
from ssm_study.synthesis.candidates import GainCandidates
from ssm_study.synthesis.covered_gains import GainSearch
from ssm_study.synthesis.decay_response import NO_DECAYS
from ssm_study.synthesis.design import Synthesis, require_contraction_rate
from ssm_study.synthesis.expected_response import ATTEMPTS, FASTER, ExpectedResponse, RankedPair
from ssm_study.synthesis.measured_discs_choice import Search, choose_covering_design
from ssm_study.synthesis.measured_discs_run import chooses_gains_by_coverage
from ssm_study.systems import JacobianBalls

# Frequencies (rad/sample) that rank the candidates; the chosen one is then judged on a finer grid.
GRID_ANGLES = np.geomspace(1e-3, np.pi, 240)
SHARES = ("stretch_shares", "observer_rates")
WEIGHTS = ("input_weights", "output_noises", "integral_weights")
# Rounds of the search for covered gains, and how much slower they may be on the model.
ROUNDS = 8
SLOWER = 1.15
SLOWER_WITH_NEURONS = 1.6
ROUNDS_ASKED = 40  # where a coverage is asked for
SLOWER_ASKED = 2.5
MOST_COVER = 9  # a little below the coverage at which the search for weights ends
LEAST_RATE = 1e-3  # the least demanding request, where a side is left to `auto`


@dataclass(frozen=True, kw_only=True)
class Auto:
    """Synthesis that chooses the certified design with the best expected response, among those with
    a sufficient stability margin.

    Grids, steps and the choice where no candidate passes: docs/closed_loop.md, "Rates chosen for
    you". With an `internal_model` (`step`, `ramp`, `sine(0.5Hz)`) the weights of its states are one
    more axis; weights alone are of integrators. `limits` of the input, scaled, are set by the run.
    """

    rate: float | str = "auto"
    rate_controller: float | str = "auto"
    rate_observer: float | str = "auto"
    margin: float = 1.0
    stretch_shares: Sequence[float] = (0.05, 0.3, 0.6, 0.9)
    observer_rates: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5)  # absolute: the limit is far
    input_weights: Sequence[float] = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    output_noises: Sequence[float] = (1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    integral_weights: Sequence[float] = ()
    internal_model: Sequence[str] = ()
    limits: Ends | None = None
    cover: float | None = None
    premise: ModelErrorSpectra | None = None
    decays: Float[np.ndarray, "N T p"] = field(default_factory=lambda: NO_DECAYS, repr=False)

    method: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        for name in ("rate", "rate_controller", "rate_observer"):
            rate = getattr(self, name)
            if rate != "auto":
                require_contraction_rate(
                    f"synthesis.{name}", rate, 'use "auto" or a number such as 0.1'
                )
        above_zero = self.margin > 0
        require(above_zero, "synthesis.margin", self.margin, "the margin must be positive", "use 1")
        for name in SHARES:
            self._check_grid(name, upper_bound=1.0, allowed_text="numbers in (0, 1)")
        for name in WEIGHTS:
            self._check_grid(name, upper_bound=np.inf, allowed_text="positive numbers")
        count_modes_by_frequency(self.internal_model)
        if self.cover is not None:
            require_positive("synthesis.cover", self.cover, "use 1, or 1.5 for more")
            is_looked_for = self.cover <= MOST_COVER
            problem = "is more than is looked for"
            remedy = f"ask for at most {MOST_COVER}"
            require(is_looked_for, "synthesis.cover", self.cover, problem, remedy)

    def _check_grid(self, name: str, upper_bound: float, allowed_text: str) -> None:
        """Raise `BadRequest` for a grid of rates or weights that is empty or has a value out of
        range."""
        grid = getattr(self, name)
        may_be_empty = name == "integral_weights"
        in_range = all(0 < value < upper_bound for value in grid)
        fits = in_range and (may_be_empty or len(grid) > 0)
        require(
            fits, f"synthesis.{name}", grid, f"must hold {allowed_text}", "keep the default grid"
        )

    @property
    def internal_model_signals(self) -> tuple[str, ...]:
        """Names of the signals that the internal model generates, such as `step` and `sine`."""
        return tuple(self.internal_model) or ("step",) * bool(self.integral_weights)

    @property
    def grid(self) -> CandidateGrid:
        """Grid of contraction rates and cost weights at which candidate gains of controller and
        observer are computed. A controller or observer without its own rate takes `rate`."""
        return CandidateGrid(
            rate_controller=self._own_or_common_rate(self.rate_controller),
            rate_observer=self._own_or_common_rate(self.rate_observer),
            stretch_shares=self.stretch_shares,
            observer_rates=self.observer_rates,
            input_weights=self.input_weights,
            output_noises=self.output_noises,
            integral_weights=self.integral_weights,
            internal_model_signals=self.internal_model_signals,
        )

    def _own_or_common_rate(self, requested_rate: float | str) -> float | str:
        """Contraction rate set for the controller or the observer alone, or the common rate if that
        setting is `auto`."""
        return self.rate if requested_rate == "auto" else requested_rate

    def compute_candidates(self, model: Model, balls: JacobianBalls) -> GainCandidates | None:
        """Candidate gains at all rates and weights of the grid with a Riccati solution; None if
        controller or observer has no candidate."""
        return self.grid.compute_candidates(model, balls)

    def design(
        self,
        model: Model,
        balls: JacobianBalls,
        validation: Trajectories = (),
        mismatch: Mismatch | None = None,
    ) -> Design:
        """Choose the gains of controller and observer, and verify them in exact arithmetic. If no
        design exists, the result has the reason.

        The mismatch is that of the validation records unless given.
        """
        candidates = self.compute_candidates(model, balls)
        if candidates is None:
            slowest = self._slowest_design(model, balls)
            return self._with_search_outcome(slowest, "nothing on the grid is feasible")
        mismatch = mismatch or measure_model_error(model, validation)
        peaks = loop_gains_on_coarse_grid(model, balls, candidates, mismatch)
        response = ExpectedResponse(
            model=model,
            balls=balls,
            candidates=candidates,
            mismatch=mismatch,
            margin=self.margin,
            decays=self.decays,
        )
        make = CertifiedDesigns(response=response)
        pairs = response.pairs_by_expected_response(peaks, validation, self.limits)
        if self.premise is None or not chooses_gains_by_coverage(model, self.cover, self.premise):
            pairs = islice(pairs, ATTEMPTS)
        search = None
        if self.premise is not None:
            search = self._make_covered_design_search(response, self.premise, validation)
        chosen, status = choose_covering_design(
            pairs, make.certified_stable_design, model, balls, self.premise, self.cover, search
        )
        if chosen is not None:
            status += describe_unsolved_points(candidates)
            return self._with_search_outcome(chosen, status)
        return self._largest_margin_design(model, balls, candidates, peaks)

    def _make_covered_design_search(
        self, response: ExpectedResponse, premise: ModelErrorSpectra, validation: Trajectories
    ) -> Search:
        """Make the function that searches near a design's gains for gains whose certificate covers
        the recorded model error. The search is longer, and accepts slower gains, if a coverage is
        requested."""
        is_asked = self.cover is not None
        has_neurons = not isinstance(response.model, SSM)
        search = GainSearch(
            model=response.model,
            balls=response.balls,
            premise=premise,
            mismatch=response.mismatch,
            validation=validation,
            limits=self.limits,
            margin=self.margin,
            decays=self.decays,
        )
        rounds = ROUNDS_ASKED if is_asked else ROUNDS
        unasked = SLOWER_WITH_NEURONS if has_neurons else SLOWER
        slower = SLOWER_ASKED if is_asked else unasked

        def search_covered_design(
            first_design: Design, best_covered_design: Design, target_coverage: float
        ) -> Design | None:
            """Search near the gains of one design for gains whose certificate holds for the
            recorded model error."""
            first_area = search.response_area(first_design.gain_pair)
            largest_area = min(slower * first_area, FASTER)
            return search.improve_design(best_covered_design, target_coverage, rounds, largest_area)

        return search_covered_design

    def _largest_margin_design(
        self,
        model: Model,
        balls: JacobianBalls,
        candidates: GainCandidates,
        peaks: Float[np.ndarray, "C O"],
    ) -> Design:
        """Design with the largest stability margin among the candidate gains, and why no other
        design was preferred."""
        smallest_peak = np.argmin(peaks)
        best = np.array(np.unravel_index(smallest_peak, peaks.shape))
        specification = candidates.synthesis_settings(best)
        design = specification.design(model, balls)
        status = f"no stable controller with margin above {self.margin:g}; largest margin taken"
        if np.isinf(self.margin):
            status = "the evidence allows no judgement of the plant; largest margin taken"
        unsolved_text = describe_unsolved_points(candidates)
        return self._with_search_outcome(design, status + unsolved_text)

    def with_input_limits(
        self, lower: Float[np.ndarray, "m"], upper: Float[np.ndarray, "m"]
    ) -> "Auto":
        """Copy of the automatic synthesis that compares simulated responses under given input
        limits (scaled, relative to equilibrium).

        Limits without room around rest are not applied.
        """
        can_fall = (lower < 0).all()
        has_room = can_fall and (upper > 0).all()
        return replace(self, limits=(lower, upper)) if has_room else self

    def prefer_covered_designs(self, premise: ModelErrorSpectra) -> "Auto":
        """Copy of this synthesis that prefers designs whose certificate covers the model error seen
        in the records."""
        return replace(self, premise=premise)

    def prefer_faster_than_decays(self, decays: Float[np.ndarray, "N T p"]) -> "Auto":
        """Copy of the automatic synthesis that prefers designs that settle faster than the recorded
        decays without control."""
        return replace(self, decays=decays)

    def with_largest_margin(self) -> "Auto":
        """Copy of the automatic synthesis that chooses the design with the largest stability
        margin."""
        return replace(self, margin=float("inf"))

    def _slowest_design(self, model: Model, balls: JacobianBalls) -> Design:
        """Design at the slowest rates and smallest weights of the grid, which shows why no design
        has a certificate."""
        grid = self.grid
        rates = {"rate_controller": grid.rate_controller, "rate_observer": grid.rate_observer}
        least: Any = {
            name: LEAST_RATE if rate == "auto" else float(rate) for name, rate in rates.items()
        }
        specifications = grid.riccati_settings()
        return replace(specifications[0], **least).design(model, balls)

    def _with_search_outcome(self, design: Design, status: str) -> Design:
        """Copy of a design that records the automatic synthesis as its method, and the outcome of
        the search."""
        feedback = design.state_feedback
        observer = design.observer
        return Design(
            state_feedback=replace(
                feedback, method=self.method, solver_status=f"{status}; {feedback.solver_status}"
            ),
            observer=replace(
                observer, method=self.method, solver_status=f"{status}; {observer.solver_status}"
            ),
        )


@dataclass(kw_only=True)
class CertifiedDesigns:
    """Certified designs from candidate gains, sorted by the expected area under their response on
    the plant, each certified only when needed. Once one is faster than the open loop, slower ones
    are left out."""

    response: ExpectedResponse
    has_faster: bool = False

    def certified_stable_design(self, ranked: RankedPair) -> Design | None:
        """Certified design with the gains of one controller and observer; None if it is not
        certified, or not predicted stable on the plant. A controller that is no faster than none is
        left out while a faster one is predicted."""
        if self.has_faster and not ranked.is_faster:
            return None
        response = self.response
        specification = response.candidates.synthesis_settings(ranked.pair)
        design = specification.design(response.model, response.balls)
        if not design.certified:
            return None
        prediction = predict_margins(
            response.model, design.gain_pair, response.balls, response.mismatch
        )
        if not prediction.predicts_stability(response.margin):
            return None
        self.has_faster = self.has_faster or ranked.is_faster
        return design


def loop_gains_on_coarse_grid(
    model: Model, balls: JacobianBalls, candidates: GainCandidates, mismatch: Mismatch
) -> Float[np.ndarray, "C O"]:
    """Largest loop gain over a coarse frequency grid for every pair of controller and observer;
    infinite where the loop is unstable."""
    weights = mismatch.gain_at(GRID_ANGLES)
    return gain_peaks_on_grid(
        model.system,
        candidates.ks,
        candidates.ls,
        balls,
        GRID_ANGLES,
        weights,
        candidates.l_zs,
        candidates.internal,
    )


def describe_unsolved_points(candidates: GainCandidates) -> str:
    """Text with the number of rates and weights for which no gain could be computed; empty if there
    are none."""
    count = candidates.unsolved
    return f" ({count} of the grid have no solution)" if count else ""


# The same `design`, but it has grids where a Synthesis has one rate and one weight each.
Synthesis.register(Auto)
