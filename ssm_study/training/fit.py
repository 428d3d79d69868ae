"""The Lightning module: one loss over all windows per step, one free run over whole records per epoch."""

import copy
import math
from typing import Any

import lightning.pytorch as pl
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.func import functional_call

from ssm_study.models.torch_recurrence import forward_derivatives
from ssm_study.models.torch_ssm import TorchModel, TorchSSM
from ssm_study.training.levenberg import LevenbergMarquardt
from ssm_study.training.objective import Records, fit_of_loss
from ssm_study.training.optimisers import Adam, OptimiserSpec
from ssm_study.training.penalties import Penalties
from ssm_study.training.start_up import StartUp
from ssm_study.training.windows import Continuity, Starts


class Fit(pl.LightningModule):
    """Minimises the training loss of `model`, and with it the states of `starts` where they are parameters.

    `training` holds the windows, `whole` the records they were cut from (None where windows are whole records): the
    training fit that is shown is always that of whole records. `start_up` estimates what validation records start from;
    None for rest.
    """

    def __init__(
        self,
        model: TorchModel,
        training: Records,
        validation: Records,
        optimiser: OptimiserSpec,
        max_epochs: int,
        starts: Starts | None,
        penalties: Penalties,
        continuity: Continuity | None,
        whole: Records | None,
        start_up: StartUp | None,
    ) -> None:
        super().__init__()
        self.model, self.training_records, self.validation_records = model, training, validation
        self.optimiser, self.max_epochs = optimiser, max_epochs
        self.starts, self.penalties, self.continuity = starts, penalties, continuity
        self.whole, self.start_up = whole, start_up
        self.last_loss = math.inf
        self.automatic_optimization = False

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are the batch
        """An epoch: what Lightning does around each call costs more than a step of a small model."""
        optimiser: Any = self.optimizers()
        for _ in range(self.optimiser.calls_per_epoch):
            optimiser.step(self._evaluate)
        rates: Any = self.lr_schedulers()
        if rates is not None:
            rates.step()

    def _evaluate(self) -> Tensor:
        self.zero_grad()
        loss = self.loss()
        loss.backward()
        return loss

    def loss(self) -> Tensor:
        """What gradients are taken of; the squared error in it is noted as `last_loss`."""
        y_hat, defects = self.run()
        with torch.no_grad():
            self.last_loss = float(self.training_records.loss(y_hat))
        return self.training_records.objective(y_hat) + defects.square().sum() + self._penalty()

    def run(self) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "k n"]]:
        """The simulated windows, and the defects between them (none without multiple shooting)."""
        x0 = None if self.starts is None else self.starts()
        if self.continuity is None or x0 is None:
            return self.training_records.simulate(self.model, x0), self.training_records.y.new_zeros(0, 0)
        y_hat, ends = self.training_records.advance(self.model, x0)
        return y_hat, self.continuity(ends, x0)

    def residual(self, flat: Float[Tensor, "P"]) -> Float[Tensor, "N"]:
        """`sqrt(weight) (y_hat - y)`, then the defects, as a function of all trainable parameters in a row."""
        named = [(name, p) for name, p in self.named_parameters() if p.requires_grad]
        parts = flat.split([p.numel() for _, p in named])
        values = {name: part.view(p.shape) for (name, p), part in zip(named, parts, strict=True)}
        with forward_derivatives():
            return functional_call(_Residual(self), {f"fit.{name}": value for name, value in values.items()}, ())

    def _penalty(self) -> Tensor:
        """What is added to the squared error: see `Penalties`."""
        if not isinstance(self.model, TorchSSM):
            return torch.zeros(())
        return self.penalties.of(self.model)

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        x0 = None if self.start_up is None else self.start_up(self.model)
        loss = float(self.validation_records.loss(self.validation_records.simulate(self.model, x0)))
        if self.whole is not None:
            x0 = None if self.starts is None else self.starts.of_records()
            self.last_loss = float(self.whole.loss(self.whole.simulate(self.model, x0)))
        self.log("fit_validation_percent", fit_of_loss(loss) if math.isfinite(loss) else -math.inf)
        self.log("fit_training_percent", fit_of_loss(self.last_loss) if math.isfinite(self.last_loss) else -math.inf)

    def configure_optimizers(self) -> Any:
        optimiser = self.optimiser.build(self)
        if isinstance(optimiser, LevenbergMarquardt):
            optimiser.residual, optimiser.seen = self.residual, self._note
        if isinstance(self.optimiser, Adam):
            return {"optimizer": optimiser, "lr_scheduler": self.optimiser.schedule(optimiser, self.max_epochs)}
        return optimiser

    def _note(self, loss: float) -> None:
        self.last_loss = loss


class _Residual(nn.Module):
    """The residuals as a module, so that `functional_call` can put other parameters in."""

    def __init__(self, fit: Fit) -> None:
        super().__init__()
        self.fit = fit

    def forward(self) -> Float[Tensor, "N"]:
        records = self.fit.training_records
        y_hat, defects = self.fit.run()
        return torch.cat([(torch.sqrt(records.weight) * (y_hat - records.y)).flatten(), defects.flatten()])


STILL_EPOCHS = 2


class Keeper(Callback):
    """Keeps the state to return, and stops in good order when numbers leave the finite or no longer change.

    Validation fits of noisy records differ by chance: among states whose validation fit is within `tolerance` percent
    points of the best seen, the one with the best training fit is kept. A line search that fails at a kink of the
    objective fails again and again: epochs that leave both fits as they were, to the last bit, end the training.
    """

    _REMEMBERED = ("best_validation", "kept_training", "kept_validation", "kept", "ended", "seen", "still")

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.best_validation, self.kept_training = -math.inf, -math.inf
        self.kept_validation = -math.inf
        self.kept: dict[str, Tensor] | None = None
        self.ended = ""
        self.seen, self.still = (-math.inf, -math.inf), 0

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        self.begin(pl_module)

    def begin(self, module: nn.Module) -> None:
        """Until an epoch has ended, the starting point is the state to return."""
        if self.kept is None:
            self.kept = _copy(module)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.sanity_checking:
            return
        training = float(trainer.callback_metrics["fit_training_percent"])
        validation = float(trainer.callback_metrics["fit_validation_percent"])
        self.see(trainer.current_epoch, training, validation, pl_module)
        trainer.should_stop = trainer.should_stop or bool(self.ended)

    def see(self, epoch: int, training: float, validation: float, module: nn.Module) -> None:
        """One epoch's fits, percent, and the state that has them; `ended` says why to stop, if so."""
        if not (math.isfinite(training) and math.isfinite(validation)):
            self.ended = (
                f"the loss was not finite in epoch {epoch}; the last good state is kept; "
                "lower the learning rate, or start from modes further inside the unit circle"
            )
            return
        self.still = self.still + 1 if (training, validation) == self.seen else 0
        self.seen = (training, validation)
        if self.still == STILL_EPOCHS:
            self.ended = "the optimiser no longer moves"
        self.best_validation = max(self.best_validation, validation)
        eligible = validation >= self.best_validation - self.tolerance
        worn_out = self.kept_validation < self.best_validation - self.tolerance
        if worn_out or (eligible and training > self.kept_training):
            self.kept, self.kept_training, self.kept_validation = _copy(module), training, validation

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self._REMEMBERED}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        for name in self._REMEMBERED:
            setattr(self, name, state_dict[name])


def _copy(module: nn.Module) -> dict[str, Tensor]:
    return copy.deepcopy(module.state_dict())
