"""What training minimises: the relative squared simulation error over the scored samples of all records."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.torch_lift import Lift
from ssm_study.models.torch_ssm import TorchModel, TorchSSM
from ssm_study.signals import DataSet, Trajectory


class Records(nn.Module):
    """Scaled records of equal length: shorter ones are padded at the end and weigh nothing there.

    `u (e, T, m)`, `y (e, T, p)`, `weight (e, T, 1)`: zero in the first `unscored` samples (the start-up samples unless
    given) and in the padding, and scaled so that `sum(weight |y - mean|^2) = 1`. Then the loss is `(1 - fit / 100)^2`
    for one channel.
    """

    u: Tensor
    y: Tensor
    weight: Tensor
    scored: Tensor
    sum_spread: Tensor

    def __init__(
        self,
        records: Sequence[Trajectory],
        data: DataSet,
        sorts: bool = True,
        integrated_share: float = 0.0,
        unscored: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.integrated_share = integrated_share
        longest = max(len(record) for record in records)
        u = [_padded((r.u - data.input_equilibrium) / data.input_scale, longest) for r in records]
        y = [_padded((r.y - data.output_equilibrium) / data.output_scale, longest) for r in records]
        scored = np.zeros((len(records), longest, 1))
        for e, record in enumerate(records):
            scored[e, (unscored[e] if unscored else data.start_up_samples) : len(record)] = 1.0
        spread = _spread(np.stack(y), scored)
        for name, values in (("u", np.stack(u)), ("y", np.stack(y)), ("weight", scored / spread)):
            self.register_buffer(name, torch.from_numpy(values), persistent=False)
        self.register_buffer("scored", torch.from_numpy(scored), persistent=False)
        summed = (self.scored * self.y).cumsum(1) * self.scored  # of y as of its error, see `objective`
        sum_spread = summed.square().sum() if integrated_share else torch.ones((), dtype=torch.float64)
        self.register_buffer("sum_spread", sum_spread, persistent=False)
        self.lift = Lift(self.u, sorts)

    def simulate(self, model: nn.Module, x0: Float[Tensor, "e n"] | None = None) -> Float[Tensor, "*models e T p"]:
        """Free run of the model over all records."""
        if isinstance(model, TorchSSM):
            return model.respond(self.lift(model.scaffold_in), x0)
        return model(self.u) if x0 is None else model(self.u, x0)

    def advance(
        self, model: TorchModel, x0: Float[Tensor, "e n"]
    ) -> tuple[Float[Tensor, "e T p"], Float[Tensor, "e n"]]:
        """As `simulate`, and the states after the last sample, padding included."""
        if isinstance(model, TorchSSM):
            return model.advance_lifted(self.lift(model.scaffold_in), x0)
        return model.advance(self.u, x0)

    def loss(self, y_hat: Float[Tensor, "*models e T p"]) -> Float[Tensor, "*models"]:
        """`sum weight |e|^2`: what the fit is made of."""
        return (self.weight * (y_hat - self.y) ** 2).sum((-3, -2, -1))

    def objective(self, y_hat: Float[Tensor, "*models e T p"]) -> Float[Tensor, "*models"]:
        """`(1 - share) sum weight |e|^2 + share |running sum of e|^2 / |running sum of y|^2`.

        The running sum is what an integrator behind the output sees: position, where y is a velocity.
        """
        if self.integrated_share == 0.0:
            return self.loss(y_hat)
        summed = (self.scored * (y_hat - self.y)).cumsum(-2) * self.scored
        drift = summed.square().sum((-3, -2, -1)) / self.sum_spread
        return (1 - self.integrated_share) * self.loss(y_hat) + self.integrated_share * drift


def fit_of_loss(loss: float) -> float:
    """`100 (1 - sqrt(loss))`, percent."""
    return 100.0 * (1.0 - loss**0.5)


def _padded(values: Float[np.ndarray, "T c"], length: int) -> Float[np.ndarray, "L c"]:
    return np.pad(values, ((0, length - len(values)), (0, 0)))


def _spread(y: Float[np.ndarray, "e T p"], scored: Float[np.ndarray, "e T 1"]) -> float:
    """`sum |y - mean|^2` over the scored samples, the mean taken over all records."""
    mean = (scored * y).sum(axis=(0, 1)) / scored.sum()
    return float((scored * (y - mean) ** 2).sum())
