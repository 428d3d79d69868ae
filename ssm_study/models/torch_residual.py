"""A trainable map whose Jacobians fill a ball by construction, in any dimension."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ssm_study.models.network import Network
from ssm_study.models.scaffold_residual import ResidualScaffold
from ssm_study.models.torch_scaffold import TorchScaffold, numbers


class TorchResidual(TorchScaffold):
    """`S(v) = alpha v + beta (G(v) - G(0))`, `|G(v) - G(w)| <= |v - w|`, so `J` fills the ball `alpha I + beta Delta`.

    G is a stack of sandwich layers `h -> sqrt2 A^T Psi relu(sqrt2 Psi^-1 B h + b)` closed by a linear one, with
    `A A^T + B B^T = I` from a Cayley map: every value of the free parameters is 1-Lipschitz. Written out, G is a
    perceptron with Lipschitz multipliers `Psi^2`. Source: Wang & Manchester (2023), eqs. (8)-(11).
    """

    def __init__(
        self, inputs: Float[np.ndarray, "N m"], widths: list[int], slopes: tuple[float, float], rng: np.random.Generator
    ) -> None:
        super().__init__()
        self.alpha, self.beta = (slopes[1] + slopes[0]) / 2, (slopes[1] - slopes[0]) / 2
        sizes = [inputs.shape[1], *widths]
        x = [rng.normal(size=(h, h)) / np.sqrt(h) for h in widths]
        y = [rng.normal(size=(m, h)) / np.sqrt(h) for m, h in zip(sizes[:-1], widths, strict=True)]
        last = rng.normal(size=(inputs.shape[1], widths[-1])) / np.sqrt(widths[-1])
        self.skews = _parameters(x)
        self.tails = _parameters(y)
        self.scales = _parameters([np.zeros(h) for h in widths])
        self.biases = _parameters([rng.normal(size=h) for h in widths])
        self.last_skew = nn.Parameter(torch.from_numpy(rng.normal(size=(inputs.shape[1],) * 2) * 0.1))
        self.last_tail = nn.Parameter(torch.from_numpy(last.T.copy()))

    def layers(self) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Plain weights and biases of G, and `psi` of each hidden layer."""
        weights, left = [], None
        psis = [torch.exp(scale) for scale in self.scales]
        for skew, tail, psi in zip(self.skews, self.tails, psis, strict=True):
            a, b = cayley(skew, tail)
            enter = math.sqrt(2.0) * b / psi[:, None]
            weights.append(enter if left is None else enter @ left)
            left = math.sqrt(2.0) * a.T * psi
        _, b = cayley(self.last_skew, self.last_tail)
        assert left is not None  # there is at least one hidden layer
        return [*weights, b @ left], list(self.biases), psis

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        weights, biases, _ = self.layers()
        d = v
        for w, b in zip(weights[:-1], biases, strict=True):
            d = torch.relu(d @ w.T + b) - torch.relu(b)
        return self.alpha * v + self.beta * (d @ weights[-1].T)

    def freeze(self) -> ResidualScaffold:
        weights, biases, psis = self.layers()
        zeros, ones = [np.zeros(len(b)) for b in biases], [np.ones(len(b)) for b in biases]
        network = Network(
            weights=tuple(numbers(w) for w in weights),
            biases=tuple(numbers(b) for b in biases),
            negative_slopes=tuple(zeros),
            positive_slopes=tuple(ones),
        )
        multipliers = tuple(numbers(psi) ** 2 for psi in psis)
        return ResidualScaffold(alpha=self.alpha, beta=self.beta, network=network, multipliers=multipliers)


def cayley(skew: Float[Tensor, "h h"], tail: Float[Tensor, "m h"]) -> tuple[Float[Tensor, "h h"], Float[Tensor, "h m"]]:
    """`(A, B)` with `A A^T + B B^T = I` for any real `skew, tail`.

    `Z = X - X^T + Y^T Y`, `A^T = (I + Z)^-1 (I - Z)`, `B^T = -2 Y (I + Z)^-1`.
    """
    eye = torch.eye(len(skew), dtype=skew.dtype, device=skew.device)
    z = skew - skew.T + tail.T @ tail
    inverse = torch.linalg.inv(eye + z)
    return ((eye - z) @ inverse).T, (-2 * tail @ inverse).T


def _parameters(arrays: list[np.ndarray]) -> nn.ParameterList:
    return nn.ParameterList([nn.Parameter(torch.from_numpy(np.ascontiguousarray(array))) for array in arrays])
