"""Comparison table of controllers under several test conditions, on one plant with equal initial
conditions and noise."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from ssm_study.loop import peers
from ssm_study.loop.metrics import pooled_run_columns
from ssm_study.loop.peers.peer import (
    UNSAID,
    ComparisonMethod,
    IdentificationResult,
    Row,
    build_compared_controller,
)
from ssm_study.loop.peers.pi import PI
from ssm_study.loop.regulation import ComparisonTable, LoopExperiment
from ssm_study.plants.disturbance import PeriodicDisturbance, StepDisturbance
from ssm_study.plants.plant import Plant
from ssm_study.plants.wrapper import DelayedInput, SaturatedInput
from ssm_study.refusal import require, require_at_least

LOADS = ("load_step", "load_pulse", "load_periodic")
SITUATIONS = ("nominal", *LOADS, "noise_free", "noise_4x", "saturation", "delay", "spread")
WITHDRAWN = {"mpc": "the linear MPC was withdrawn in 0.2 (CHANGELOG.md, 0.2.0)"}
Case = tuple[Plant, LoopExperiment]


@dataclass(frozen=True, kw_only=True)
class ControllerComparison(ComparisonTable):
    """Settings of a table that compares controllers under several test conditions, such as noise
    and input saturation. It has one row for each controller in each situation.

    It is explained in docs/closed_loop.md, "Robustness".

    `load`, in the unit of the plant's first disturbance, begins at a third of the horizon;
    `load_pulse` ends at half of it. What a plant cannot show (no disturbance, no fields) is left
    out.
    """

    controllers: Sequence[str] = field(
        default_factory=lambda: tuple(ComparisonMethod.members(peers))
    )
    situations: Sequence[str] = ("nominal",)
    rate: float = 0.05
    own_pi: Sequence[float] | None = None
    load: float = 0.005
    load_frequency_hz: float = 2.0
    reach_share: float = 0.5
    spread_share: float = 0.2
    spread_plants: int = 20
    spread_fields: Sequence[str] = ()

    def __post_init__(self) -> None:
        names = tuple(ComparisonMethod.members(peers))
        self._require_known_names("controllers", names)
        self._require_known_names("situations", SITUATIONS)
        rate = self.rate
        share = self.spread_share
        is_rate = 0 < rate < 1
        require(is_rate, "loop.comparison.rate", rate, "a rate lies in (0, 1)", "try 0.05")
        problem = "a share of 1 or more would change the sign of parameters"
        is_share = 0 <= share < 1
        require(is_share, "loop.comparison.spread_share", share, problem, "use 0.2")
        require_at_least(1, "loop.comparison.spread_plants", self.spread_plants, "use 20")
        is_pi = self.own_pi is None or (len(self.own_pi) == 2 and self.own_pi[1] > 0)
        remedy = "give [gain, integral time in seconds]"
        require(is_pi, "loop.comparison.own_pi", self.own_pi, "not a gain and a time", remedy)

    def _require_known_names(self, field_name: str, known_names: Sequence[str]) -> None:
        """Raise `BadRequest` for a list in the comparison's settings that contains an unknown
        name."""
        requested_names = getattr(self, field_name)
        unknown = [value for value in requested_names if value not in known_names]
        withdrawn = [WITHDRAWN[value] for value in unknown if value in WITHDRAWN]
        problem = withdrawn[0] if withdrawn else "not known"
        remedy = f"use some of {', '.join(known_names)}"
        require(not unknown, f"loop.comparison.{field_name}", unknown, problem, remedy)

    def rows(
        self, plant: Plant, identified: IdentificationResult, loop: LoopExperiment, seed: int
    ) -> list[Row]:
        """Rows of the comparison table, one for each controller and test condition.

        A controller that does not exist for this model has rows with the reason and no numbers.
        """
        built = [
            build_compared_controller(name, plant, identified, self.rate)
            for name in self.controllers
        ]
        if self.own_pi is not None:
            own_pi = PI.for_plant(plant, *self.own_pi)
            facts = UNSAID | {"controller": "own_pi"}
            built.append((own_pi, facts))
        rows: list[Row] = []
        for situation in self.situations:
            cases = self.situation_cases(plant, loop, situation, seed)
            if not cases:
                continue
            for controller, predicted in built:
                row: Row = {"controller": predicted["controller"], "situation": situation}
                row |= predicted
                if controller:
                    runs = [varied.run_on_plant(on, controller, seed) for on, varied in cases]
                    row |= pooled_run_columns(runs)
                rows.append(row)
        return rows

    def situation_cases(
        self, plant: Plant, loop: LoopExperiment, situation: str, seed: int
    ) -> list[Case]:
        """Plants and closed-loop experiments of one test condition, such as a load step; empty if
        the plant does not support the condition."""
        samples = loop.horizon_samples(plant.step_s)
        horizon_s = samples * plant.step_s
        match situation:
            case "spread":
                varieds = self.perturbed_plants(plant, seed)
                return [(varied, loop) for varied in varieds]
            case "saturation":
                rest = plant.equilibrium().u
                input_amplitudes = np.array(plant.input_amplitude)
                reach = self.reach_share * input_amplitudes
                lower = (rest - reach).tolist()
                upper = (rest + reach).tolist()
                saturated_input = SaturatedInput(plant=plant, lower=lower, upper=upper)
                return [(saturated_input, loop)]
            case "delay":
                delayed_input = DelayedInput(plant=plant, samples=1)
                return [(delayed_input, loop)]
            case "nominal" | "noise_free" | "noise_4x":
                noise_factors = {"noise_free": 0.0, "noise_4x": 4.0}
                times = noise_factors.get(situation, 1.0)
                noise_factor = times * loop.noise_factor
                noisy_loop = replace(loop, noise_factor=noise_factor)
                return [(plant, noisy_loop)]
            case "load_periodic":
                sine = PeriodicDisturbance(amplitude=self.load, frequency_hz=self.load_frequency_hz)
                return [(plant, replace(loop, disturbance=sine))] if plant.disturbances else []
            case _:
                until_s = horizon_s / 2 if situation == "load_pulse" else None
                step = StepDisturbance(size=self.load, at_s=horizon_s / 3, until_s=until_s)
                return [(plant, replace(loop, disturbance=step))] if plant.disturbances else []

    def perturbed_plants(self, plant: Plant, seed: int) -> list[Plant]:
        """Copies of a plant whose physical constants are multiplied by evenly distributed random
        factors. The range is `1 +- spread_share`."""
        if not self.spread_fields:
            return []
        missing_fields = (name for name in self.spread_fields if not hasattr(plant, name))
        missing = sorted(missing_fields)
        problem = "not fields of this plant"
        require(not missing, "loop.comparison.spread_fields", missing, problem, "name its own")
        count = len(self.spread_fields)
        seeds = [seed, 2]
        rng = np.random.default_rng(seeds)
        sampler = scipy.stats.qmc.LatinHypercube(d=count, rng=rng)
        uniform_draws = sampler.random(self.spread_plants)
        deviations = 2 * uniform_draws - 1
        factors = 1 + self.spread_share * deviations  # in [1 - share, 1 + share]
        nominal_values = [float(getattr(plant, name)) for name in self.spread_fields]
        nominal = np.array(nominal_values)
        plants: list[Plant] = []
        for row in (factors * nominal).tolist():
            changed_fields = zip(self.spread_fields, row, strict=True)
            values = dict(changed_fields)
            plants.append(replace(plant, **values))  # type: ignore[type-var]  # a dataclass
        return plants
