"""Lightning module that trains a structured model. Its first epoch makes the initial parameters,
each further one is a step."""

from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.matrix_shapes import matrix_shapes
from ssm_study.models.spec import scale_records_with_disturbances
from ssm_study.models.structured import Model, StructuredSSM
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, fit_from_relative_error
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.pruning import prune_neurons
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.structured_problem import (
    CORE,
    FREE_CORE,
    DescentState,
    SimulationProblem,
    Theta,
    has_converged,
    minimise_simulation_error,
    take_step,
)
from ssm_study.training.structured_start import (
    add_random_neurons,
    contracting_initial_parameters,
    fit_from_random_poles,
    fit_initial_linear_model,
)

START_SAMPLES = 2000  # of which a start is made: the training goes on with all
UNPENALISED = 25  # steps before the penalty on the gain's sign
RACE = 5  # steps of each draw inside the contracting set
TRUSTED = 0.5  # of its loss: a least-squares start is replaced where random poles come below
Matrices = dict[str, Float[np.ndarray, "..."]]  # of a model, by their names
# Linear models with which trainings on the same records began, by their settings, each with the
# state of the random number generator after its fit.
LinearStarts = dict[tuple[object, ...], tuple[Theta, dict[str, Any]]]


class StructuredFit(pl.LightningModule):
    """Lightning module that trains a structured model by the Levenberg-Marquardt method. The
    parameters, the damping and the loss are buffers.

    So a checkpoint is the whole state, and a training that was killed goes on where it was. There
    is nothing for an optimiser of torch to do: the Jacobian is written out
    (`SimulationProblem.residual_and_jacobian`).
    """

    damping: torch.Tensor
    loss: torch.Tensor

    def __init__(
        self,
        spec: StructuredSpec,
        data: DataSet,
        seed: int,
        linear_starts: LinearStarts | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.linear_starts = {} if linear_starts is None else linear_starts
        self.initial_parameters: Theta = {}  # once computed; given, if the same run began before
        self.spec = spec
        self.data = data
        self.seed = seed
        self.integrates = bool(spec.integrating_output)
        self.problem = self._simulation_problem()
        self.estimates = data.start_up_samples > 0
        self.register_buffer("damping", torch.zeros((), dtype=torch.float64))
        self.register_buffer("loss", torch.full((), torch.nan, dtype=torch.float64))
        for name, shape in self._parameter_shapes().items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def _simulation_problem(self) -> SimulationProblem:
        """Build the least-squares problem of simulating the training records."""
        spec = self.spec
        scale = self.data.scale
        channels = (scale.inputs, scale.outputs)
        lift, read = spec.build_maps(channels, scale.disturbances)
        scaled_pairs = scale_records_with_disturbances(self.data)
        records = RecordBatch.from_pairs(scaled_pairs)
        rate = None if spec.rate is None else float(spec.rate)
        gain_share = spec.gain_share if self.integrates else 0.0
        return SimulationProblem(
            records=records,
            neurons=spec.neuron_kinds,
            lift=lift,
            read=read,
            rate=rate,
            integrating_output=self.integrates,
            ridge=spec.ridge,
            gain_share=gain_share,
        )

    def _parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each block of a structured model's trainable parameters."""
        spec = self.spec
        scale = self.data.scale
        n = int(spec.order)
        q = int(spec.neurons)
        p = scale.outputs
        drives = scale.inputs + scale.disturbances
        sizes: dict[str, tuple[int, ...]] = matrix_shapes(n, drives, p, q)
        if spec.rate is not None:
            sizes = {name: shape for name, shape in sizes.items() if name not in CORE}
            sizes["x_e"] = (n, q)
            sizes["x_g"] = (n + q, n)
            sizes["log_d"] = (q,)
        sizes["scaffold_in"] = self.problem.lift.parameter_channels.shape
        sizes["scaffold_out"] = self.problem.read.parameter_channels.shape
        record_count = len(self.data.training)
        sizes["x0"] = (record_count, n + p * self.integrates)
        return sizes

    @property
    def parameter_blocks(self) -> Theta:
        """Trainable parameters of a structured model as NumPy arrays, keyed by block."""
        return {
            name: part.cpu().numpy()
            for name, part in self.named_buffers()
            if name not in ("damping", "loss")
        }

    def start_training(self, steps: int) -> None:
        """Compute initial parameters, and improve them by a limited number of training steps."""
        start = self.initial_parameters or self._prepare_parameters()
        self.initial_parameters = start
        at = minimise_simulation_error(self.problem, start, self._trained_block_names, steps)
        self._store_descent_state(at)

    def _prepare_parameters(self) -> Theta:
        """Compute initial parameters; for a penalty on the gain's sign, improve them first without
        the penalty."""
        start = self._initial_parameters()
        return self._train_without_gain_penalty(start) if self.problem.gain_share else start

    def continue_training(self, steps: int) -> None:
        """Continue a training by a limited number of steps."""
        at = self._descent_state
        before = np.inf
        for _ in range(steps):
            if has_converged(before, at.loss, at.damping):
                break
            before = at.loss
            at = take_step(self.problem, at, self._trained_block_names)
        self._store_descent_state(at)

    @property
    def _descent_state(self) -> DescentState:
        """Current parameters, loss and damping of the training, read from the module's buffers."""
        theta = {name: part.copy() for name, part in self.parameter_blocks.items()}
        return DescentState(theta=theta, loss=float(self.loss), damping=float(self.damping))

    def _train_without_gain_penalty(self, start: Theta) -> Theta:
        """Parameters after some training steps without the penalty on the sign of the model's gain.
        With the penalty from the beginning, the training would end in far worse local minima."""
        free = replace(self.problem, gain_share=0.0)
        descent = minimise_simulation_error(free, start, self._trained_block_names, UNPENALISED)
        return descent.theta

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are in the problem
        """Compute initial parameters in the first epoch; take one training step in all others."""
        if torch.isnan(self.loss):
            self.start_training(0)
            return
        next_descent = take_step(self.problem, self._descent_state, self._trained_block_names)
        self._store_descent_state(next_descent)

    @property
    def _trained_block_names(self) -> tuple[str, ...]:
        """Names of the parameter blocks of a structured model that training changes."""
        rate = self.spec.rate
        core = CORE if rate is None else FREE_CORE
        return self._initial_fit_block_names(core, self.spec.input_path != "none")

    def _store_descent_state(self, state: DescentState) -> None:
        """Store parameters, loss and damping of the training in the module's buffers."""
        for name in self.parameter_blocks:
            buffer = getattr(self, name)
            stored_values = state.theta[name]
            buffer.copy_(torch.as_tensor(stored_values))
        self.loss.fill_(state.loss)
        self.damping.fill_(state.damping)

    def _initial_parameters(self) -> Theta:
        """Initial parameters of a structured model, fitted to few samples of the records. A linear
        fit and S_u come first; then neurons are drawn at random several times, and the best draw is
        taken."""
        spec = self.spec
        rng = np.random.default_rng(self.seed)
        stretch = self.problem.records.cut_varying_part(START_SAMPLES)
        short = replace(self.problem, records=stretch, gain_share=0.0)
        theta = self._linear_start(short, rng)
        draws = [self._draw_initial_neurons(short, theta, rng) for _ in range(spec.draws)]
        best_draw = min(draws, key=lambda draw: draw.loss)
        best = best_draw.theta
        # Records that the start has not seen begin at rest.
        x0 = np.zeros_like(self.parameter_blocks["x0"])
        if np.shares_memory(stretch.u[:1, :1], self.problem.records.u[:1, :1]):
            x0[: len(best["x0"])] = best["x0"]
        return best | {"x0": x0}

    def _linear_start(self, short: SimulationProblem, rng: np.random.Generator) -> Theta:
        """Fit a linear model, including its input map S_u, to which random neurons are added later.

        Models on the same records that differ only in their neurons begin with the same one. It is
        fitted once; the generator is then set to its state after that fit, so all later draws are
        the same.
        """
        settings = self._linear_start_settings
        if settings in self.linear_starts:
            theta, rng.bit_generator.state = self.linear_starts[settings]
            return theta
        spec = self.spec
        linear = replace(short, neurons=(), rate=None)
        moving = self._linear_block_names()
        theta = self._fit_linear_model(linear, moving, rng)
        if spec.knots or spec.output_knots:
            maps = (*moving, "scaffold_in", "scaffold_out")
            map_steps = spec.start_steps[1]
            fitted_maps = minimise_simulation_error(linear, theta, maps, map_steps)
            theta = fitted_maps.theta
        self.linear_starts[settings] = (theta, dict(rng.bit_generator.state))
        return theta

    @property
    def _linear_start_settings(self) -> tuple[object, ...]:
        """Settings of the search for model settings on which a fitted linear start depends."""
        spec = self.spec
        maps = (spec.knots, spec.output_knots)
        paths = (spec.feedthrough, spec.dead_time, self.integrates)
        return (self.seed, spec.order, *maps, *paths)

    def _linear_block_names(self) -> tuple[str, ...]:
        """Names of the parameter blocks that a linear model has."""
        direct = ("d",) if self.spec.feedthrough else ()
        starts = ("x0",) if self.estimates else ()
        return ("a", "b", "c", *direct, *starts)

    def _fit_linear_model(
        self, linear: SimulationProblem, block_names: tuple[str, ...], rng: np.random.Generator
    ) -> Theta:
        """Fit a linear model to the training records, from an ARX model or from random poles."""
        spec = self.spec
        steps = spec.start_steps[0]
        order = int(spec.order)
        feedthrough = bool(spec.feedthrough)
        start = fit_initial_linear_model(linear, order, feedthrough, rng)
        fitted = minimise_simulation_error(linear, start, block_names, steps)
        if self.integrates:
            return fitted.theta
        screened_start = fit_from_random_poles(linear, start, self.estimates, rng)
        screened = minimise_simulation_error(linear, screened_start, block_names, steps)
        is_better = screened.loss < TRUSTED * fitted.loss
        return screened.theta if is_better else fitted.theta

    def _draw_initial_neurons(
        self, short: SimulationProblem, theta: Theta, rng: np.random.Generator
    ) -> DescentState:
        """Draw random initial neurons, improve them by a few steps, and make the model contracting.
        A few steps without the constraint, the nearest contracting model, a few steps with the
        constraint."""
        spec = self.spec
        has_input_path = spec.input_path == "free"
        free = replace(short, rate=None)
        theta = add_random_neurons(free, theta, int(spec.neurons), rng)
        unconstrained = self._initial_fit_block_names(CORE, has_input_path)
        drawn = minimise_simulation_error(free, theta, unconstrained, spec.start_steps[2])
        if spec.rate is None:
            return drawn
        rate = float(spec.rate)
        theta = contracting_initial_parameters(free, drawn.theta, rate)
        constrained = self._initial_fit_block_names(FREE_CORE, has_input_path)
        return minimise_simulation_error(short, theta, constrained, RACE)

    def _initial_fit_block_names(self, core: tuple[str, ...], input_path: bool) -> tuple[str, ...]:
        """Names of the parameter blocks that are changed in one step of the initial fit."""
        spec = self.spec
        is_open = {
            "g": input_path,
            "h": spec.output_path == "free",
            "d": bool(spec.feedthrough),
            "x0": self.estimates,
        }
        paths = [name for name in is_open if is_open[name]]
        return (*core, "b", "c", "bias", "scaffold_in", "scaffold_out", *paths)

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        """Compute the fits to the training and validation records. That of training uses the fitted
        initial states, that of validation those of a score."""
        r = self.problem.weighted_error(self.parameter_blocks)
        relative_error = np.sqrt(r @ r)
        fit_training = fit_from_relative_error(relative_error)
        fit_validation = records_fit_percent(self.as_model(), self.data.validation, self.data)
        self.log("fit_training_percent", fit_training)
        self.log("fit_validation_percent", fit_validation)

    def configure_optimizers(self) -> None:
        """Return no optimiser: a training step uses the Jacobian instead of a gradient."""

    def as_model(self) -> StructuredSSM:
        """Identified structured model with the current parameters of the training. The running sum
        of `integrating_output` is one more state per output."""
        theta = self.parameter_blocks
        matrices = self.problem.kernel_matrices(theta)
        parts: dict[str, Any] = matrices._asdict()
        del parts["kinds"]
        if self.integrates:
            parts |= append_integrator(parts)
        if self.data.scale.disturbances:
            scale = self.data.scale
            parts |= split_disturbance_columns(parts, scale.inputs)
        input_map = self.problem.lift.to_numpy(theta["scaffold_in"])
        output_map = self.problem.read.to_numpy(theta["scaffold_out"])
        return StructuredSSM(
            **parts,
            neurons=self.spec.neuron_kinds,
            scaffold_in=input_map,
            scaffold_out=output_map,
            scale=self.data.scale,
            step_s=self.data.step_s,
        )

    def trained_model_with_remark(self) -> tuple[Model, str]:
        """Trained model without superfluous neurons, and a remark on how many were removed.

        Without any neuron it is the model of one layer, of which more can be proved.
        """
        whole_model = self.as_model()
        model = prune_neurons(whole_model, self.data.training)
        kept_neurons = len(model.neurons)
        idle = len(self.spec.neuron_kinds) - kept_neurons
        note = f"; neurons removed because they did nothing: {idle}" if idle else ""
        smallest_model = model if model.neurons else SSM.from_json(model.to_json())
        return smallest_model, note


def append_integrator(parts: Matrices) -> Matrices:
    """Append an integrator (running sum) to the output of a recurrence. The running sums are
    states, and the output."""
    a = parts["a"]
    c = parts["c"]
    f = parts["f"]
    n = len(a)
    p = len(c)
    none = np.zeros((n, p))
    unseen = np.zeros((len(f), p))
    state_row = [a, none]
    sum_row = [c, np.eye(p)]
    integrating = {"a": np.block([state_row, sum_row])}
    integrating["b"] = np.vstack([parts["b"], parts["d"]])
    integrating["e"] = np.vstack([parts["e"], parts["h"]])
    integrating["f"] = np.hstack([f, unseen])
    integrating["c"] = np.eye(p, n + p, n)
    integrating["d"] = np.zeros_like(parts["d"])
    integrating["h"] = np.zeros_like(parts["h"])
    return integrating


def split_disturbance_columns(parts: Matrices, inputs: int) -> Matrices:
    """Split input matrices into columns for inputs and for measured disturbances."""
    split = {name: parts[name][:, :inputs] for name in ("b", "d", "g")}
    disturbance_columns = parts["b"][:, inputs:]
    disturbance_part = {"b_d": disturbance_columns}
    return split | disturbance_part
