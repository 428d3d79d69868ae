"""Closed-loop experiments on the plant, on the uncontrolled plant and on the model."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import Controller, NoControl, ObserverFeedback
from ssm_study.loop.motion import settling_times_s
from ssm_study.loop.peers.peer import IdentificationResult, Row
from ssm_study.loop.reference import EquilibriumReference, Reference
from ssm_study.loop.rollout import UNLIMITED, Limits, Rollouts, simulate_closed_loop
from ssm_study.loop.trajectory import find_map_arguments, scaled_equilibrium
from ssm_study.models.structured import Model, StructuredSSM, linearise_at_equilibrium
from ssm_study.plants.disturbance import Disturbance, NoDisturbance
from ssm_study.plants.plant import Equilibrium, Plant
from ssm_study.refusal import BadRequest, require, require_at_least, require_positive
from ssm_study.signals import Channel, input_limits

Channels = tuple[Channel, ...]


Outputs = Float[np.ndarray, "N p"]
States = Float[np.ndarray, "N n"]
OutputSignals = Float[np.ndarray, "N T p"]


@dataclass(frozen=True, kw_only=True)
class IdentifiedPlant(Plant):
    """Identified model that is simulated in place of the plant.

    `x+ = A x + B S_u(u) + B d,  y = S_y(C x)`. The state is the model's (scaled), `u` and `y` are
    physical; `d (m)` disturbs the recurrence's
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
        remedy = "identify with model.feedthrough=false, or give matrices with D = 0"
        value = "the input reaches the output at once"
        problem = "the loop samples the output before the input acts"
        require(not has_direct_feedthrough(model), "model.feedthrough", value, problem, remedy)
        channels = (len(self.inputs), len(self.outputs))
        inputs = model.scale.inputs
        needed = (inputs, model.scale.outputs)
        problem = f"the model has {needed}"
        require(channels == needed, "channels", channels, problem, "name each of its signals")

    @classmethod
    def from_model(
        cls, model: Model, inputs: Channels = (), outputs: Channels = ()
    ) -> "IdentifiedPlant":
        """Simulated plant that behaves exactly as an identified model. Channels without a name are
        called `u_1, ...` and `y_1, ...`, or `u` and `y`.

        Initial outputs lie within one `output_scale` of the equilibrium, and 5 % of it counts as
        settled.
        """
        output_scale = model.scale.output_scale
        unit = float(output_scale.min())
        scaled_inputs = model.linear.b.shape[1]
        initial_range = (-unit, unit)
        return cls(
            model=model,
            step_s=model.step_s,
            settling_band=0.05 * unit,
            inputs=inputs or _number_channels("u", model.scale.inputs),
            outputs=outputs or _number_channels("y", model.scale.outputs),
            states=_scaled_channels("x", model.order),
            disturbances=_scaled_channels("scaled_input_", scaled_inputs),
            initial_range=initial_range,
        )

    @property
    def input_amplitude(self) -> tuple[float, ...]:
        """Scale of each input of the identified model, in physical units."""
        input_scale = self.model.scale.input_scale
        return tuple(input_scale.tolist())

    def equilibrium(self) -> Equilibrium:
        """Equilibrium of the identified model in physical units."""
        scale = self.model.scale
        x = np.zeros(self.model.order)
        return Equilibrium(u=scale.input_equilibrium, x=x, y=scale.output_equilibrium)

    def equilibrium_states(self, y0: Outputs) -> States:
        """States at which a constant input holds the model's outputs at given values.

        Where no input holds it (neurons may rectify or saturate; fewer inputs than outputs hold
        few outputs; the swing of a crane returns to zero at every speed of its trolley), the
        smallest state that the linear part reads as it.
        """
        return np.stack([self._equilibrium_state(y) for y in y0])

    def _equilibrium_state(self, y: Float[np.ndarray, "p"]) -> Float[np.ndarray, "n"]:
        """State at which a constant input holds the outputs of the model at given values."""
        with suppress(BadRequest):
            state, holding_input = scaled_equilibrium(self.model, y)
            if np.abs(holding_input).max() <= FARTHEST_HELD:
                return state
        scaled_output = self.model.scale.scaled_output(y)
        if not isinstance(self.model, StructuredSSM):
            scaffold = self.model.scaffold_out
            matrix = find_map_arguments(scaffold, scaled_output[None])
            scaled_output = matrix[0]
        linear_c = self.model.linear.c
        pseudo_inverse = np.linalg.pinv(linear_c)
        return pseudo_inverse @ scaled_output

    def next_states(
        self, x: States, u: Float[np.ndarray, "N m"], d: Float[np.ndarray, "N q"]
    ) -> States:
        """Next states of the identified model, with disturbances added to the mapped input."""
        mapped_input = self.model.map_input(u)
        return self.model.next_state(x, mapped_input + d)

    def disturbance_effect(self, measured: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n"]:
        """Effect of measured disturbances on the next state of the identified model."""
        return self.model.disturbance_contribution(measured)

    def output(self, x: States) -> Outputs:
        """Outputs of the identified model in physical units."""
        linear_b = self.model.linear.b
        no_input = np.zeros((len(x), linear_b.shape[1]))
        return self.model.output_at(x, no_input)


def _number_channels(name: str, count: int) -> Channels:
    """Channels with a common name and without units, numbered from 1 if there are several."""
    if count == 1:
        channel = Channel(name=name, unit="")
        return (channel,)
    return tuple(Channel(name=f"{name}_{i + 1}", unit="") for i in range(count))


def _scaled_channels(prefix: str, count: int) -> Channels:
    """Channels of scaled (dimensionless) signals, named by a common prefix and a number from 0."""
    return tuple(Channel(name=f"{prefix}{i}", unit="1") for i in range(count))


def has_direct_feedthrough(model: Model) -> bool:
    """Whether the input of a model affects the output within the same sample."""
    through_neuron = False
    if isinstance(model, StructuredSSM):
        is_driven = model.g.any(axis=1)
        is_read = model.h.any(axis=0)
        through_neuron = bool((is_driven & is_read).any())
    return through_neuron or bool(model.linear.d.any())


# shortest and longest horizon; 150 are 1.5 s on the motor, seven times its uncontrolled mean
SAMPLES = (150, 1500)
# Of the input's scale: an output that takes a larger input to be held is not held by the plant.
FARTHEST_HELD = 10.0
RESPONSES = 4  # horizon, in lengths of the model's own response
REMAINDER = 0.01  # share of `sum |C A^k B|` that is left behind the length of the response


@dataclass(frozen=True, kw_only=True)
class LoopRuns:
    """Simulations of one closed-loop experiment: plant, plant without control, and model.

    `on_model` is `LoopExperiment.run_on_model`, None for a controller that has no model;
    `settling_band` in the output's unit. `noise_free` is a simulation without measurement noise,
    made if the noise alone crosses the band; settling is then judged by it. `quiet` is one without
    measurement noise in any case; None if the plant has no noise.
    """

    controlled: Rollouts
    uncontrolled: Rollouts
    on_model: Rollouts | None = None
    settling_band: float
    input_equilibrium: Float[np.ndarray, "m"]
    noise_free: Rollouts | None = None
    quiet: Rollouts | None = None

    @property
    def rollouts_for_settling(self) -> Rollouts:
        """Simulations of the controlled plant from which settling times are computed: without noise
        if noise alone exceeds the settling band."""
        return self.noise_free or self.controlled


class ComparisonTable(ABC):
    """Interface of tables of closed-loop simulations that a run writes to `comparison.csv`."""

    @abstractmethod
    def rows(
        self, plant: Plant, identified: IdentificationResult, loop: "LoopExperiment", seed: int
    ) -> list[Row]:
        """Rows of a comparison table, all with the same columns. Missing values are None."""


@dataclass(frozen=True, kw_only=True)
class LoopExperiment:
    """Settings of a closed-loop experiment from several initial outputs over a fixed horizon.

    The `initial_conditions` outputs are uniform in the plant's `initial_range`. The fields are
    explained in conf/loop/regulation.yaml; the noise is Gaussian, its variance in the output's unit
    squared. The bound counts from the equilibrium and is wider by the largest offset of the
    reference. `comparison` is a table the run leaves beside its record, `comparison.csv`.
    """

    initial_conditions: int = 10
    horizon_s: float | None = None
    measurement_noise_variance: float | None = None
    noise_factor: float = 1.0
    bound_in_initial_ranges: float = 20.0
    input_lower: float | list[float] | None = None
    input_upper: float | list[float] | None = None
    reference: Reference = field(default_factory=EquilibriumReference)
    disturbance: Disturbance = field(default_factory=NoDisturbance)
    comparison: ComparisonTable | None = None

    def __post_init__(self) -> None:
        bound = self.bound_in_initial_ranges
        variance = self.measurement_noise_variance
        require_at_least(
            1, "loop.initial_conditions", self.initial_conditions, "use 10, as the paper does"
        )
        require_positive("loop.horizon_s", self.horizon_s, "give it in seconds")
        require_at_least(0, "loop.measurement_noise_variance", variance, "use 0 for no noise")
        require_at_least(0, "loop.noise_factor", self.noise_factor, "use 0 for no noise")
        problem = "the cases would start outside this bound"
        require(bound > 1, "loop.bound_in_initial_ranges", bound, problem, "use more than 1")
        low, high = self.limits
        names = "loop.input_lower, loop.input_upper"
        values = (np.asarray(low).tolist(), np.asarray(high).tolist())
        is_range = bool(np.all(low < high))
        require(is_range, names, values, "lower must be below upper", "swap them")

    @property
    def limits(self) -> Limits:
        """Lower and upper input limits of an experiment, one for each input or one for all."""
        lowest, highest = UNLIMITED
        low = lowest if self.input_lower is None else self.input_lower
        high = highest if self.input_upper is None else self.input_upper
        return np.asarray(low, dtype=float), np.asarray(high, dtype=float)

    def with_default_limits(
        self, recorded_inputs: Sequence[Float[np.ndarray, "_ m"]]
    ) -> "LoopExperiment":
        """Copy of a closed-loop experiment in which missing input limits are the range of the
        recorded inputs."""
        low, high = input_limits(self.input_lower, self.input_upper, recorded_inputs)
        input_lower = low.tolist()
        input_upper = high.tolist()
        return replace(self, input_lower=input_lower, input_upper=input_upper)

    def run_design(self, plant: Plant, model: Model, design: Design, seed: int) -> LoopRuns:
        """Simulate a certified design on the plant and, without noise, on the model for
        comparison."""
        controller = ObserverFeedback.from_design(model, design)
        runs = self.run_on_plant(plant, controller, seed)
        initial_outputs = runs.controlled.y[:, 0]
        on_model = self.run_on_model(plant, controller, initial_outputs)
        return replace(runs, on_model=on_model)

    def run_on_plant(self, plant: Plant, controller: Controller, seed: int) -> LoopRuns:
        """Simulate a plant with a controller and, for comparison, without control.
        At one seed all controllers meet the same initial states, noise, reference and disturbance.
        """
        rest = plant.equilibrium()
        y0, noise = self.draw_starts_and_noise(plant, seed)
        controlled = self.simulate(plant, controller, y0, noise)
        quiet = None
        noise_free = None
        if noise.any():
            quiet = self.simulate(plant, controller, y0, np.zeros_like(noise))
            times_s = settling_times_s(controlled, plant.settling_band)
            is_settled = None not in times_s
            if not is_settled and self._noise_exceeds_band(plant, controller, noise):
                noise_free = quiet
        uncontrolled = self.simulate(plant, NoControl.for_plant(plant), y0, noise)
        return LoopRuns(
            controlled=controlled,
            uncontrolled=uncontrolled,
            settling_band=plant.settling_band,
            input_equilibrium=rest.u,
            noise_free=noise_free,
            quiet=quiet,
        )

    def _noise_exceeds_band(
        self, plant: Plant, controller: Controller, noise: OutputSignals
    ) -> bool:
        """Whether measurement noise alone moves the controlled output beyond the settling band."""
        still = replace(self, reference=EquilibriumReference(), disturbance=NoDisturbance())
        equilibrium = plant.equilibrium()
        cases = len(noise)
        y0 = np.tile(equilibrium.y, (cases, 1))
        shaken = still.simulate(plant, controller, y0, noise)
        distance = np.abs(shaken.y - shaken.reference)
        is_outside = distance > plant.settling_band
        return bool(is_outside.any())

    def run_on_model(self, plant: Plant, controller: ObserverFeedback, y0: Outputs) -> Rollouts:
        """Simulate a controller in closed loop with its own model, without noise and disturbance.
        This is the situation that the certificate speaks of.
        """
        twin = IdentifiedPlant.from_model(controller.model, plant.inputs, plant.outputs)
        twin = replace(twin, initial_range=plant.initial_range)  # the bound is a multiple of it
        quiet = LoopExperiment(
            horizon_s=self.horizon_s, bound_in_initial_ranges=self.bound_in_initial_ranges
        )
        cases, outputs = y0.shape
        samples = self.horizon_samples(plant.step_s)
        no_noise = np.zeros((cases, samples, outputs))
        return quiet.simulate(twin, controller, y0, no_noise)

    def with_default_horizon(self, model: Model) -> "LoopExperiment":
        """Copy of a closed-loop experiment in which a missing horizon is set to suit the model. It
        is `RESPONSES` times the model's response."""
        if self.horizon_s is not None:
            return self
        response = linearise_at_equilibrium(model).impulse_response_length(SAMPLES[1], REMAINDER)
        samples = int(np.clip(RESPONSES * response, *SAMPLES))
        horizon_s = samples * model.step_s
        return replace(self, horizon_s=horizon_s)

    def horizon_samples(self, step_s: float) -> int:
        """Number of samples in the horizon of a closed-loop experiment."""
        if self.horizon_s is None:
            return SAMPLES[0]
        return max(2, round(self.horizon_s / step_s))

    def draw_starts_and_noise(self, plant: Plant, seed: int) -> tuple[Outputs, OutputSignals]:
        """Draw random initial outputs and measurement noise, the same for every controller."""
        cases = self.initial_conditions
        samples = self.horizon_samples(plant.step_s)
        outputs = len(plant.outputs)
        initial_stream = np.random.default_rng([seed, 0])
        noise_stream = np.random.default_rng([seed, 1])
        offsets = initial_stream.uniform(*plant.initial_range, size=(cases, outputs))
        variances: Sequence[float] = plant.noise_variance
        if self.measurement_noise_variance is not None:
            variances = (self.measurement_noise_variance,) * outputs
        deviation = np.sqrt(self.noise_factor * np.array(variances))
        white_noise = noise_stream.standard_normal((cases, samples, outputs))
        noise = deviation * white_noise
        equilibrium = plant.equilibrium()
        return equilibrium.y + offsets, noise

    def simulate(
        self,
        plant: Plant,
        controller: Controller,
        initial_outputs: Outputs,
        noise: OutputSignals,
        measured_disturbance: Float[np.ndarray, "T k"] | None = None,
    ) -> Rollouts:
        """Simulate a closed loop from several initial outputs at once.

        Measured disturbances are at their equilibrium unless given.
        """
        cases, samples, outputs = noise.shape
        time_s = np.arange(samples) * plant.step_s
        offset = self.reference.signal(time_s)
        offsets = np.repeat(offset[:, None], outputs, axis=1)
        disturbance = np.zeros((cases, samples, len(plant.disturbances)))
        signal = self.disturbance
        if not isinstance(signal, NoDisturbance):
            has_disturbance = disturbance.shape[2] > 0
            remedy = "use disturbance@loop.disturbance=none"
            require(has_disturbance, "loop.disturbance", signal, "the plant has none", remedy)
            disturbance[:, :, 0] = signal.signal(time_s)
        largest_start = max(abs(end) for end in plant.initial_range)
        largest_offset = float(np.abs(offset).max())
        reach = self.bound_in_initial_ranges * largest_start + largest_offset
        reference = plant.equilibrium().y + offsets
        x0 = plant.equilibrium_states(initial_outputs)
        try:
            bound = np.full(outputs, reach)
            return simulate_closed_loop(
                plant,
                controller,
                initial_states=x0,
                reference=reference,
                noise=noise,
                disturbance=disturbance,
                bound=bound,
                limits=self.limits,
                measured_disturbance=measured_disturbance,
            )
        finally:
            plant.stop()
