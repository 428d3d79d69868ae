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
    """Batch of scaled training records of equal length, cut into windows. Shorter ones are padded
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
        u, y = pad_records(
            [
                (scale.scaled_input(r.inputs_and_disturbances), scale.scaled_output(r.y))
                for r in cut.pieces
            ]
        )
        scored = np.zeros((*u.shape[:2], 1))
        for e, (piece, unscored) in enumerate(zip(cut.pieces, cut.unscored, strict=True)):
            scored[e, unscored : len(piece)] = 1.0
        mean = (scored * y).sum(axis=(0, 1)) / scored.sum()  # one offset for all records
        spread = float((scored * (y - mean) ** 2).sum())
        for name, values in {"u": u, "y": y, "weight": scored / spread, "scored": scored}.items():
            self.register_buffer(name, torch.from_numpy(values), persistent=False)
        summed = (self.scored * self.y).cumsum(
            1
        ) * self.scored  # of y as of its error, see `training_objective`
        self.register_buffer("sum_spread", summed.square().sum(), persistent=False)
        self.lift = InputMapping(self.u[..., : data.scale.inputs], sorts)

    def simulate(self, model: TorchModel, x0: States | None = None) -> Signals:
        """Simulate the model in free run over all records."""
        return model(self.u, x0, **self._mapped_inputs(model))

    def advance(self, model: TorchModel, x0: States) -> tuple[Signals, States]:
        """Simulate the model over all records, and return the outputs and the final states. Padding
        is simulated, too."""
        return model.advance(self.u, x0, **self._mapped_inputs(model))

    def _mapped_inputs(self, model: TorchModel) -> dict[str, Signals]:
        """Inputs after the input map, where they are computed once for all windows."""
        if not isinstance(model, TorchSSM):
            return {}
        return {"lifted": model.driving_signals(self.u, self.lift(model.scaffold_in))}

    def squared_error(self, y_hat: Signals) -> Float[Tensor, ""]:
        """Weighted squared error of simulated outputs, `sum weight |e|^2`, from which the fit is
        computed."""
        return (self.weight * (y_hat - self.y) ** 2).sum()

    def training_objective(self, y_hat: Signals) -> Float[Tensor, ""]:
        """Training objective of simulated outputs. `(1 - share) sum weight |e|^2 + share |running
        sum of e|^2 / |running sum of y|^2`.

        The running sum is what an integrator behind the output sees: position, where y is a
        velocity.
        """
        if self.integrated_share == 0.0:
            return self.squared_error(y_hat)
        summed = (self.scored * (y_hat - self.y)).cumsum(1) * self.scored
        drift = summed.square().sum() / self.sum_spread  # relative to the sum of y itself
        return (1 - self.integrated_share) * self.squared_error(
            y_hat
        ) + self.integrated_share * drift


class InitialStates(nn.Module):
    """Trainable initial states of the training windows. `(e, n)`: rest, except for the rows that
    are parameters."""

    rows: Tensor
    later: Tensor

    def __init__(
        self, cut: RecordWindows, rows: Sequence[int], values: States, weight: float
    ) -> None:
        super().__init__()
        self.cut = cut
        self.weight = weight
        for name, places in (("rows", rows), ("later", cut.continuing_windows)):
            self.register_buffer(name, torch.tensor(places, dtype=torch.int64), persistent=False)
        self.free = nn.Parameter(values[self.rows].clone())

    def forward(self) -> States:
        """Initial states of all windows."""
        return self.free.new_zeros(len(self.cut.pieces), self.free.shape[1]).index_copy(
            0, self.rows, self.free
        )

    def shooting_defects(self, ends: States, starts: States) -> Float[Tensor, "k n"]:
        """Differences between the final state of a window and the initial state of the next,
        weighted for the penalty."""
        reached = ends[self.later - 1]  # where the window before ends
        size = (reached.square().sum(0) + UNMOVED) * reached.shape[1] / self.weight
        return (reached - starts[self.later]) / torch.sqrt(size)


def roughness_penalty(model: TorchModel, weight: float) -> Float[Tensor, ""]:
    """Training penalty on the variation of the static maps' slopes. `weight (TV(S_u') + TV(S_y'))`;
    zero for a baseline.

    It is free of scale, so a weight of 0.001 means a thousandth of the output's variance.
    """
    if weight > 0 and isinstance(model, TorchSSM):
        roughness = model.scaffold_in.roughness() + model.scaffold_out.roughness()
        return weight * roughness
    return torch.zeros(())


class Fit(pl.LightningModule):
    """Lightning module that trains a torch model. It minimises the training loss over the model
    and, where they are free, the initial states of windows.

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
            if cut.continuing_windows
            else self.training_records
        )
        self.starts = self._trainable_starts(cut)

    def _trainable_starts(self, cut: RecordWindows) -> InitialStates | None:
        """Initial states of the windows as trainable parameters; None if none is free."""
        model = self.model
        weight = self.settings.windows.continuity_weight
        how = self.settings.initial_state
        moving = how == "estimated" or (how == "auto" and self.data.start_up_samples > 0)
        moving = moving and isinstance(
            model, TorchSSM
        )  # whose stored model estimates it, too (`free_run`)
        problem = "this model has no state to start a window from"
        remedy = "use training.windows.samples=null"
        able = model.states > 0 or not cut.continuing_windows
        require(able, "training.windows.samples", self.settings.windows.samples, problem, remedy)
        rows = [*(cut.first if moving else ()), *cut.continuing_windows]
        values = simulate_window_starts(model, self.training_records, cut) if rows else None
        return None if values is None else InitialStates(cut, sorted(rows), values, weight)

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are the batch
        """Train for one epoch. Lightning's work around each call costs more than a step of a small
        model."""
        optimiser: Any = self.optimizers()
        for _ in range(self.settings.optimiser.calls_per_epoch):
            optimiser.step(self._loss_and_gradient)
        rates: Any = self.lr_schedulers()
        if rates is not None:
            rates.step()

    def _loss_and_gradient(self) -> Tensor:
        """Compute the training loss and its gradient."""
        self.zero_grad()
        loss = self.training_loss()
        loss.backward()
        return loss.detach()

    def training_loss(self) -> Tensor:
        """Training loss of the current model: simulation error, shooting defects and roughness."""
        y_hat, defects = self.simulate_windows()
        added = roughness_penalty(self.model, self.settings.roughness_weight)
        return self.training_records.training_objective(y_hat) + defects.square().sum() + added

    def simulate_windows(self) -> tuple[Signals, Float[Tensor, "k n"]]:
        """Simulated outputs of all windows, and the differences of state between successive
        windows."""
        x0 = None if self.starts is None else self.starts()
        if self.starts is None or x0 is None or not self.starts.cut.continuing_windows:
            return self.training_records.simulate(
                self.model, x0
            ), self.training_records.y.new_zeros(0, 0)
        y_hat, ends = self.training_records.advance(self.model, x0)
        return y_hat, self.starts.shooting_defects(ends, x0)

    def forward(self) -> Float[Tensor, "N"]:
        """Residuals of the simulation, whose squared sum is minimised. `sqrt(weight) (y_hat - y)`,
        then the defects."""
        records, (y_hat, defects) = self.training_records, self.simulate_windows()
        return torch.cat(
            [(torch.sqrt(records.weight) * (y_hat - records.y)).flatten(), defects.flatten()]
        )

    def residuals_at(self, flat: Float[Tensor, "P"]) -> Float[Tensor, "N"]:
        """Residuals of the simulation as a function of all trainable parameters."""
        named = [(name, p) for name, p in self.named_parameters() if p.requires_grad]
        parts = flat.split([p.numel() for _, p in named])
        values = {name: part.view(p.shape) for (name, p), part in zip(named, parts, strict=True)}
        with allow_forward_derivatives():
            return functional_call(self, values, ())

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        """Compute the training and validation fits of the current model. They are minus infinity
        for a loss that is not finite.

        What an optimiser evaluated last may be a trial that it refused, or the model before its
        last step.
        """
        fitted = None if self.starts is None else self.starts()[list(self.starts.cut.first)]
        moving = self.data.start_up_samples > 0 and isinstance(self.model, TorchSSM)
        estimated = self._validation_starts() if moving else None
        for name, records, x0 in (
            ("training", self.whole, fitted),
            ("validation", self.validation_records, estimated),
        ):
            loss = float(records.squared_error(records.simulate(self.model, x0)))
            self.log(
                f"fit_{name}_percent",
                fit_from_relative_error(loss**0.5) if np.isfinite(loss) else -np.inf,
            )

    def _validation_starts(self) -> States:
        """Initial states of the validation records, estimated from their first samples.

        A record that starts in motion says nothing about a model that simulates it from rest:
        validation would then stop a training, or choose among several, by the error of the initial
        state.
        """
        like = next(self.model.parameters())
        records = self.data.validation
        if not all(torch.isfinite(parameter).all() for parameter in self.model.parameters()):
            return like.new_full((len(records), self.model.states), torch.nan)
        stored = self.model.freeze(self.data)
        states = [
            estimate_initial_state(stored, record, self.data.start_up_samples) for record in records
        ]
        return torch.from_numpy(np.stack(states)).to(like)

    def configure_optimizers(self) -> Any:
        """Build the optimiser of the training."""
        return self.settings.optimiser.build(self)

    def trained_model_with_remark(self) -> tuple[Simulator, str]:
        """Trained model as explicit numbers, and a remark on it. Rounding to float32 is removed by
        a few L-BFGS iterations in float64, if they end finite and lower."""
        single = self.training_records.y.dtype == torch.float32
        self.to("cpu", torch.float64)
        if single and not isinstance(
            self.settings.optimiser, Levenberg
        ):  # which leaves the penalties out
            before = {name: value.clone() for name, value in self.state_dict().items()}
            optimiser = torch.optim.LBFGS(
                trainable_parameters(self), max_iter=POLISH_STEPS, line_search_fn="strong_wolfe"
            )
            first = float(self._loss_and_gradient())
            optimiser.step(self._loss_and_gradient)
            if not float(self._loss_and_gradient()) <= first:  # also where it is NaN
                self.load_state_dict(before)
        return self.model.freeze(self.data), ""


@torch.no_grad()
def simulate_window_starts(model: TorchModel, records: TrainingBatch, cut: RecordWindows) -> States:
    """Initial state of each window, from a simulation of the whole records. Shooting then begins
    without defects.

    Records start at rest too: an estimate by the untrained model is far off in slow modes, and
    traps the optimiser.
    """
    states = records.u.new_zeros(len(cut.pieces), model.states)
    for later in cut.continuing_windows:
        states[later] = model.advance(records.u[later - 1 : later], states[later - 1 : later])[1][0]
    return states
