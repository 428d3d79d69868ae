"""Hundreds of certified designs for one model, each on the true plant: what the mismatch margin is
worth."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Int

from ssm_study.loop.controller import ObserverFeedback, Uncontrolled
from ssm_study.loop.metrics import mean
from ssm_study.loop.peers.peer import Identified, Row
from ssm_study.loop.regulation import ComparisonTable, Loop
from ssm_study.loop.rollout import motions, settling_times_s
from ssm_study.plants.plant import Plant
from ssm_study.refusal import at_least
from ssm_study.robustness.prediction import predict
from ssm_study.synthesis.auto import Auto
from ssm_study.synthesis.candidates import Candidates
from ssm_study.synthesis.integrated_error import relative_areas
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
class DesignGrid(ComparisonTable):
    """`designs` pairs drawn from the grids of `auto`, wide enough to fail, and the default choice,
    if any, as row 0.

    A row holds rates, gains, what is predicted (`synthesis.mismatch`), the response area on the
    model, and what the true plant did over the run's own horizon: `stable_count` of
    `initial_conditions` with and without measurement noise (`stable_count_noise_free` is the one to
    judge by where noise alone crosses the band), settling times, cases that left the bound, and
    what the noise-free ones that do not settle do.
    """

    designs: int = 150
    auto: Auto = field(default_factory=partial(Auto, **WIDE))

    def __post_init__(self) -> None:
        at_least(1, "loop.comparison.designs", self.designs, "use 150")

    def rows(self, plant: Plant, known: Identified, loop: Loop, seed: int) -> list[Row]:
        candidates = self.auto.candidates(known.model, known.balls)
        if candidates is None:
            return []
        drawn = self.drawn(candidates, seed)
        chosen = known.chosen(Auto())
        gains = candidates.gains(drawn)
        rates = [
            (candidates.feedback[i].rate_controller, candidates.observing[j].rate_observer)
            for i, j in drawn
        ]
        if chosen.feasible:
            own = {name: gain for name, gain in vars(chosen.pair).items() if gain is not None}
            gains = Gains(
                **{
                    name: np.concatenate([gain[None], getattr(gains, name)])
                    for name, gain in own.items()
                }
            )
            rates.insert(0, (chosen.parts()[0].rate, chosen.parts()[1].rate))
        each = zip(
            rates,
            self._predicted(known, gains),
            _behaved(plant, known, gains, loop, seed),
            strict=True,
        )
        return [
            {"design": i, "rate_controller": rate[0], "rate_observer": rate[1]}
            | predicted
            | behaved
            for i, (rate, predicted, behaved) in enumerate(each, start=int(not chosen.feasible))
        ]

    def drawn(self, candidates: Candidates, seed: int) -> Int[np.ndarray, "D 2"]:
        """Controller and observer of each design."""
        counts = len(candidates.ks), len(candidates.ls)
        total = counts[0] * counts[1]
        flat = np.random.default_rng([seed, 3]).choice(
            total, size=min(self.designs, total), replace=False
        )
        return np.stack(np.unravel_index(np.sort(flat), counts), axis=1)

    def _predicted(self, known: Identified, gains: Gains) -> list[Row]:
        rows = []
        for i, area in enumerate(relative_areas(known.model, gains, known.validation)):
            predicted = predict(known.model, pair := gains.at(i), known.balls, known.shown)
            norms = {"gain_norm": pair.k, "observer_gain_norm": pair.l}
            row: Row = {name: float(np.linalg.norm(gain, 2)) for name, gain in norms.items()}
            row |= {"mismatch_gain": known.shown.gain, **vars(predicted)}
            rows.append(
                row
                | {"predicted_stable": predicted.predicts_stability(), "model_area": float(area)}
            )
        return rows


def _behaved(plant: Plant, known: Identified, gains: Gains, loop: Loop, seed: int) -> list[Row]:
    """All designs as one batch of cases, with the noise and without it."""
    (y0, noise), band, designs = loop.draw(plant, seed), plant.settling_band, len(gains.k)
    each = ObserverFeedback(
        model=known.model, gains=gains.at(np.repeat(np.arange(designs), len(y0)))
    )
    starts = np.tile(y0, (designs, 1))
    noises = np.tile(noise, (designs, 1, 1))
    run, quiet = (
        loop.simulate(plant, each, starts, given) for given in (noises, np.zeros_like(noises))
    )
    alone = loop.simulate(plant, Uncontrolled.of(plant), y0, noise)
    open_loop = mean(settling_times_s(alone, band))
    times_s = settling_times_s(run, band)
    kinds = motions(quiet, band)
    rows = []
    for first in range(0, len(starts), len(y0)):
        own = slice(first, first + len(y0))
        row: Row = {
            "initial_conditions": len(y0),
            "stable_count": len(y0) - times_s[own].count(None),
        }
        row |= {"settling_time_mean_s": mean(times_s[own]), "settling_time_open_loop_s": open_loop}
        row |= {"stable_count_noise_free": kinds[own].count("settled")}
        row |= {"unsettled_as": ", ".join(sorted(set(kinds[own]) - {"settled"})) or None}
        rows.append(row | {"left_bound_count": int((~run.stayed[own]).sum())})
    return rows
