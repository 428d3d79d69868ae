"""One table: controllers down, situations across, on the same plant, initial conditions and noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import qmc

from ssm_study.loop.metrics import Columns, pooled
from ssm_study.loop.peers import NAMES, Peer, peer
from ssm_study.loop.regulation import ClosedLoop, Loop, Table
from ssm_study.loop.table import Identified, Row
from ssm_study.plants.actuator import DelayedInput, SaturatedInput
from ssm_study.plants.disturbance import PeriodicDisturbance, StepDisturbance
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require

SITUATIONS = (
    "nominal",
    "load_step",
    "load_pulse",
    "load_periodic",
    "noise_free",
    "noise_4x",
    "saturation",
    "delay",
    "spread",
)
PREDICTED = ("mismatch_margin", "resolved_margin", "controller_radius")
"""Nothing where a controller has no model."""
Case = tuple[Plant, Loop]


@dataclass(frozen=True, kw_only=True)
class Comparison(Table):
    """Every controller in every situation; one row each.

    Situations: `nominal`; `load_step` (a constant `load`, unit of the plant's first disturbance, from a third of the
    horizon), `load_pulse` (until half of it), `load_periodic` (at `load_frequency_hz`); `noise_free`, `noise_4x`
    (four times the variance); `saturation` (inputs cut at `reach_share` of the plant's excitation amplitude, unknown
    to the controller); `delay` (one sample, unknown); `spread` (`spread_plants` plants whose `spread_fields` are off by
    up to `spread_share`, a Latin hypercube). What a plant cannot show (no disturbance, no fields) is left out.
    """

    controllers: Sequence[str] = NAMES
    situations: Sequence[str] = ("nominal",)
    rate: float = 0.05
    load: float = 0.005
    load_frequency_hz: float = 2.0
    reach_share: float = 0.5
    spread_share: float = 0.2
    spread_plants: int = 20
    spread_fields: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, known in (("controllers", NAMES), ("situations", SITUATIONS)):
            unknown = [value for value in getattr(self, name) if value not in known]
            require(not unknown, f"loop.comparison.{name}", unknown, "not known", f"use some of {', '.join(known)}")
        require(0 < self.rate < 1, "loop.comparison.rate", self.rate, "a rate lies in (0, 1)", "try 0.05")
        share = self.spread_share
        require(0 <= share < 1, "loop.comparison.spread_share", share, "parameters would change sign", "use 0.2")
        count = self.spread_plants
        require(count >= 1, "loop.comparison.spread_plants", count, "at least one plant is needed", "use 20")

    def rows(self, plant: Plant, known: Identified, loop: Loop, seed: int) -> list[Row]:
        """The table; a controller that does not exist for this model has rows with the reason and no numbers."""
        peers = [peer(name, plant, known, self.rate) for name in self.controllers]
        return [
            self._row(one, situation, cases, seed)
            for situation in self.situations
            if (cases := self.cases(plant, loop, situation, seed))
            for one in peers
        ]

    def _row(self, one: Peer, situation: str, cases: list[Case], seed: int) -> Row:
        said: Row = {"controller": one.name, "situation": situation, "certified": one.certified}
        said |= (dict.fromkeys(PREDICTED) if one.prediction is None else one.prediction.columns()) | {
            "reason": one.reason
        }
        if one.controller is None:
            return said
        results: list[ClosedLoop] = [
            varied.compare(varied_plant, {one.name: one.controller}, seed)[one.name] for varied_plant, varied in cases
        ]
        numbers: Columns = pooled(results)
        return said | numbers

    def cases(self, plant: Plant, loop: Loop, situation: str, seed: int) -> list[Case]:
        """The plants and loops one situation consists of; none if the plant cannot show it."""
        horizon_s = loop.samples(plant.step_s) * plant.step_s
        if situation.startswith("load") and not plant.disturbances:
            return []
        match situation:
            case "nominal":
                return [(plant, loop)]
            case "load_step":
                return [(plant, replace(loop, disturbance=StepDisturbance(size=self.load, at_s=horizon_s / 3)))]
            case "load_pulse":
                pulse = StepDisturbance(size=self.load, at_s=horizon_s / 3, until_s=horizon_s / 2)
                return [(plant, replace(loop, disturbance=pulse))]
            case "load_periodic":
                sine = PeriodicDisturbance(amplitude=self.load, frequency_hz=self.load_frequency_hz)
                return [(plant, replace(loop, disturbance=sine))]
            case "noise_free":
                return [(plant, replace(loop, noise_factor=0.0))]
            case "noise_4x":
                return [(plant, replace(loop, noise_factor=4.0 * loop.noise_factor))]
            case "saturation":
                rest, reach = plant.equilibrium().u, self.reach_share * np.array(plant.input_amplitude)
                limits = {"lower": (rest - reach).tolist(), "upper": (rest + reach).tolist()}
                return [(SaturatedInput(plant=plant, **limits), loop)]
            case "delay":
                return [(DelayedInput(plant=plant, samples=1), loop)]
            case _:
                return [(varied, loop) for varied in self.spread(plant, seed)]

    def spread(self, plant: Plant, seed: int) -> list[Plant]:
        """`spread_plants` plants, each field multiplied by a factor in `1 +- spread_share`, space-filling."""
        if not self.spread_fields:
            return []
        known = [name for name in self.spread_fields if hasattr(plant, name)]
        missing = sorted(set(self.spread_fields) - set(known))
        require(not missing, "loop.comparison.spread_fields", missing, "not fields of this plant", "name its own")
        sampler = qmc.LatinHypercube(d=len(known), rng=np.random.default_rng([seed, 2]))
        factors = 1 + self.spread_share * (2 * sampler.random(self.spread_plants) - 1)
        nominal = np.array([float(getattr(plant, name)) for name in known])
        return [
            replace(plant, **dict(zip(known, (float(v) for v in row * nominal), strict=True)))  # type: ignore[type-var]
            for row in factors
        ]
