"""The experiment: initial conditions, noise, reference and disturbance, on the plant, without control, on the model."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ssm_study.loop.controller import Controller, ObserverFeedback, Uncontrolled
from ssm_study.loop.identified_plant import IdentifiedPlant
from ssm_study.loop.reference import Reference, Rest
from ssm_study.loop.rollout import Rollouts, close_loop, matched
from ssm_study.loop.table import Identified, Row
from ssm_study.models.identified import SSM
from ssm_study.plants.disturbance import Disturbance, NoDisturbance
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.synthesis.certificate import Design

SAMPLES = 150
"""Horizon unless told otherwise: for the motor 1.5 s, seven times the uncontrolled mean settling time."""


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """What one experiment left: the controlled plant, the plant left alone from the same states, and the model.

    `on_model` is the certified situation: the model in the plant's place, no noise, no disturbance, no reference, the
    same initial outputs; None for a controller that has no model. `settling_band` in the output's unit.
    """

    controlled: Rollouts
    uncontrolled: Rollouts
    on_model: Rollouts | None
    settling_band: float
    input_equilibrium: Float[np.ndarray, "m"]


class Table(ABC):
    """`rows(plant, known, loop, seed)`: one flat row per case, missing values None, same columns in every row."""

    @abstractmethod
    def rows(self, plant: Plant, known: Identified, loop: "Loop", seed: int) -> list[Row]: ...


@dataclass(frozen=True, kw_only=True)
class Loop:
    """`initial_conditions` outputs uniform in the plant's `initial_range`, each simulated for `horizon_s` seconds.

    `horizon_s` None is `SAMPLES` sampling periods of the plant. Measured outputs carry Gaussian noise of variance
    `measurement_noise_variance` (unit of the output, squared; None is the plant's own) times `noise_factor`. A case
    whose output strays more than `bound_in_initial_ranges` times the initial range from the equilibrium, beyond what
    the reference asks, is stopped and counts as unstable. Input limits (unit of the input) are known to the controller.
    `comparison` is a table the run leaves beside its record, `comparison.csv`.
    """

    initial_conditions: int = 10
    horizon_s: float | None = None
    measurement_noise_variance: float | None = None
    noise_factor: float = 1.0
    bound_in_initial_ranges: float = 20.0
    input_lower: float | None = None
    input_upper: float | None = None
    reference: Reference = field(default_factory=Rest)
    disturbance: Disturbance = field(default_factory=NoDisturbance)
    comparison: Table | None = None

    def __post_init__(self) -> None:
        count, noise, far = self.initial_conditions, self.measurement_noise_variance, self.bound_in_initial_ranges
        require(count >= 1, "loop.initial_conditions", count, "at least one is needed", "use 10, as the paper does")
        require(
            self.horizon_s is None or 0 < self.horizon_s < np.inf,
            "loop.horizon_s",
            self.horizon_s,
            "the horizon must be positive",
            "give it in seconds",
        )
        require(
            noise is None or 0 <= noise < np.inf,
            "loop.measurement_noise_variance",
            noise,
            "a variance is not negative",
            "use 0 for no noise",
        )
        factor = self.noise_factor
        require(factor >= 0, "loop.noise_factor", factor, "a variance is not negative", "use 0 for no noise")
        require(far > 1, "loop.bound_in_initial_ranges", far, "cases would start outside the bound", "use more than 1")
        low, high = self.input_lower, self.input_upper
        require(
            low is None or high is None or low < high,
            "loop.input_lower, loop.input_upper",
            (low, high),
            "lower must be below upper",
            "swap them",
        )

    def run(self, plant: Plant, model: SSM, design: Design, seed: int) -> ClosedLoop:
        """The certified design on the plant, beside the plant left alone and the noise-free model."""
        controller = ObserverFeedback.of(model, design)
        result = self.compare(plant, {"design": controller}, seed)["design"]
        outputs = result.controlled.y[:, 0]
        return ClosedLoop(**{**vars(result), "on_model": self.on_model(plant, controller, outputs)})

    def compare(self, plant: Plant, controllers: dict[str, Controller], seed: int) -> dict[str, ClosedLoop]:
        """Every controller on the same plant, initial states, noise, reference and disturbance."""
        for controller in controllers.values():
            matched(plant, controller)
        rest = plant.equilibrium()
        y0, noise = self.draw(plant, seed)
        uncontrolled = self.uncontrolled(plant, y0, noise)
        return {
            name: ClosedLoop(
                controlled=self.simulate(plant, controller, y0, noise),
                uncontrolled=uncontrolled,
                on_model=None,
                settling_band=plant.settling_band,
                input_equilibrium=rest.u,
            )
            for name, controller in controllers.items()
        }

    def on_model(self, plant: Plant, controller: ObserverFeedback, y0: Float[np.ndarray, "N p"]) -> Rollouts:
        """The certified situation: the controller on its own model, nothing else acting."""
        twin = IdentifiedPlant(
            model=controller.model,
            input_channels=plant.inputs,
            output_channels=plant.outputs,
            initial_offset=max(abs(r) for r in plant.initial_range),
            settled_within=plant.settling_band,
        )
        quiet = Loop(
            initial_conditions=len(y0),
            horizon_s=self.horizon_s,
            measurement_noise_variance=0.0,
            bound_in_initial_ranges=self.bound_in_initial_ranges,
        )
        return quiet.simulate(twin, controller, y0, np.zeros((len(y0), self.samples(plant.step_s), y0.shape[1])))

    def uncontrolled(self, plant: Plant, y0: Float[np.ndarray, "N p"], noise: Float[np.ndarray, "N T p"]) -> Rollouts:
        """The plant left alone from the same states, under the same disturbance."""
        return self.simulate(plant, Uncontrolled(plant=plant), y0, noise)

    def samples(self, step_s: float) -> int:
        return SAMPLES if self.horizon_s is None else max(2, round(self.horizon_s / step_s))

    def draw(self, plant: Plant, seed: int) -> tuple[Float[np.ndarray, "N p"], Float[np.ndarray, "N T p"]]:
        """Initial outputs and measurement noise, the same for every controller at one seed."""
        shape = (self.initial_conditions, self.samples(plant.step_s), len(plant.outputs))
        initial, noise = (np.random.default_rng([seed, stream]) for stream in (0, 1))
        low, high = plant.initial_range
        y0 = plant.equilibrium().y + initial.uniform(low, high, size=(shape[0], shape[2]))
        given = self.measurement_noise_variance
        variance = self.noise_factor * np.array(plant.noise_variance if given is None else (given,) * shape[2])
        return y0, np.sqrt(variance) * noise.standard_normal(shape)

    def simulate(
        self, plant: Plant, controller: Controller, y0: Float[np.ndarray, "N p"], noise: Float[np.ndarray, "N T p"]
    ) -> Rollouts:
        """One batched closed loop from the states that read `y0`."""
        cases, samples, outputs = noise.shape
        time_s = np.arange(samples) * plant.step_s
        offset = self.reference.offset(time_s)
        disturbance = np.zeros((cases, samples, len(plant.disturbances)))
        if not isinstance(self.disturbance, NoDisturbance):
            remedy = "use disturbance@loop.disturbance=none"
            require(disturbance.shape[2] > 0, "loop.disturbance", self.disturbance, "the plant has none", remedy)
            disturbance[:, :, 0] = self.disturbance.signal(time_s)
        reach = self.bound_in_initial_ranges * max(abs(r) for r in plant.initial_range) + float(np.abs(offset).max())
        return close_loop(
            plant,
            controller,
            x0=plant.states_at(y0),
            reference=plant.equilibrium().y + np.repeat(offset[:, None], outputs, axis=1),
            noise=noise,
            disturbance=disturbance,
            bound=np.full(outputs, reach),
            input_lower=None if self.input_lower is None else np.full(len(plant.inputs), self.input_lower),
            input_upper=None if self.input_upper is None else np.full(len(plant.inputs), self.input_upper),
        )
