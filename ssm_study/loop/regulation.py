"""The experiment: initial conditions, noise, reference and disturbance, on the plant, without
control, on the model."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import Controller, ObserverFeedback, Uncontrolled
from ssm_study.loop.peers.peer import Identified, Row
from ssm_study.loop.reference import Reference, Rest
from ssm_study.loop.rollout import UNLIMITED, Limits, Rollouts, close_loop, settling_times_s
from ssm_study.loop.trajectory import equilibrium
from ssm_study.models.structured import Model, StructuredSSM, at_rest
from ssm_study.plants.disturbance import Disturbance, NoDisturbance
from ssm_study.plants.plant import Equilibrium, Plant
from ssm_study.refusal import BadRequest, at_least, positive, require
from ssm_study.signals import Channel, input_limits

Channels = tuple[Channel, ...]


@dataclass(frozen=True, kw_only=True)
class IdentifiedPlant(Plant):
    """`x+ = A x + B S_u(u) + B d,  y = S_y(C x)`: the model answers for itself, so the loop says
    nothing of mismatch.

    The state is the model's (scaled), `u` and `y` are physical; `d (m)` disturbs the recurrence's
    scaled input. Raises `BadRequest` for a model with feedthrough: the loop reads the output before
    the input acts.
    """

    model: Model
    step_s: float
    settling_band: float
    inputs: Channels = ()
    outputs: Channels = ()
    states: Channels = ()
    disturbances: Channels = ()
    initial_range: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        model = self.model
        remedy = "identify with model.feedthrough=false"
        problem = "the input reaches the output at once"
        told = "the loop samples the output before the input acts"
        require(not answers_at_once(model), "model.feedthrough", problem, told, remedy)
        channels = (len(self.inputs), len(self.outputs))
        needed = (model.scale.inputs, model.scale.outputs)
        require(
            channels == needed,
            "channels",
            channels,
            f"the model has {needed}",
            "name each of its signals",
        )

    @classmethod
    def of(cls, model: Model, inputs: Channels = (), outputs: Channels = ()) -> "IdentifiedPlant":
        """Channels are `u_1, ...` and `y_1, ...`, or without a number where there is one, unless
        given.

        Initial outputs lie within one `output_scale` of the equilibrium, and 5 % of it counts as
        settled.
        """
        unit = float(model.scale.output_scale.min())
        counts = {"u": model.scale.inputs, "y": model.scale.outputs}
        names = {
            one: [one] if n == 1 else [f"{one}_{i + 1}" for i in range(n)]
            for one, n in counts.items()
        }
        return cls(
            model=model,
            step_s=model.step_s,
            settling_band=0.05 * unit,
            inputs=inputs or tuple(Channel(name=name, unit="") for name in names["u"]),
            outputs=outputs or tuple(Channel(name=name, unit="") for name in names["y"]),
            states=tuple(Channel(name=f"x{i}", unit="1") for i in range(model.order)),
            disturbances=tuple(
                Channel(name=f"scaled_input_{i}", unit="1") for i in range(model.linear.b.shape[1])
            ),
            initial_range=(-unit, unit),
        )

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        return tuple(self.model.scale.input_scale.tolist())

    def equilibrium(self) -> Equilibrium:
        scale = self.model.scale
        return Equilibrium(
            u=scale.input_equilibrium, x=np.zeros(self.model.order), y=scale.output_equilibrium
        )

    def states_at(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N n"]:
        """States in which a constant input would hold `y0`: the model released from a set point.

        Where no input holds it (neurons may rectify or saturate), the smallest state that the
        linear part reads as it.
        """
        return np.stack([self._released(y) for y in y0])

    def _released(self, y: Float[np.ndarray, "p"]) -> Float[np.ndarray, "n"]:
        try:
            return equilibrium(self.model, y)[0]
        except BadRequest:
            if not isinstance(self.model, StructuredSSM):
                raise
            return np.linalg.pinv(self.model.c) @ self.model.scale.scaled_output(y)

    def advance(
        self, x: Float[np.ndarray, "N n"], u: Float[np.ndarray, "N m"], d: Float[np.ndarray, "N q"]
    ) -> Float[np.ndarray, "N n"]:
        return self.model.advance(x, self.model.lift(u) + d)

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N p"]:
        return self.model.read(x, np.zeros((len(x), self.model.linear.b.shape[1])))


def answers_at_once(model: Model) -> bool:
    """Whether the input reaches the output within its sample, by D or through a neuron."""
    through = isinstance(model, StructuredSSM) and bool(
        (model.g.any(axis=1) & model.h.any(axis=0)).any()
    )
    return through or bool(model.linear.d.any())


SAMPLES = (
    150,
    1500,
)  # shortest and longest horizon; 150 are 1.5 s on the motor, seven times its uncontrolled mean
RESPONSES = 4  # horizon, in lengths of the model's own response
REMAINDER = 0.01  # share of `sum |C A^k B|` that is left behind the length of the response


@dataclass(frozen=True, kw_only=True)
class LoopRuns:
    """Runs of one experiment: the controlled plant, the uncontrolled plant from the same states,
    and the model.

    `on_model` is `Loop.on_model`, None for a controller that has no model; `settling_band` in the
    output's unit. `noise_free`: without measurement noise, where that alone crosses the band;
    settling is then judged on it. `quiet`: without measurement noise, whatever it does; None where
    there is none.
    """

    controlled: Rollouts
    uncontrolled: Rollouts
    on_model: Rollouts | None = None
    settling_band: float
    input_equilibrium: Float[np.ndarray, "m"]
    noise_free: Rollouts | None = None
    quiet: Rollouts | None = None

    @property
    def judged(self) -> Rollouts:
        return self.noise_free or self.controlled


class ComparisonTable(ABC):
    """Table that a run writes beside its record, `comparison.csv`: one flat row per case, missing
    values None."""

    @abstractmethod
    def rows(self, plant: Plant, known: Identified, loop: "Loop", seed: int) -> list[Row]:
        """The same columns in every row."""


@dataclass(frozen=True, kw_only=True)
class Loop:
    """`initial_conditions` outputs uniform in the plant's `initial_range`, each simulated for
    `horizon_s` seconds.

    The fields are explained in conf/loop/regulation.yaml; the noise is Gaussian, its variance in
    the output's unit squared. The bound counts from the equilibrium and is wider by the largest
    offset of the reference. `comparison` is a table the run leaves beside its record,
    `comparison.csv`.
    """

    initial_conditions: int = 10
    horizon_s: float | None = None
    measurement_noise_variance: float | None = None
    noise_factor: float = 1.0
    bound_in_initial_ranges: float = 20.0
    input_lower: float | list[float] | None = None
    input_upper: float | list[float] | None = None
    reference: Reference = field(default_factory=Rest)
    disturbance: Disturbance = field(default_factory=NoDisturbance)
    comparison: ComparisonTable | None = None

    def __post_init__(self) -> None:
        far = self.bound_in_initial_ranges
        at_least(1, "loop.initial_conditions", self.initial_conditions, "use 10, as the paper does")
        positive("loop.horizon_s", self.horizon_s, "give it in seconds")
        at_least(
            0,
            "loop.measurement_noise_variance",
            self.measurement_noise_variance,
            "use 0 for no noise",
        )
        at_least(0, "loop.noise_factor", self.noise_factor, "use 0 for no noise")
        require(
            far > 1,
            "loop.bound_in_initial_ranges",
            far,
            "cases would start outside the bound",
            "use more than 1",
        )
        (low, high), names = self.limits, "loop.input_lower, loop.input_upper"
        shown = np.asarray(low).tolist(), np.asarray(high).tolist()
        require(bool(np.all(low < high)), names, shown, "lower must be below upper", "swap them")

    @property
    def limits(self) -> Limits:
        """For each input, or one for all."""
        ends = zip((self.input_lower, self.input_upper), UNLIMITED, strict=True)
        low, high = (np.asarray(none if end is None else end, dtype=float) for end, none in ends)
        return low, high

    def within(self, inputs: Sequence[Float[np.ndarray, "_ m"]]) -> "Loop":
        """This experiment, limited as given, else to the range of these recorded inputs."""
        low, high = input_limits(self.input_lower, self.input_upper, inputs)
        return replace(self, input_lower=low.tolist(), input_upper=high.tolist())

    def run(self, plant: Plant, model: Model, design: Design, seed: int) -> LoopRuns:
        """The certified design on the plant, beside the plant left alone and the noise-free
        model."""
        controller = ObserverFeedback.of(model, design)
        runs = self.on_plant(plant, controller, seed)
        return replace(runs, on_model=self.on_model(plant, controller, runs.controlled.y[:, 0]))

    def on_plant(self, plant: Plant, controller: Controller, seed: int) -> LoopRuns:
        """Any controller: at one seed all meet the same initial states, noise, reference and
        disturbance."""
        rest = plant.equilibrium()
        y0, noise = self.draw(plant, seed)
        controlled = self.simulate(plant, controller, y0, noise)
        quiet = None
        noise_free = None
        if noise.any():
            quiet = self.simulate(plant, controller, y0, np.zeros_like(noise))
            is_settled = None not in settling_times_s(controlled, plant.settling_band)
            if not is_settled and self._noise_crosses_band(plant, controller, noise):
                noise_free = quiet
        return LoopRuns(
            controlled=controlled,
            uncontrolled=self.simulate(plant, Uncontrolled.of(plant), y0, noise),
            settling_band=plant.settling_band,
            input_equilibrium=rest.u,
            noise_free=noise_free,
            quiet=quiet,
        )

    def _noise_crosses_band(
        self, plant: Plant, controller: Controller, noise: Float[np.ndarray, "N T p"]
    ) -> bool:
        """Whether a plant that starts at rest is carried out of the band by the noise alone."""
        still = replace(self, reference=Rest(), disturbance=NoDisturbance())
        y0 = np.tile(plant.equilibrium().y, (len(noise), 1))
        shaken = still.simulate(plant, controller, y0, noise)
        return bool((np.abs(shaken.y - shaken.reference) > plant.settling_band).any())

    def on_model(
        self, plant: Plant, controller: ObserverFeedback, y0: Float[np.ndarray, "N p"]
    ) -> Rollouts:
        """The certified situation: the controller on its own model from the same outputs, nothing
        else acting."""
        twin = IdentifiedPlant.of(controller.model, plant.inputs, plant.outputs)
        twin = replace(twin, initial_range=plant.initial_range)  # which the bound is a multiple of
        quiet = Loop(horizon_s=self.horizon_s, bound_in_initial_ranges=self.bound_in_initial_ranges)
        return quiet.simulate(
            twin, controller, y0, np.zeros((len(y0), self.samples(plant.step_s), y0.shape[1]))
        )

    def fitted(self, model: Model) -> "Loop":
        """This experiment with a horizon: as given, else `RESPONSES` times as long as the model's
        own response."""
        if self.horizon_s is not None:
            return self
        response = at_rest(model).response_samples(SAMPLES[1], REMAINDER)
        samples = int(np.clip(RESPONSES * response, *SAMPLES))
        return replace(self, horizon_s=samples * model.step_s)

    def samples(self, step_s: float) -> int:
        return SAMPLES[0] if self.horizon_s is None else max(2, round(self.horizon_s / step_s))

    def draw(
        self, plant: Plant, seed: int
    ) -> tuple[Float[np.ndarray, "N p"], Float[np.ndarray, "N T p"]]:
        """Initial outputs and measurement noise, the same for every controller at one seed."""
        shape = (self.initial_conditions, self.samples(plant.step_s), len(plant.outputs))
        initial, noise = (np.random.default_rng([seed, stream]) for stream in (0, 1))
        y0 = plant.equilibrium().y + initial.uniform(
            *plant.initial_range, size=(shape[0], shape[2])
        )
        given = self.measurement_noise_variance
        variance = self.noise_factor * np.array(
            plant.noise_variance if given is None else (given,) * shape[2]
        )
        return y0, np.sqrt(variance) * noise.standard_normal(shape)

    def simulate(
        self,
        plant: Plant,
        controller: Controller,
        y0: Float[np.ndarray, "N p"],
        noise: Float[np.ndarray, "N T p"],
    ) -> Rollouts:
        """One batched closed loop from the states that read `y0`."""
        cases, samples, outputs = noise.shape
        time_s = np.arange(samples) * plant.step_s
        offset = self.reference.signal(time_s)
        disturbance = np.zeros((cases, samples, len(plant.disturbances)))
        if not isinstance(self.disturbance, NoDisturbance):
            remedy = "use disturbance@loop.disturbance=none"
            require(
                disturbance.shape[2] > 0,
                "loop.disturbance",
                self.disturbance,
                "the plant has none",
                remedy,
            )
            disturbance[:, :, 0] = self.disturbance.signal(time_s)
        reach = self.bound_in_initial_ranges * max(abs(r) for r in plant.initial_range) + float(
            np.abs(offset).max()
        )
        asked = {
            "reference": plant.equilibrium().y + np.repeat(offset[:, None], outputs, axis=1),
            "noise": noise,
        }
        asked |= {
            "x0": plant.states_at(y0),
            "disturbance": disturbance,
            "bound": np.full(outputs, reach),
        }
        try:
            return close_loop(plant, controller, **asked, limits=self.limits)
        finally:
            plant.stop()
