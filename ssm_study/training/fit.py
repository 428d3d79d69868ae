"""Lightning module that trains a torch model on windows of the records."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call

from ssm_study.models.identified import Simulator
from ssm_study.models.metrics import estimate_initial_state
from ssm_study.models.torch_recurrence import allow_forward_derivatives
from ssm_study.models.torch_ssm import InputMapping, Signals, States, TorchModel, TorchSSM
from ssm_study.refusal import require
from ssm_study.signals import DataSet, fit_from_relative_error
from ssm_study.training.optimisers import Levenberg, trainable_parameters
from ssm_study.training.windows import RecordWindows, Windows, pad_records

if TYPE_CHECKING:
    from ssm_study.training.training import Training

POLISH_STEPS = 20  # they undo the rounding, not the optimum
UNMOVED = (
    1e-12  # scaled units, squared: a state that never moves has no size to measure its defects by
)


class TrainingBatch(nn.Module):
    """Batch of scaled training records, cut into windows of equal length. Shorter ones are padded
    at the end, without weight.

    `u (e, T, m)`, with measured disturbances as further columns, `y (e, T, p)`, `weight (e, T,
    1)`: zero in the `unscored` samples of the cut and in the padding, and scaled so that
    `sum(weight |y - mean|^2) = 1`, the mean taken over all records. Then the loss is `(1 - fit /
    100)^2` for one channel.
    """

    u: Tensor
    y: Tensor
    weight: Tensor
    scored: Tensor
    sum_spread: Tensor

    def __init__(self, cut: RecordWindows, data: DataSet, sorts: bool, share: float = 0.0) -> None:
        super().__init__()
        self.integrated_share = share
        scale = data.scale.with_disturbances_as_inputs()
        scaled_pairs = [
            (scale.scaled_input(r.inputs_and_disturbances), scale.scaled_output(r.y))
            for r in cut.pieces
        ]
        u, y = pad_records(scaled_pairs)
        record_shape = u.shape[:2]
        scored = np.zeros((*record_shape, 1))
        pieces = zip(cut.pieces, cut.unscored, strict=True)
        for e, (piece, unscored) in enumerate(pieces):
            scored[e, unscored : len(piece)] = 1.0
        records_and_samples = (0, 1)
        weighted_sum = (scored * y).sum(axis=records_and_samples)
        scored_count = scored.sum()
        mean = weighted_sum / scored_count  # one offset for all records
        squares = (y - mean) ** 2
        scored_squares = scored * squares
        spread = float(scored_squares.sum())
        buffers = {"u": u, "y": y, "weight": scored / spread, "scored": scored}
        for name, values in buffers.items():
            self.register_buffer(name, torch.from_numpy(values), persistent=False)
        scored_outputs = self.scored * self.y
        running_sums = scored_outputs.cumsum(1)
        summed = running_sums * self.scored  # of y as of its error, see `training_objective`
        squared_sums = summed.square()
        self.register_buffer("sum_spread", squared_sums.sum(), persistent=False)
        input_count = data.scale.inputs
        plain_inputs = self.u[..., :input_count]
        self.lift = InputMapping(plain_inputs, sorts)

    def simulate(self, model: TorchModel, x0: States | None = None) -> Signals:
        """Simulate a model in free run over all training windows."""
        mapped = self._mapped_inputs(model)
        return model(self.u, x0, **mapped)

    def simulate_with_final_state(self, model: TorchModel, x0: States) -> tuple[Signals, States]:
        """Simulate a model over all training windows, and return the outputs and the final states.
        Padding is simulated, too."""
        mapped = self._mapped_inputs(model)
        return model.simulate_with_final_state(self.u, x0, **mapped)

    def _mapped_inputs(self, model: TorchModel) -> dict[str, Signals]:
        """Training inputs after a model's static input map, computed once for all windows; empty
        for models without such a map."""
        if not isinstance(model, TorchSSM):
            return {}
        mapped_inputs = self.lift(model.scaffold_in)
        signals = model.driving_signals(self.u, mapped_inputs)
        return {"lifted": signals}

    def squared_error(self, y_hat: Signals) -> Float[Tensor, ""]:
        """Weighted sum of squared simulation errors, `sum weight |e|^2`, from which the fit is
        computed."""
        squared_error = (y_hat - self.y) ** 2
        weighted_squares = self.weight * squared_error
        return weighted_squares.sum()

    def training_objective(self, y_hat: Signals) -> Float[Tensor, ""]:
        """Training objective for simulated outputs: squared error, plus a weighted square of the
        error's running sum. `(1 - share) sum weight |e|^2 + share |running sum of e|^2 / |running
        sum of y|^2`.

        The running sum is what an integrator behind the output sees: position, where y is a
        velocity.
        """
        if self.integrated_share == 0.0:
            return self.squared_error(y_hat)
        scored_error = self.scored * (y_hat - self.y)
        running_error = scored_error.cumsum(1)
        summed = running_error * self.scored
        squared_drift = summed.square()
        drift = squared_drift.sum() / self.sum_spread  # relative to the sum of y itself
        error_part = (1 - self.integrated_share) * self.squared_error(y_hat)
        drift_part = self.integrated_share * drift
        return error_part + drift_part


class InitialStates(nn.Module):
    """Initial states of the training windows as trainable parameters. `(e, n)`: rest, except for
    the rows that are parameters."""

    rows: Tensor
    later: Tensor

    def __init__(
        self, cut: RecordWindows, rows: Sequence[int], values: States, weight: float
    ) -> None:
        super().__init__()
        self.cut = cut
        self.weight = weight
        trained_rows = ("rows", rows)
        continued_rows = ("later", cut.continuing_window_indices)
        for name, places in (trained_rows, continued_rows):
            indices = torch.tensor(places, dtype=torch.int64)
            self.register_buffer(name, indices, persistent=False)
        first_values = values[self.rows]
        self.free = nn.Parameter(first_values.clone())

    def forward(self) -> States:
        """Initial states of all training windows."""
        window_count = len(self.cut.pieces)
        state_width = self.free.shape[1]
        zero_states = self.free.new_zeros(window_count, state_width)
        return zero_states.index_copy(0, self.rows, self.free)

    def shooting_defects(self, ends: States, starts: States) -> Float[Tensor, "k n"]:
        """Weighted differences between the final state of each window and the initial state of the
        next (multiple shooting)."""
        reached = ends[self.later - 1]  # where the window before ends
        squares = reached.square()
        sum_of_squares = squares.sum(0)
        state_count = reached.shape[1]
        size = (sum_of_squares + UNMOVED) * state_count / self.weight
        continued_starts = starts[self.later]
        difference = reached - continued_starts
        root_size = torch.sqrt(size)
        return difference / root_size


def roughness_penalty(model: TorchModel, weight: float) -> Float[Tensor, ""]:
    """Training penalty on the total variation of the slopes of a model's static maps. `weight
    (TV(S_u') + TV(S_y'))`; zero for a baseline.

    It is free of scale, so a weight of 0.001 means a thousandth of the output's variance.
    """
    if weight > 0 and isinstance(model, TorchSSM):
        input_roughness = model.scaffold_in.roughness()
        output_roughness = model.scaffold_out.roughness()
        roughness = input_roughness + output_roughness
        return weight * roughness
    return torch.zeros(())


class TorchFit(pl.LightningModule):
    """Lightning module that trains a torch model and, where they are free, the initial states of
    the training windows. It minimises the training loss over these parameters.

    `whole` are the records that the windows were cut from: the training fit that is shown is always
    that of whole records. Raises `BadRequest` for settings that this model cannot have.
    """

    def __init__(self, model: TorchModel, data: DataSet, settings: "Training") -> None:
        super().__init__()
        self.automatic_optimization = False
        sorts = not isinstance(settings.optimiser, Levenberg)  # which differentiates forward
        able = sorts or model.differentiates_forward
        require(
            able,
            "training.optimiser",
            "levenberg",
            "this model has no forward derivatives",
            "use lbfgs or adam",
        )
        cut = settings.windows.cut_records(data.training, data.start_up_samples)
        training, validation = (
            Windows().cut_records(r, data.start_up_samples)
            for r in (data.training, data.validation)
        )
        self.model = model
        self.data = data
        self.settings = settings
        self.training_records = TrainingBatch(cut, data, sorts, settings.integrated_share)
        self.validation_records = TrainingBatch(validation, data, sorts)
        self.whole = (
            TrainingBatch(training, data, sorts)
            if cut.continuing_window_indices
            else self.training_records
        )
        self.starts = self._trainable_initial_states(cut)

    def _trainable_initial_states(self, cut: RecordWindows) -> InitialStates | None:
        """Initial states of the training windows as trainable parameters; None if every window
        begins at the equilibrium."""
        model = self.model
        weight = self.settings.windows.continuity_weight
        how = self.settings.initial_state
        moving = how == "estimated" or (how == "auto" and self.data.start_up_samples > 0)
        moving = moving and isinstance(
            model, TorchSSM
        )  # whose stored model estimates it, too (`free_run`)
        problem = "this model has no state to start a window from"
        remedy = "use training.windows.samples=null"
        able = model.states > 0 or not cut.continuing_window_indices
        windows = self.settings.windows
        require(able, "training.windows.samples", windows.samples, problem, remedy)
        moving_rows = cut.first if moving else ()
        rows = [*moving_rows, *cut.continuing_window_indices]
        values = window_initial_states(model, self.training_records, cut) if rows else None
        return None if values is None else InitialStates(cut, sorted(rows), values, weight)

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are the batch
        """Train for one epoch by a step of the optimiser. Lightning's work around each call costs
        more than a step of a small model."""
        optimiser: Any = self.optimizers()
        for _ in range(self.settings.optimiser.calls_per_epoch):
            optimiser.step(self._backpropagate_loss)
        rates: Any = self.lr_schedulers()
        if rates is not None:
            rates.step()

    def _backpropagate_loss(self) -> Tensor:
        """Compute the training loss of the current model and its gradient."""
        self.zero_grad()
        loss = self.training_loss()
        loss.backward()
        return loss.detach()

    def training_loss(self) -> Tensor:
        """Training loss of the current model: simulation error, multiple-shooting defects and
        roughness penalty."""
        y_hat, defects = self.simulate_windows()
        weight = self.settings.roughness_weight
        added = roughness_penalty(self.model, weight)
        objective = self.training_records.training_objective(y_hat)
        squared_defects = defects.square()
        return objective + squared_defects.sum() + added

    def simulate_windows(self) -> tuple[Signals, Float[Tensor, "k n"]]:
        """Simulate all training windows, and compute the differences of state between successive
        windows."""
        x0 = None if self.starts is None else self.starts()
        if self.starts is None or x0 is None or not self.starts.cut.continuing_window_indices:
            outputs = self.training_records.simulate(self.model, x0)
            no_defects = self.training_records.y.new_zeros(0, 0)
            return outputs, no_defects
        y_hat, ends = self.training_records.simulate_with_final_state(self.model, x0)
        defects = self.starts.shooting_defects(ends, x0)
        return y_hat, defects

    def forward(self) -> Float[Tensor, "N"]:
        """Weighted simulation errors and multiple-shooting defects, whose squared sum the training
        minimises. `sqrt(weight) (y_hat - y)`, then the defects."""
        records, (y_hat, defects) = self.training_records, self.simulate_windows()
        root_weight = torch.sqrt(records.weight)
        error = y_hat - records.y
        weighted_error = (root_weight * error).flatten()
        flat_defects = defects.flatten()
        return torch.cat([weighted_error, flat_defects])

    def residuals_at(self, flat: Float[Tensor, "P"]) -> Float[Tensor, "N"]:
        """Residuals of the least-squares training problem as a function of all trainable
        parameters."""
        named = [(name, p) for name, p in self.named_parameters() if p.requires_grad]
        sizes = [p.numel() for _, p in named]
        parts = flat.split(sizes)
        named_parts = zip(named, parts, strict=True)
        values = {name: part.view(p.shape) for (name, p), part in named_parts}
        with allow_forward_derivatives():
            return functional_call(self, values, ())

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        """Compute the fits of the current model to the training and validation records. They are
        minus infinity for a loss that is not finite.

        What an optimiser evaluated last may be a trial that it refused, or the model before its
        last step.
        """
        fitted = None if self.starts is None else self.starts()[list(self.starts.cut.first)]
        start_up_samples = self.data.start_up_samples
        moving = start_up_samples > 0 and isinstance(self.model, TorchSSM)
        estimated = self._estimate_validation_states() if moving else None
        training_part = ("training", self.whole, fitted)
        validation_part = ("validation", self.validation_records, estimated)
        for name, records, x0 in (training_part, validation_part):
            outputs = records.simulate(self.model, x0)
            loss = float(records.squared_error(outputs))
            self.log(
                f"fit_{name}_percent",
                fit_from_relative_error(loss**0.5) if np.isfinite(loss) else -np.inf,
            )

    def _estimate_validation_states(self) -> States:
        """Estimate the initial states of the validation records from their first samples.

        A record that starts in motion says nothing about a model that simulates it from rest:
        validation would then stop a training, or choose among several, by the error of the initial
        state.
        """
        like = next(self.model.parameters())
        records = self.data.validation
        parameters = self.model.parameters()
        are_finite = (torch.isfinite(parameter).all() for parameter in parameters)
        if not all(are_finite):
            record_count = len(records)
            state_count = self.model.states
            return like.new_full((record_count, state_count), torch.nan)
        stored = self.model.to_numpy(self.data)
        states = [
            estimate_initial_state(stored, record, self.data.start_up_samples) for record in records
        ]
        state_table = np.stack(states)
        state_tensor = torch.from_numpy(state_table)
        return state_tensor.to(like)

    def configure_optimizers(self) -> Any:
        """Build the optimiser that the training settings choose."""
        return self.settings.optimiser.build_optimiser(self)

    def trained_model_with_remark(self) -> tuple[Simulator, str]:
        """Trained model with NumPy arrays as parameters, after a few L-BFGS iterations in float64,
        with a remark on the conversion. Rounding to float32 is removed by a few L-BFGS iterations
        in float64, if they end finite and lower."""
        training_outputs = self.training_records.y
        single = training_outputs.dtype == torch.float32
        self.to("cpu", torch.float64)
        if single and not isinstance(
            self.settings.optimiser, Levenberg
        ):  # which leaves the penalties out
            state_of_module = self.state_dict()
            before = {name: value.clone() for name, value in state_of_module.items()}
            parameters = trainable_parameters(self)
            optimiser = torch.optim.LBFGS(
                parameters, max_iter=POLISH_STEPS, line_search_fn="strong_wolfe"
            )
            first = float(self._backpropagate_loss())
            optimiser.step(self._backpropagate_loss)
            if not float(self._backpropagate_loss()) <= first:  # also where it is NaN
                self.load_state_dict(before)
        frozen_model = self.model.to_numpy(self.data)
        return frozen_model, ""


@torch.no_grad()
def window_initial_states(
    model: TorchModel, records: TrainingBatch, windows: RecordWindows
) -> States:
    """Initial state of each training window, from a simulation of the whole records. Shooting then
    begins without defects.

    Records start at rest too: an estimate by the untrained model is far off in slow modes, and
    traps the optimiser.
    """
    states = records.u.new_zeros(len(windows.pieces), model.states)
    for later in windows.continuing_window_indices:
        window = records.u[later - 1 : later]
        start = states[later - 1 : later]
        advanced = model.simulate_with_final_state(window, start)
        states[later] = advanced[1][0]
    return states
