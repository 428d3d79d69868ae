"""Hundreds of certified designs for one model, each on the true plant: what the mismatch margin is worth."""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from ssm_study.loop.controller import Controller
from ssm_study.loop.regulation import Loop, Table
from ssm_study.loop.rollout import Rollouts
from ssm_study.loop.settling import NEVER, settling_samples
from ssm_study.loop.table import Identified, Row
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.synthesis.area import relative_areas
from ssm_study.synthesis.auto import Auto, Candidates
from ssm_study.synthesis.mismatch import mismatch, predict


@dataclass(frozen=True, kw_only=True)
class GainGrid(Controller):
    """`ObserverFeedback` with gains of its own for every case: the first number of a case's memory says which.

    Shapes: `ks (G, m, n)`, `ls (G, n, p)`; case i of `start` uses gains `i // cases_each`. Regulation only.
    """

    model: SSM
    ks: Float[np.ndarray, "G m n"]
    ls: Float[np.ndarray, "G n p"]
    cases_each: int

    @property
    def step_s(self) -> float:
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:
        return self.ks.shape[1], self.ls.shape[2]

    def start(self, cases: int) -> Float[np.ndarray, "N s"]:
        memory = np.zeros((cases, 1 + self.model.order))
        memory[:, 0] = np.arange(cases) // self.cases_each
        return memory

    def input(
        self, memory: Float[np.ndarray, "N s"], y: Float[np.ndarray, "N p"], target: Float[np.ndarray, "t"]
    ) -> Float[np.ndarray, "N m"]:
        scaled = np.einsum("imn,in->im", self.ks[self._which(memory)], memory[:, 1:])
        return self.model.input_equilibrium + self.model.input_scale * scaled

    def advance(
        self,
        memory: Float[np.ndarray, "N s"],
        u: Float[np.ndarray, "N m"],
        y: Float[np.ndarray, "N p"],
        target: Float[np.ndarray, "t"],
    ) -> Float[np.ndarray, "N s"]:
        x_hat, lifted = memory[:, 1:], self.model.lift(u)
        error = (self.model.read(x_hat, lifted) - y) / self.model.output_scale
        corrected = self.model.advance(x_hat, lifted) + np.einsum("inp,ip->in", self.ls[self._which(memory)], error)
        return np.concatenate([memory[:, :1], corrected], axis=1)

    def _which(self, memory: Float[np.ndarray, "N s"]) -> Int[np.ndarray, "N"]:
        return memory[:, 0].astype(int)


def wide_grids() -> Auto:
    """The grids of `auto` and beyond: rates up to the exact limit, weights that ask for the impossible."""
    return Auto(
        stretch_shares=(0.1, 0.5, 0.9, 0.99),
        observer_rates=(0.1, 0.3, 0.5, 0.7),
        input_weights=(1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0),
        output_noises=(1e-6, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0),
    )


@dataclass(frozen=True, kw_only=True)
class DesignGrid(Table):
    """`designs` pairs drawn from the grids of `auto`, wide enough to fail, and the default choice as row 0.

    A row holds rates, gains, what is predicted (`synthesis.mismatch`), the response area on the model, and what the
    true plant did over `horizon_factor` times the run's horizon, so that slow is told from lost: `stable_count` of
    `initial_conditions` with and without measurement noise, settling times, cases that left the bound, and the largest
    `|y - r|` in the middle and the last fifth of the time.
    """

    designs: int = 150
    horizon_factor: float = 2.0
    auto: Auto = field(default_factory=wide_grids)

    def __post_init__(self) -> None:
        require(self.designs >= 1, "loop.comparison.designs", self.designs, "at least one is needed", "use 150")

    def rows(self, plant: Plant, known: Identified, loop: Loop, seed: int) -> list[Row]:
        candidates = self.auto.candidates(known.model, *known.balls)
        if candidates is None:
            return []
        drawn = self._drawn(candidates, seed)
        ks, ls = candidates.ks[drawn[:, 0]], candidates.ls[drawn[:, 1]]
        chosen = Auto().design(known.model, *known.balls, known.validation)
        ks = np.concatenate([chosen.state_feedback.k[None], ks])  # type: ignore[union-attr]  # candidates exist, so this does
        ls = np.concatenate([chosen.observer.l[None], ls])  # type: ignore[union-attr]
        rates = [(chosen.state_feedback.rate, chosen.observer.rate)]
        rates += [(candidates.feedback[i].rate_controller, candidates.observing[j].rate_observer) for i, j in drawn]
        behaviours = self._closed(plant, known.model, ks, ls, loop, seed)
        predictions = self._predicted(known, ks, ls)
        return [
            {"design": i, "rate_controller": rate[0], "rate_observer": rate[1]} | predicted | behaved
            for i, (rate, predicted, behaved) in enumerate(zip(rates, predictions, behaviours, strict=True))
        ]

    def _drawn(self, candidates: Candidates, seed: int) -> Int[np.ndarray, "D 2"]:
        total = len(candidates.ks) * len(candidates.ls)
        rng = np.random.default_rng([seed, 3])
        flat = rng.choice(total, size=min(self.designs, total), replace=False)
        return np.stack(np.unravel_index(np.sort(flat), (len(candidates.ks), len(candidates.ls))), axis=1)

    def _predicted(
        self, known: Identified, ks: Float[np.ndarray, "D m n"], ls: Float[np.ndarray, "D n p"]
    ) -> list[Row]:
        shown = mismatch(known.model, known.validation)
        predictions = [predict(known.model, k, l_, *known.balls, shown) for k, l_ in zip(ks, ls, strict=True)]
        areas = relative_areas(known.model, ks, ls, _each(len(ks)), known.validation)
        return [
            {
                "gain_norm": float(np.linalg.norm(k, 2)),
                "observer_gain_norm": float(np.linalg.norm(l_, 2)),
                "mismatch_gain": shown.gain,
                **predicted.columns(),
                "model_area": float(area),
            }
            for k, l_, predicted, area in zip(ks, ls, predictions, areas, strict=True)
        ]

    def _closed(
        self,
        plant: Plant,
        model: SSM,
        ks: Float[np.ndarray, "D m n"],
        ls: Float[np.ndarray, "D n p"],
        loop: Loop,
        seed: int,
    ) -> list[Row]:
        longer = replace(loop, horizon_s=self.horizon_factor * loop.samples(plant.step_s) * plant.step_s)
        y0, noise = longer.draw(plant, seed)
        each = len(y0)
        grid = GainGrid(model=model, ks=ks, ls=ls, cases_each=each)
        run = longer.simulate(plant, grid, np.tile(y0, (len(ks), 1)), np.tile(noise, (len(ks), 1, 1)))
        alone = longer.uncontrolled(plant, y0, noise)
        quiet = longer.simulate(plant, grid, np.tile(y0, (len(ks), 1)), np.zeros((len(ks) * each, *noise.shape[1:])))
        open_loop = _mean_s(settling_samples(alone, plant.settling_band), plant.step_s)
        undisturbed = (settling_samples(quiet, plant.settling_band) != NEVER).reshape(len(ks), each).sum(axis=1)
        settled = settling_samples(run, plant.settling_band).reshape(len(ks), each)
        left = (~run.stayed).reshape(len(ks), each)
        return [
            {
                "initial_conditions": each,
                "stable_count": int((row != NEVER).sum()),
                "settling_time_mean_s": _mean_s(row, plant.step_s),
                "settling_time_open_loop_s": open_loop,
                "stable_count_noise_free": int(undisturbed[i]),
                "left_bound_count": int(out.sum()),
                "middle_spread": _spread(run, i * each, each, 2),
                "final_spread": _spread(run, i * each, each, 4),
            }
            for i, (row, out) in enumerate(zip(settled, left, strict=True))
        ]


def _each(designs: int) -> Int[np.ndarray, "D 2"]:
    return np.repeat(np.arange(designs)[:, None], 2, axis=1)


def _spread(run: Rollouts, first: int, each: int, fifth: int) -> float:
    """Largest `|y - r|` of a design's cases in one fifth (0 to 4) of the horizon."""
    error = np.abs(run.y - run.reference)[first : first + each]
    samples = error.shape[1]
    return float(error[:, fifth * samples // 5 : (fifth + 1) * samples // 5].max())


def _mean_s(samples: Int[np.ndarray, "N"], step_s: float) -> float | None:
    settled = samples[samples != NEVER]
    return float(settled.mean() * step_s) if len(settled) else None
