"""Optimisers that a training can use. Each yaml of the group `training/optimiser` is one of
these."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ssm_study.models.lazy_torch import torch
from ssm_study.refusal import require, require_at_least, require_positive

if TYPE_CHECKING:
    from torch import nn

    from ssm_study.training.fit import TorchFit


@dataclass(frozen=True, kw_only=True)
class OptimiserSpec(ABC):
    """Base class of settings of the optimiser of a training. `build_optimiser` returns what
    Lightning takes: a torch optimiser over the trainable parameters, perhaps with a schedule.

    An epoch is `calls_per_epoch` calls of it.
    """

    steps_per_epoch: int

    def __post_init__(self) -> None:
        require_at_least(1, "optimiser.steps_per_epoch", self.steps_per_epoch, "use 10 or so")

    @property
    def calls_per_epoch(self) -> int:
        """Number of times that the optimiser is called in one training epoch."""
        return self.steps_per_epoch

    @abstractmethod
    def build_optimiser(self, fit: "TorchFit") -> Any:
        """Build the optimiser of a training from its settings."""


@dataclass(frozen=True, kw_only=True)
class Lbfgs(OptimiserSpec):
    """Settings of the optimiser L-BFGS (limited-memory BFGS with a strong Wolfe line search)."""

    history: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(1, "optimiser.history", self.history, "use 20 or so")

    @property
    def calls_per_epoch(self) -> int:
        return 1  # it iterates by itself

    def build_optimiser(self, fit: "TorchFit") -> "torch.optim.Optimizer":
        """Build the L-BFGS optimiser of a training."""
        sizes: dict[str, Any] = {"max_iter": self.steps_per_epoch, "history_size": self.history}
        search: dict[str, Any] = {
            "line_search_fn": "strong_wolfe",
            "tolerance_grad": 0.0,
            "tolerance_change": 0.0,
        }
        parameters = trainable_parameters(fit)
        return torch.optim.LBFGS(parameters, **sizes, **search)


@dataclass(frozen=True, kw_only=True)
class Levenberg(OptimiserSpec):
    """Settings of the Levenberg-Marquardt optimiser, which minimises the simulation error and
    ignores penalties."""

    damping: float
    longest_step: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("optimiser.damping", self.damping, "use 0.01")
        require_positive("optimiser.longest_step", self.longest_step, "use 0.5")

    def build_optimiser(self, fit: "TorchFit") -> "torch.optim.Optimizer":
        """Build the Levenberg-Marquardt optimiser of a training."""
        from ssm_study.training.levenberg import LevenbergMarquardt

        named = [(name, p) for name, p in fit.named_parameters() if p.requires_grad]
        return LevenbergMarquardt(named, fit.residuals_at, self.damping, self.longest_step)


@dataclass(frozen=True, kw_only=True)
class Adam(OptimiserSpec):
    """Settings of the optimiser Adam with a learning rate that decreases to a fraction. Its rate
    falls along half a cosine to `final_fraction` of the initial one."""

    learning_rate: float
    final_fraction: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("optimiser.learning_rate", self.learning_rate, "use 0.01 or so")
        final = self.final_fraction
        is_fraction = 0 < final <= 1
        require(
            is_fraction, "optimiser.final_fraction", final, "must lie in (0, 1]", "use 0.01 or so"
        )

    def build_optimiser(self, fit: "TorchFit") -> dict[str, Any]:
        """Build the Adam optimiser of a training, with a decaying learning rate."""
        parameters = trainable_parameters(fit)
        optimiser = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True)

        def learning_rate_factor(epoch: int) -> float:
            """Factor of the learning rate in a given epoch, along half a cosine."""
            along = epoch / fit.settings.max_epochs
            cosine = math.cos(math.pi * along)
            variable_part = (1 - self.final_fraction) * (1 + cosine)
            return self.final_fraction + variable_part / 2

        schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, learning_rate_factor)
        return {"optimizer": optimiser, "lr_scheduler": schedule}


def trainable_parameters(model: "nn.Module") -> "list[nn.Parameter]":
    """Parameters of a model that an optimiser may change."""
    return [parameter for parameter in model.parameters() if parameter.requires_grad]
