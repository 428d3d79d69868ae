"""Torch module of a static map that is trained."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

# Points, slopes and offsets: `models.scaffolds.scaffold.Pieces`.
Pieces = tuple[Tensor, Tensor, Tensor]


class TorchScaffold(nn.Module):
    """Trainable static map as a torch module.

    `spec` is that `Trainable`; `to_numpy()` returns the explicit parameters.
    """

    def __init__(
        self, spec: Any, start: dict[str, np.ndarray], slopes: tuple[float, float]
    ) -> None:
        super().__init__()
        self.spec = spec
        self.slopes = slopes
        for name, values in start.items():
            contiguous = np.ascontiguousarray(values)
            at = torch.tensor(contiguous)
            is_fixed = name.startswith(spec.fixed)
            parameter = nn.Parameter(at, requires_grad=not is_fixed)
            self.register_parameter(name, parameter)

    def explicit_parameters(self) -> Any:
        """Parameters of a trainable static map that respect its slope bounds."""
        free_parameters = self.named_parameters()
        return self.spec.explicit_parameters(dict(free_parameters), self.slopes)

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]:
        """Evaluate a trainable static map at every vector of a batch."""
        explicit = self.explicit_parameters()
        return self.spec.evaluate(explicit, v)

    def to_numpy(self) -> Any:
        """Copy of a trained static map with NumPy arrays as parameters, independent of torch."""
        explicit = self.explicit_parameters()
        return self.spec.to_numpy(explicit, self.slopes)

    def affine_pieces(self) -> Pieces | None:
        """Affine pieces of a trainable static map, if it is piecewise linear with one channel."""
        explicit = self.explicit_parameters()
        return self.spec.affine_pieces(explicit)

    def roughness(self) -> Float[Tensor, ""]:
        """Total variation of a trainable static map's slope, used in a training penalty."""
        explicit = self.explicit_parameters()
        return self.spec.roughness(explicit)
