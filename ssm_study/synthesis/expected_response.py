"""Ranking of candidate gains by the area under the response that is expected on the plant.

    P area + (1 - P) LOSS,        P = Phi(ln(margin) / spread)

Pairs that are faster than the open loop on the model come before all others: a controller that does
next to nothing is safe, and helps nobody. Faster also from the starts of recorded decays: an output
that falls by itself before the observer knows is only stirred up by a fast controller. The measured
mismatch is a sample of the true one: the fastest design that just passes is the one that profits
most from a mismatch measured too small. Source: docs/closed_loop.md, "Rates chosen for you"; of the
margin: docs/theory.md, "Small gain for the plant".
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ssm_study.models.structured import Model
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import output_peak_from_noise, worst_case_loop_gain
from ssm_study.robustness.sensitivity import FINE_ANGLES, ResponseCache, controller_spectral_radius
from ssm_study.signals import Ends, Trajectories
from ssm_study.synthesis.candidates import GainCandidates
from ssm_study.synthesis.decay_response import (
    NO_DECAYS,
    largest_settling_time_ratios,
    simulate_decays,
)
from ssm_study.synthesis.integrated_error import relative_response_areas
from ssm_study.systems import Gains, JacobianBalls

Pair = Int[np.ndarray, "2"]
Rank = tuple[bool, float]
ATTEMPTS = 20  # pairs verified exactly before the search gives up: each costs two certificates
# Pairs compared with all that the records show: the fastest, and of the rest as many.
COMPARED = 200
LOSS = 10.0  # area of a design that fails on the plant, in areas of the plant left alone
# Area on the model, in areas of the plant left alone, and time to settle from recorded starts, in
# that of the decay, below which a pair counts as faster than none.
FASTER = 0.9
# No record is known better than this: Welch's estimate alone scatters by half of it.
LEAST_SPREAD = 0.1


def expected_response_area(area: float, loop_gain: float, log_gain_error: float) -> float:
    """Expected area under a closed-loop response, from the probability that the loop is stable on
    the plant. `loop_gain` is 1 / margin."""
    from scipy.special import ndtr  # here: what only reads a study does without

    smallest_float = np.finfo(float).tiny
    positive_gain = max(loop_gain, smallest_float)
    logarithm = np.log(positive_gain)
    deviations = -logarithm / max(log_gain_error, LEAST_SPREAD)
    probability = float(ndtr(deviations))
    expected_loss = (1 - probability) * LOSS
    return probability * area + expected_loss


class RankedPair(NamedTuple):
    """Gains of one controller and observer, and whether their closed loop is faster than the open
    loop."""

    pair: Pair
    is_faster: bool


@dataclass(frozen=True, kw_only=True)
class ExpectedResponse:
    """Scores of all candidate designs of a grid by stability margin, sensor noise and expected
    response."""

    model: Model
    balls: JacobianBalls
    candidates: GainCandidates
    mismatch: Mismatch
    margin: float
    decays: Float[np.ndarray, "N T p"] = field(default_factory=lambda: NO_DECAYS)

    def loop_gain(self, pair: Pair, cached_responses: ResponseCache) -> float:
        """Loop gain of a design under the measured model error, the inverse of the stability
        margin. The computation stops early from `1 / margin` on."""
        gains = self.candidates.gains(pair)
        refused = 1 / self.margin
        return worst_case_loop_gain(
            self.model, gains, self.balls, self.mismatch, cached_responses, refused
        )

    def expected_pair_area(self, pair: Pair, area: float, cached_responses: ResponseCache) -> float:
        """Expected area under the response of one design on the plant, from the area on the model
        and the loop gain."""
        loop_gain = self.loop_gain(pair, cached_responses)
        spread = self.mismatch.spread
        return expected_response_area(float(area), loop_gain, spread)

    def resists_noise(self, pair: Pair) -> bool:
        """Whether the output of a design's closed loop stays within the settling band when sensor
        noise alone acts."""
        gains = self.candidates.gains(pair)
        noise_peak = output_peak_from_noise(self.model, gains, self.balls, self.mismatch)
        return noise_peak < 1

    def stable_pair_indices(
        self, peak_loop_gains: Float[np.ndarray, "C O"]
    ) -> Int[np.ndarray, "N 2"]:
        """Indices of the controller and observer pairs with a large enough stability margin and a
        controller that is stable by itself."""
        if np.isinf(self.margin):  # no pair has it (and times a peak of zero it is no number)
            no_pairs = (0, 2)
            return np.empty(no_pairs, dtype=int)
        scaled_peaks = self.margin * peak_loop_gains
        pairs = np.argwhere(scaled_peaks < 1)
        gains = self.candidates.gains(pairs)
        system = self.model.system
        controller_radii = controller_spectral_radius(system, gains, self.balls)
        return pairs[controller_radii < 1]

    def pairs_by_expected_response(
        self,
        peak_loop_gains: Float[np.ndarray, "C O"],
        validation: Trajectories,
        input_limits: Ends | None,
    ) -> Iterator[RankedPair]:
        """Pairs of controller and observer that pass all tests, sorted by the expected area under
        their response, those faster than the open loop first.

        An expected area is never below the area, so the search ends where the areas exceed the
        expected ones of the passing pairs, and goes on only where none of those is taken (the gains
        of a verified design may differ from its candidate's).
        """
        pairs = self.stable_pair_indices(peak_loop_gains)
        if not len(pairs) or not self.mismatch.plant_comes_to_rest:
            return
        gains = self.candidates.gains(pairs)
        areas = relative_response_areas(self.model, gains, validation, input_limits)
        band = self.mismatch.scaled_settling_band
        ratios = largest_settling_time_ratios(self.model, gains, self.decays, band, input_limits)
        slow = np.maximum(areas, ratios) >= FASTER
        angles = FINE_ANGLES[::2]
        coarse = ResponseCache(angles=angles)
        fine = ResponseCache(angles=FINE_ANGLES)
        passing: list[tuple[Rank, int]] = []
        remaining = indices_to_compare(areas, slow)
        while remaining or passing:
            while remaining:
                first_is_slow = slow[remaining[0]]
                first_area = areas[remaining[0]]
                best_possible = (bool(first_is_slow), float(first_area))
                if passing and best_possible >= min(passing)[0]:
                    break
                index = remaining.pop(0)
                loop_gain = self.loop_gain(pairs[index], coarse)
                scaled_gain = self.margin * loop_gain
                if scaled_gain < 1 and self.resists_noise(pairs[index]):
                    area = float(areas[index])
                    spread = self.mismatch.spread
                    score = expected_response_area(area, loop_gain, spread)
                    passing.append(((bool(slow[index]), score), index))
            passing.sort()
            # between two frequencies of the coarser grid a loop may come nearer to its limit
            best = [index for _, index in passing[:ATTEMPTS]]
            scores = [self.expected_pair_area(pairs[index], areas[index], fine) for index in best]
            ranked = []
            for index, score in zip(best, scores, strict=True):
                rank = (bool(slow[index]), score)
                ranked.append((rank, index))
            for _, index in sorted(ranked):
                yield RankedPair(pairs[index], not slow[index])
            del passing[:ATTEMPTS]


def indices_to_compare(
    response_areas: Float[np.ndarray, "N"], is_slow: Bool[np.ndarray, "N"]
) -> list[int]:
    """Indices of the designs to examine further: those with the smallest response areas, and an
    even sample of the others."""
    order = np.lexsort((response_areas, is_slow))
    design_count = len(order)
    step = max(design_count // COMPARED, 1)
    smallest = order[:COMPARED].tolist()
    other_designs = order[COMPARED::step]
    spread_over_others = other_designs.tolist()
    return [*smallest, *spread_over_others]


def predicts_faster_response(
    model: Model, gains: Gains, mismatch: Mismatch, validation: Trajectories, trials: Trajectories
) -> bool:
    """Whether a design responds clearly faster than the open loop, both in simulation and compared
    with the recorded decays. Input limits are not considered."""
    k = gains.k[None]
    l_ = gains.l[None]
    l_z = None if gains.l_z is None else gains.l_z[None]
    single_pair = replace(gains, k=k, l=l_, l_z=l_z)
    area, *_ = relative_response_areas(model, single_pair, validation)
    decays = simulate_decays(model, trials, validation)
    band = mismatch.scaled_settling_band
    ratio, *_ = largest_settling_time_ratios(model, single_pair, decays, band)
    return bool(max(area, ratio) < FASTER)


def faster_response_column(
    design: Any, model: Model, mismatch: Mismatch, *records: Trajectories
) -> Any:
    """Column that says whether the design is predicted to be faster than the open loop. It is null
    without a design."""
    if not design.feasible:
        return {}
    predicted_faster = predicts_faster_response(model, design.gain_pair, mismatch, *records)
    return {"predicted_faster": predicted_faster}
