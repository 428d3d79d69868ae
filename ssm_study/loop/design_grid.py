"""Table of randomly chosen certified designs, simulated on the true plant to test the predicted
stability margins."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Int

from ssm_study.loop.controller import NoControl, ObserverFeedback
from ssm_study.loop.metrics import mean_without_none
from ssm_study.loop.motion import classify_motions, settling_times_s
from ssm_study.loop.peers.peer import IdentificationResult, Row
from ssm_study.loop.regulation import ComparisonTable, LoopExperiment
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require_at_least
from ssm_study.robustness.prediction import predict_margins
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.candidates import GainCandidates
from ssm_study.synthesis.integrated_error import relative_response_areas
from ssm_study.systems import Gains

WIDE: dict[str, Any] = {
    "stretch_shares": (0.1, 0.5, 0.9, 0.99),
    "observer_rates": (0.1, 0.3, 0.5, 0.7),
    "input_weights": (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0),
    "output_noises": (1e-6, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0),
}
"""The grids of `auto` and beyond: rates up to the exact limit, weights that ask for the
impossible."""


@dataclass(frozen=True, kw_only=True)
class RandomDesignTable(ComparisonTable):
    """Settings of a table of randomly chosen certified designs, with their predicted margins and
    their simulated behaviour on the true plant.

    The default choice, if any, is row 0. A row holds rates, gains, what is predicted
    (`robustness.prediction`), the response area on the model, and what the true plant did over the
    run's own horizon: `stable_count` of `initial_conditions` with and without measurement noise
    (`stable_count_noise_free` is the one to judge by where noise alone crosses the band), settling
    times, cases that left the bound, and what the noise-free ones that do not settle do.
    """

    designs: int = 150
    auto: Auto = field(default_factory=partial(Auto, **WIDE))

    def __post_init__(self) -> None:
        require_at_least(1, "loop.comparison.designs", self.designs, "use 150")

    def rows(
        self, plant: Plant, identified: IdentificationResult, loop: LoopExperiment, seed: int
    ) -> list[Row]:
        """Rows of the table, one for each random design: rates, predicted margins and closed-loop
        behaviour."""
        candidates = self.auto.compute_candidates(identified.model, identified.balls)
        if candidates is None:
            return []
        drawn = self.draw_gain_pairs(candidates, seed)
        gains = candidates.gains(drawn)
        rates = []
        for i, j in drawn:
            rate_controller = candidates.feedback[i].rate_controller
            rate_observer = candidates.observing[j].rate_observer
            rates.append((rate_controller, rate_observer))
        chosen = identified.auto_design(Auto())
        number = 1
        if chosen.feasible:
            number = 0
            gains = _prepend_gains(chosen.gain_pair, gains)
            both_parts = chosen.controller_and_observer()
            feedback, observer = both_parts[:2]
            certified_rates = (feedback.rate, observer.rate)
            rates.insert(0, certified_rates)
        predictions = _prediction_columns(identified, gains)
        behaviours = _behaviour_columns(plant, identified, gains, loop, seed)
        rows: list[Row] = []
        for rate_pair, predicted, behaved in zip(rates, predictions, behaviours, strict=True):
            rate_controller, rate_observer = rate_pair
            row: Row = {"design": number}
            row["rate_controller"] = rate_controller
            row["rate_observer"] = rate_observer
            rows.append(row | predicted | behaved)
            number += 1
        return rows

    def draw_gain_pairs(self, candidates: GainCandidates, seed: int) -> Int[np.ndarray, "D 2"]:
        """Draw random pairs of a controller gain and an observer gain, as indices into the lists of
        gains."""
        controller_count = len(candidates.ks)
        observer_count = len(candidates.ls)
        counts = (controller_count, observer_count)
        total = counts[0] * counts[1]
        size = min(self.designs, total)
        seeds = [seed, 3]
        rng = np.random.default_rng(seeds)
        flat = rng.choice(total, size=size, replace=False)
        sorted_numbers = np.sort(flat)
        pairs = np.unravel_index(sorted_numbers, counts)
        return np.stack(pairs, axis=1)


def _prepend_gains(first_gains: Gains, other_gains: Gains) -> Gains:
    """Prepend the gains of one controller and observer to a stack of gains."""
    stacked = {}
    for name, gain in vars(first_gains).items():
        if gain is not None:
            others = getattr(other_gains, name)
            all_gains = [gain[None], others]
            stacked[name] = np.concatenate(all_gains)
    return Gains(**stacked)


def _prediction_columns(identified: IdentificationResult, gains: Gains) -> list[Row]:
    """Table columns with gain norms, predicted stability and the response on the model, one row for
    each design."""
    mismatch = identified.mismatch
    rows = []
    areas = relative_response_areas(identified.model, gains, identified.validation)
    for i, area in enumerate(areas):
        pair = gains.select_pairs(i)
        predicted = predict_margins(identified.model, pair, identified.balls, mismatch)
        norm_of_gain = np.linalg.norm(pair.k, 2)
        gain_norm = float(norm_of_gain)
        norm_of_observer_gain = np.linalg.norm(pair.l, 2)
        observer_gain_norm = float(norm_of_observer_gain)
        is_predicted_stable = predicted.predicts_stability()
        row: Row = {
            "gain_norm": gain_norm,
            "observer_gain_norm": observer_gain_norm,
            "mismatch_gain": mismatch.gain,
            **vars(predicted),
            "predicted_stable": is_predicted_stable,
            "model_area": float(area),
        }
        rows.append(row)
    return rows


def _behaviour_columns(
    plant: Plant, identified: IdentificationResult, gains: Gains, loop: LoopExperiment, seed: int
) -> list[Row]:
    """Table columns on the behaviour of the closed loop on the true plant, one row for each
    design."""
    y0, noise = loop.draw_starts_and_noise(plant, seed)
    band = plant.settling_band
    designs = len(gains.k)
    cases = len(y0)
    design_numbers = np.arange(designs)
    each_case = np.repeat(design_numbers, cases)
    observer_feedback_gains = gains.select_pairs(each_case)
    controller = ObserverFeedback(model=identified.model, gains=observer_feedback_gains)
    starts = np.concatenate([y0] * designs)
    noises = np.concatenate([noise] * designs)
    run = loop.simulate(plant, controller, starts, noises)
    no_noise = np.zeros_like(noises)
    no_control = NoControl.for_plant(plant)
    quiet = loop.simulate(plant, controller, starts, no_noise)
    uncontrolled = loop.simulate(plant, no_control, y0, noise)
    open_loop_s = mean_without_none(settling_times_s(uncontrolled, band))
    times_s = settling_times_s(run, band)
    kinds = classify_motions(quiet, band)
    rows = []
    for first in range(0, len(starts), cases):
        own = slice(first, first + cases)
        left_bound = ~run.stayed_within_bound[own]
        row = _settling_columns(times_s[own], kinds[own], open_loop_s, int(left_bound.sum()))
        rows.append(row)
    return rows


def _settling_columns(
    times_s: tuple[float | None, ...],
    motion_classes: tuple[str, ...],
    open_loop_s: float | None,
    left_bound_count: int,
) -> Row:
    """Table columns on how many simulations of one design settle, how fast, and how the unsettled
    ones move."""
    cases = len(times_s)
    unsettled = set(motion_classes) - {"settled"}
    unsettled_kinds = sorted(unsettled)
    unsettled_count = times_s.count(None)
    return {
        "initial_conditions": cases,
        "stable_count": cases - unsettled_count,
        "settling_time_mean_s": mean_without_none(times_s),
        "settling_time_open_loop_s": open_loop_s,
        "stable_count_noise_free": motion_classes.count("settled"),
        "unsettled_as": ", ".join(unsettled_kinds) or None,
        "left_bound_count": left_bound_count,
    }
