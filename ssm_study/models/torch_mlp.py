"""The paper's perceptron for several channels, certified by construction; and with free weights, for comparison."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.network import Network
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.torch_pieces import Pieces
from ssm_study.models.torch_scaffold import Sector, TorchScaffold, leaky, numbers


class TorchMlp(TorchScaffold):
    """`S = S_L o ... o S_1,  S_l(v) = W^T (phi(W v + b) - phi(b)),  W^T W = I,  phi' in [lower_l, upper_l]`.

    Each Jacobian `W^T diag(phi') W` is symmetric with eigenvalues in `[lower_l, upper_l]`, so for one hidden layer
    all Jacobians lie in the ball of the sector `[lower, upper]`. Deeper: `layer_sector` splits the sector so that the
    composition stays inside. Written out it is a plain perceptron with L hidden layers.
    """

    def __init__(
        self,
        inputs: Float[np.ndarray, "N m"],
        width: int,
        depth: int,
        slopes: tuple[float, float],
        train_slopes: bool,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        channels = inputs.shape[1]
        lower, upper = layer_sector(slopes[0], slopes[1], depth, channels)
        directions, kinks = zip(*(start_layer(inputs, width, rng) for _ in range(depth)), strict=True)
        self.directions = nn.ParameterList([nn.Parameter(torch.from_numpy(w)) for w in directions])
        self.kinks = nn.ParameterList([nn.Parameter(torch.from_numpy(t)) for t in kinks])
        self.sectors = nn.ModuleList([Sector((width,), lower, upper, train_slopes) for _ in range(depth)])

    def layers(self) -> list[tuple[Float[Tensor, "h m"], Float[Tensor, "h"], Float[Tensor, "h"], Float[Tensor, "h"]]]:
        """Explicit `(W, b, negative slopes, positive slopes)` of every layer; `b` puts the kink at `kinks`."""
        explicit = []
        for free, kink, sector in zip(self.directions, self.kinks, self.sectors, strict=True):
            w = orthonormal_columns(free)
            explicit.append((w, -kink * w.norm(dim=1), *sector()))
        return explicit

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        for w, b, low, high in self.layers():
            v = (leaky(v @ w.T + b, low, high) - leaky(b, low, high)) @ w
        return v

    def freeze(self) -> MlpScaffold:
        layers = [tuple(numbers(part) for part in layer) for layer in self.layers()]
        ws = [layer[0] for layer in layers]
        inner = [after @ before.T for before, after in pairwise(ws)]
        return MlpScaffold(
            network=Network(
                weights=(ws[0], *inner, ws[-1].T),
                biases=tuple(layer[1] for layer in layers),
                negative_slopes=tuple(layer[2] for layer in layers),
                positive_slopes=tuple(layer[3] for layer in layers),
            )
        )


def layer_sector(lower: float, upper: float, depth: int, channels: int) -> tuple[float, float]:
    """The slopes one layer may have so that `depth` of them in a row keep `[lower, upper]`.

    One channel: slopes multiply, so the depth-th roots. More: with `J_l = a (I + E_l), |E_l| <= d`, the product lies in
    the ball of centre `a^L` and radius `a^L ((1 + d)^L - 1)`, so `d = (upper/alpha)^(1/L) - 1`, `alpha` the middle.
    """
    if channels == 1 or depth == 1:
        return lower ** (1 / depth), upper ** (1 / depth)
    middle = (lower + upper) / 2
    centre, relative = middle ** (1 / depth), (upper / middle) ** (1 / depth) - 1
    return centre * (1 - relative), centre * (1 + relative)


def start_layer(
    inputs: Float[np.ndarray, "N m"], width: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h m"], Float[np.ndarray, "h"]]:
    """Random directions, kinks through evenly ranked samples of the training input, so that each can be learned.

    With one input, neighbouring kinks bend in opposite directions: any region can then be made steeper or flatter.
    """
    strata = (np.arange(width) + rng.uniform(0.2, 0.8, size=width)) / width
    if inputs.shape[1] == 1:
        signs = np.where((np.arange(width) + rng.integers(2)) % 2 == 0, 1.0, -1.0)
        return signs[:, None], signs * np.quantile(inputs[:, 0], strata)
    w = rng.normal(size=(width, inputs.shape[1]))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    kinks = np.array([np.quantile(inputs @ row, rank) for row, rank in zip(w, rng.permutation(strata), strict=True)])
    return w, kinks


def orthonormal_columns(free: Float[Tensor, "h m"]) -> Float[Tensor, "h m"]:
    """`V (V^T V)^(-1/2)` by Cholesky: the nearest thing to V with `W^T W = I` that is cheap to differentiate."""
    if free.shape[1] == 1:
        return free / free.norm()
    root = torch.linalg.cholesky(free.T @ free)
    return torch.linalg.solve_triangular(root, free.T, upper=False).T


def sorted_pieces(
    first: Float[Tensor, "h"],
    last: Float[Tensor, "h"],
    bias: Float[Tensor, "h"],
    low: Float[Tensor, "h"],
    high: Float[Tensor, "h"],
) -> Pieces:
    """`sum_i last_i phi_i(first_i v + bias_i)` minus its value at zero, as affine pieces between sorted kinks."""
    points, order = (-bias / first).sort()
    beyond = torch.arange(len(order) + 1)[:, None] > order.argsort()[None, :]  # piece j lies right of kink i
    active = torch.where(beyond == (first > 0), high, low)
    offsets = active @ (last * bias)
    home = torch.searchsorted(points.detach(), torch.zeros(1, dtype=points.dtype), right=True)
    return points, active @ (last * first), offsets - offsets[home]


class TorchFreeMlp(TorchScaffold):
    """`S(v) = N(v) - N(0)` with unconstrained weights, as [Z26] trains it: its slopes may well be negative."""

    def __init__(
        self,
        inputs: Float[np.ndarray, "N m"],
        width: int,
        depth: int,
        slopes: tuple[float, float],
        train_slopes: bool,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        channels = inputs.shape[1]
        first, kinks = start_layer(inputs, width, rng)
        shapes = [(width, width)] * (depth - 1) + [(channels, width)]
        later = [rng.normal(size=shape) / np.sqrt(shape[1]) for shape in shapes]
        biases = [-kinks, *(0.1 * rng.normal(size=width) for _ in range(depth - 1))]
        self.weights = nn.ParameterList([nn.Parameter(torch.from_numpy(w)) for w in (first, *later)])
        self.biases = nn.ParameterList([nn.Parameter(torch.from_numpy(b)) for b in biases])
        self.sectors = nn.ModuleList([Sector((width,), *slopes, train_slopes) for _ in range(depth)])

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        for w, b, sector in zip(self.weights, self.biases, self.sectors, strict=False):
            low, high = sector()
            v = leaky(v @ w.T + b, low, high) - leaky(b, low, high)
        return v @ self.weights[-1].T

    def pieces(self) -> Pieces | None:
        if len(self.biases) > 1 or self.weights[0].shape[1] > 1:
            return None
        return sorted_pieces(self.weights[0][:, 0], self.weights[1][0], self.biases[0], *self.sectors[0]())

    def freeze(self) -> MlpScaffold:
        slopes = [sector() for sector in self.sectors]
        return MlpScaffold(
            network=Network(
                weights=tuple(numbers(w) for w in self.weights),
                biases=tuple(numbers(b) for b in self.biases),
                negative_slopes=tuple(numbers(low) for low, _ in slopes),
                positive_slopes=tuple(numbers(high) for _, high in slopes),
            )
        )
