"""Float64 iterations after float32 training, so that the stored model reproduces its fit."""

import torch

from ssm_study.training.fit import Fit
from ssm_study.training.optimisers import trainable

POLISH_STEPS = 20  # they undo the rounding, not the optimum


def polish(fit: Fit) -> None:
    """A few L-BFGS iterations in float64, kept only if they end finite and lower."""
    before = {name: value.clone() for name, value in fit.state_dict().items()}
    optimiser = torch.optim.LBFGS(trainable(fit), max_iter=POLISH_STEPS, line_search_fn="strong_wolfe")

    def closure() -> float:
        optimiser.zero_grad()
        loss = fit.loss()
        loss.backward()
        return float(loss.detach())

    first = closure()
    optimiser.step(closure)
    if not closure() <= first:
        fit.load_state_dict(before)
