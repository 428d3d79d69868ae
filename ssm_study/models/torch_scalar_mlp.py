"""The paper's perceptron for one channel: any piecewise-linear map whose slopes stay in the sector."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.network import Network
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.torch_mlp import layer_sector
from ssm_study.models.torch_pieces import Pieces, evaluate, home_offsets, roughness
from ssm_study.models.torch_rows import apart
from ssm_study.models.torch_scaffold import TorchScaffold, numbers

JUMP_UNIT = 0.3  # how far a unit of a free jump moves the logit of the slopes beyond it; small keeps training smooth


class Kinks(nn.Module):
    """One hidden layer: `S(v) = int_0^v s(t) dt`, `s = lower + (upper - lower) sigmoid(base + sum of jumps passed)`.

    `width - 1` leaky ReLUs with slopes `lower, upper` and one linear neuron can write every such map, and no
    positivity of weights is needed: positive weights alone would force the two outer slopes to add up to
    `lower + upper`, which no saturation satisfies.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, samples: Float[np.ndarray, "N"], width: int, sector: tuple[float, float]) -> None:
        super().__init__()
        kinks = max(width - 1, 1)
        self.points = nn.Parameter(torch.from_numpy(np.quantile(samples, (np.arange(kinks) + 0.5) / kinks)))
        self.jumps = nn.Parameter(torch.zeros(kinks, dtype=torch.float64))
        self.base = nn.Parameter(torch.zeros(1, dtype=torch.float64))
        for name, end in zip(("lower", "upper"), sector, strict=True):
            self.register_buffer(name, torch.tensor([end], dtype=torch.float64), persistent=False)

    def pieces(self) -> Pieces:
        points, order = self.points.sort(-1)
        logits = self.base + JUMP_UNIT * nn.functional.pad(self.jumps.gather(-1, order).cumsum(-1), (1, 0))
        slopes = self.lower + (self.upper - self.lower) * torch.sigmoid(apart(logits))
        return points, slopes, home_offsets(points, slopes)

    @property
    def sector(self) -> tuple[float, float]:
        return float(self.lower), float(self.upper)

    def neurons(self) -> tuple[Float[np.ndarray, "h"], Float[np.ndarray, "h"], Float[np.ndarray, "h"]]:
        """`(last weights, biases, negative slopes)`; first weights are one, positive slopes are `upper`."""
        points, slopes, _ = (numbers(part) for part in self.pieces())
        lower, upper = self.sector
        bends = np.diff(slopes) / (upper - lower)
        straight = (slopes[0] - lower * bends.sum()) / upper
        negative = np.append(np.full(len(bends), lower), upper)
        return np.append(bends, straight), np.append(-points, 0.0), negative


class TorchScalarMlp(TorchScaffold):
    """`S = S_L o ... o S_1`, each a hidden layer of leaky ReLUs; the layers' sectors multiply to the one asked for."""

    def __init__(self, inputs: Float[np.ndarray, "N 1"], width: int, depth: int, slopes: tuple[float, float]) -> None:
        super().__init__()
        sector = layer_sector(slopes[0], slopes[1], depth, channels=1)
        self.layers = nn.ModuleList([Kinks(inputs[:, 0], width, sector) for _ in range(depth)])

    def _kinks(self) -> list[Kinks]:
        return [layer for layer in self.layers if isinstance(layer, Kinks)]

    def forward(self, v: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 1"]:
        for layer in self._kinks():
            v = evaluate(layer.pieces(), v)
        return v

    def pieces(self) -> Pieces | None:
        layers = self._kinks()
        return layers[0].pieces() if len(layers) == 1 else None

    def roughness(self) -> Float[Tensor, "*models"]:
        return torch.stack([roughness(layer.pieces()[1]) for layer in self._kinks()]).sum(0)

    def freeze(self) -> MlpScaffold:
        neurons = [layer.neurons() for layer in self._kinks()]
        last = [part[0][None, :] for part in neurons]
        ones = [np.ones((len(part[1]), 1)) for part in neurons]
        inner = [after @ before for (before, _), (_, after) in pairwise(zip(last, ones, strict=True))]
        uppers = [layer.sector[1] for layer in self._kinks()]
        return MlpScaffold(
            network=Network(
                weights=(ones[0], *inner, last[-1]),
                biases=tuple(part[1] for part in neurons),
                negative_slopes=tuple(part[2] for part in neurons),
                positive_slopes=tuple(np.full(len(p[1]), up) for p, up in zip(neurons, uppers, strict=True)),
            )
        )
