"""The Lightning module: one full-record loss per step, one validation per epoch."""

import copy
import math
from typing import Any

import lightning.pytorch as pl
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.func import functional_call

from ssm_study.models.torch_ssm import TorchSSM
from ssm_study.training.objective import Records, fit_of_loss
from ssm_study.training.optimisers import Adam, Levenberg, OptimiserSpec
from ssm_study.training.penalties import Penalties


class Fit(pl.LightningModule):
    """Minimises the training loss of `model`; optionally estimates one initial state per training record as well."""

    def __init__(
        self,
        model: nn.Module,
        training: Records,
        validation: Records,
        optimiser: OptimiserSpec,
        max_epochs: int,
        estimated_states: int = 0,
        penalties: Penalties | None = None,
    ) -> None:
        super().__init__()
        self.model, self.training_records, self.validation_records = model, training, validation
        self.optimiser, self.max_epochs = optimiser, max_epochs
        self.penalties = penalties or Penalties(roughness_weight=0.0, hankel_weight=0.0)
        states = torch.zeros(len(training.u), estimated_states, dtype=torch.float64)
        self.x0 = nn.Parameter(states) if estimated_states else None
        self.last_loss = math.inf
        self.automatic_optimization = not isinstance(optimiser, Levenberg)

    def training_step(self, batch: Any, batch_idx: int) -> Tensor | None:  # noqa: ARG002 - the records are the batch
        if not self.automatic_optimization:
            self._squares_step()
            return None
        y_hat = self.training_records.simulate(self.model, self.x0)
        with torch.no_grad():
            self.last_loss = float(self.training_records.loss(y_hat))
        return self.training_records.objective(y_hat) + self._penalty()

    def _squares_step(self) -> None:
        """One step of an optimiser that works on the residuals themselves."""
        wrapped: Any = self.optimizers()
        wrapped.optimizer.residual = self.residual
        self.last_loss = wrapped.step()

    def residual(self, flat: Float[Tensor, "P"]) -> Float[Tensor, "N"]:
        """`sqrt(weight) (y_hat - y)` as a function of all trainable parameters, one after the other."""
        named = [(name, p) for name, p in self.named_parameters() if p.requires_grad]
        parts = flat.split([p.numel() for _, p in named])
        values = {name: part.view(p.shape) for (name, p), part in zip(named, parts, strict=True)}
        return functional_call(_Residual(self), {f"fit.{name}": value for name, value in values.items()}, ())

    def _penalty(self) -> Tensor:
        """What is added to the squared error: see `Penalties`."""
        if not isinstance(self.model, TorchSSM):
            return torch.zeros(())
        return self.penalties.of(self.model)

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        loss = float(self.validation_records.loss(self.validation_records.simulate(self.model)))
        self.log("fit_validation_percent", fit_of_loss(loss) if math.isfinite(loss) else -math.inf)
        self.log("fit_training_percent", fit_of_loss(self.last_loss) if math.isfinite(self.last_loss) else -math.inf)

    def configure_optimizers(self) -> Any:
        optimiser = self.optimiser.build(self, self.max_epochs)
        if isinstance(self.optimiser, Adam):
            return {"optimizer": optimiser, "lr_scheduler": self.optimiser.schedule(optimiser, self.max_epochs)}
        return optimiser


class _Residual(nn.Module):
    """The residuals as a module, so that `functional_call` can put other parameters in."""

    def __init__(self, fit: Fit) -> None:
        super().__init__()
        self.fit = fit

    def forward(self) -> Float[Tensor, "N"]:
        records = self.fit.training_records
        error = records.simulate(self.fit.model, self.fit.x0) - records.y
        return (torch.sqrt(records.weight) * error).flatten()


class Keeper(Callback):
    """Keeps the state to return, and stops in good order when numbers leave the finite.

    Validation fits of noisy records differ by chance: among states whose validation fit is within `tolerance` percent
    points of the best seen, the one with the best training fit is kept.
    """

    _REMEMBERED = ("best_validation", "kept_training", "kept_validation", "kept", "ended")

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.best_validation, self.kept_training = -math.inf, -math.inf
        self.kept_validation = -math.inf
        self.kept: dict[str, Tensor] | None = None
        self.ended = ""

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:  # noqa: ARG002
        if self.kept is None:
            self.kept = _copy(pl_module)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.sanity_checking:
            return
        training = float(trainer.callback_metrics["fit_training_percent"])
        validation = float(trainer.callback_metrics["fit_validation_percent"])
        if not (math.isfinite(training) and math.isfinite(validation)):
            self.ended = (
                f"the loss was not finite in epoch {trainer.current_epoch}; the last good state is kept; "
                "lower the learning rate, or start from modes further inside the unit circle"
            )
            trainer.should_stop = True
            return
        self.best_validation = max(self.best_validation, validation)
        eligible = validation >= self.best_validation - self.tolerance
        worn_out = self.kept_validation < self.best_validation - self.tolerance
        if worn_out or (eligible and training > self.kept_training):
            self.kept, self.kept_training, self.kept_validation = _copy(pl_module), training, validation

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self._REMEMBERED}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        for name in self._REMEMBERED:
            setattr(self, name, state_dict[name])


def _copy(module: nn.Module) -> dict[str, Tensor]:
    return copy.deepcopy(module.state_dict())
