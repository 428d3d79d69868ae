"""Search for gains of a model with neurons whose certificate tolerates a larger model error, guided
by derivatives of the coverage.

Each round draws many positions around the best gains at random and takes those that promise the
largest coverage without being slower than allowed, as a linear fit of simulated responses says.
These are simulated, and the most promising one is evaluated; its slopes correct the promises of the
others. Once the aim is met, the fastest position that still promises it is evaluated instead. The
step grows where a round helps and shrinks where none does. Random numbers are fixed.
Source: docs/closed_loop.md, "Rates chosen for you"; docs/theory.md, "Measured discs".
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ssm_study.synthesis.coverage_slopes import (
    CoverageSample,
    GainCoordinates,
    predict_log_coverage,
    sample_coverage,
)
from ssm_study.synthesis.measured_discs_choice import LoopCoverage
from ssm_study.systems import Gains

DRAWN = 2000  # positions in a round
SIMULATED = 64  # positions in a round whose responses are simulated
REMEMBERED = 256  # simulated areas, by which those of further positions are predicted
UNUSABLE = (
    4.0  # multiple of the largest area allowed: larger ones say nothing of those near the best
)
EVALUATED = 4  # positions in a round whose coverage is computed, at most: until one is better
FIRST_STEP = 0.15  # standard deviation of the logarithm of each entry's factor
LARGEST_STEP = 0.3
SMALLEST_STEP = 0.01
LENGTHEN = 1.4  # of the step, after a round that helped
SHORTEN = 0.75  # and after one that did not

Positions = Float[np.ndarray, "P n"]
Areas = Float[np.ndarray, "P"]


@dataclass(frozen=True, kw_only=True)
class ScoredGains:
    """Gains with two scores: area under their response on the model relative to the open loop, and
    coverage (ratio of proved to recorded model error)."""

    gains: Gains
    area: float
    coverage: float

    def is_better_than(self, other: "ScoredGains", aimed_coverage: float) -> bool:
        """Whether gains tolerate a larger model error than other gains or, if both tolerate enough,
        respond faster."""
        smaller_coverage = min(self.coverage, other.coverage)
        if smaller_coverage >= aimed_coverage:
            return self.area < other.area
        return self.coverage > other.coverage


@dataclass(kw_only=True)
class SlopeSearch:
    """Search from given gains for better ones, with a limited number of evaluations of the
    coverage.

    `response_areas` simulates gains on the model, `is_acceptable` says whether they may be deployed
    whatever they cover. `largest_area` is the slowest response allowed.
    """

    loop: LoopCoverage
    centre: float
    aimed_coverage: float
    largest_area: float
    response_areas: Callable[[list[Gains]], list[float]]
    is_acceptable: Callable[[Gains], bool]
    evaluations: int
    random: np.random.Generator

    def search_from(self, start: ScoredGains) -> ScoredGains | None:
        """Search for better gains; the first gains if none are better, and None if the solver gives
        no slopes of coverage there."""
        coordinates = GainCoordinates(first=start.gains)
        origin = np.zeros(coordinates.entry_count)
        at_start = sample_coverage(self.loop, coordinates, origin, self.centre)
        if at_start is None:
            return None
        search = _SearchState(
            settings=self,
            coordinates=coordinates,
            best=start,
            at_best=at_start,
            samples=[at_start],
            simulated=np.zeros((0, coordinates.entry_count)),
            areas=np.zeros(0),
        )
        step = FIRST_STEP
        while len(search.samples) <= self.evaluations and step >= SMALLEST_STEP:
            has_improved = search.evaluate_round(step)
            step *= LENGTHEN if has_improved else SHORTEN
            step = min(step, LARGEST_STEP)
        return search.best


@dataclass(kw_only=True)
class _SearchState:
    """State of a search: the best gains so far, all samples of the coverage, and the latest
    simulated responses."""

    settings: SlopeSearch
    coordinates: GainCoordinates
    best: ScoredGains
    at_best: CoverageSample
    samples: list[CoverageSample]
    simulated: Positions
    areas: Areas

    @property
    def has_required_coverage(self) -> bool:
        """Whether the best gains reach the required coverage."""
        return self.best.coverage >= self.settings.aimed_coverage

    def evaluate_round(self, step: float) -> bool:
        """Evaluate the most promising positions of one round, and return whether one of them is
        better than the best so far."""
        positions, areas = self._draw_fast_positions(step)
        is_left = np.ones(len(positions), dtype=bool)
        for _ in range(EVALUATED):
            chosen = self._most_promising(positions, areas, is_left)
            if chosen is None or len(self.samples) > self.settings.evaluations:
                return False
            is_left[chosen] = False
            position = positions[chosen]
            gains = self.coordinates.gains_at(position)
            if self.settings.is_acceptable(gains) and self._evaluate_position(
                position, gains, float(areas[chosen])
            ):
                return True
        return False

    def _draw_fast_positions(self, step: float) -> tuple[Positions, Areas]:
        """Draw the most promising positions around the best one whose simulated responses are fast
        enough, with the areas of these."""
        random = self.settings.random
        steps = step * random.standard_normal((DRAWN, self.coordinates.entry_count))
        drawn = self.at_best.position + steps
        areas = self._predicted_areas(drawn)
        allowed = self.best.area if self.has_required_coverage else self.settings.largest_area
        promised = self._predict_log_coverage(drawn)
        if self.has_required_coverage:
            is_hopeful = promised >= np.log(self.settings.aimed_coverage)
            cost = areas
        else:
            is_hopeful = (areas <= allowed) & (promised > self.at_best.log_coverage)
            cost = -promised
        hopeful = np.flatnonzero(is_hopeful)
        cheapest_first = np.argsort(cost[hopeful], kind="stable")
        positions = drawn[hopeful[cheapest_first[:SIMULATED]]]
        simulated = self._simulate_areas(positions)
        is_fast = simulated < allowed if self.has_required_coverage else simulated <= allowed
        return positions[is_fast], simulated[is_fast]

    def _simulate_areas(self, positions: Positions) -> Areas:
        """Simulate the responses at several positions, and return and remember the areas under
        them."""
        if not len(positions):
            return np.zeros(0)
        gains = [self.coordinates.gains_at(position) for position in positions]
        areas = np.array(self.settings.response_areas(gains))
        self.simulated = np.concatenate([self.simulated, positions])[-REMEMBERED:]
        self.areas = np.concatenate([self.areas, areas])[-REMEMBERED:]
        return areas

    def _predicted_areas(self, positions: Positions) -> Areas:
        """Predict the areas under the responses at several positions by a linear fit to the
        logarithms of the simulated ones; while these are too few, as the area of the best gains."""
        best = np.full(len(positions), self.best.area)
        is_usable = self.areas < UNUSABLE * self.settings.largest_area
        if is_usable.sum() < 2 * self.coordinates.entry_count:
            return best
        steps = self.simulated[is_usable] - self.at_best.position
        ratios = np.log(self.areas[is_usable] / self.best.area)
        slopes = np.linalg.lstsq(steps, ratios, rcond=None)[0]
        exponents = (positions - self.at_best.position) @ slopes
        return np.asarray(best * np.exp(exponents))

    def _predict_log_coverage(self, positions: Positions) -> Areas:
        """Predicted logarithm of the coverage at each of several positions."""
        return predict_log_coverage(self.samples, self.at_best, positions)

    def _most_promising(
        self, positions: Positions, areas: Areas, is_left: Bool[np.ndarray, "P"]
    ) -> int | None:
        """Index of the position to evaluate next; None if none is predicted to be better than the
        best."""
        promised = self._predict_log_coverage(positions)
        if self.has_required_coverage:
            is_candidate = is_left & (promised >= np.log(self.settings.aimed_coverage))
            cost = areas
        else:
            is_candidate = is_left & (promised > self.at_best.log_coverage)
            cost = -promised
        candidates = np.flatnonzero(is_candidate)
        if not len(candidates):
            return None
        cheapest = np.argmin(cost[candidates])
        return int(candidates[cheapest])

    def _evaluate_position(
        self, position: Float[np.ndarray, "n"], gains: Gains, area: float
    ) -> bool:
        """Evaluate the coverage at a position, make the position the best one if it is better, and
        return whether it is."""
        aimed = self.settings.aimed_coverage
        sample = sample_coverage(
            self.settings.loop,
            self.coordinates,
            position,
            self.settings.centre,
            min(self.best.coverage, aimed),
        )
        if sample is None:
            return False
        self.samples.append(sample)
        coverage = float(np.exp(sample.log_coverage))
        scored = ScoredGains(gains=gains, area=area, coverage=coverage)
        if not scored.is_better_than(self.best, aimed):
            return False
        self.best = scored
        self.at_best = sample
        return True
