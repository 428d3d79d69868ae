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

    `spec` is that `Trainable`; `freeze()` returns the explicit parameters.
    """

    def __init__(
        self, spec: Any, start: dict[str, np.ndarray], slopes: tuple[float, float]
    ) -> None:
        super().__init__()
        self.spec = spec
        self.slopes = slopes
        for name, values in start.items():
            at = torch.tensor(np.ascontiguousarray(values))
            self.register_parameter(
                name, nn.Parameter(at, requires_grad=not name.startswith(spec.fixed))
            )

    def explicit_parameters(self) -> Any:
        """Explicit parameters of the trainable map."""
        return self.spec.explicit_parameters(dict(self.named_parameters()), self.slopes)

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]:
        """Evaluate the trainable map at a batch of vectors."""
        return self.spec.evaluate(self.explicit_parameters(), v)

    def freeze(self) -> Any:
        """Freeze the trained static map to explicit numbers."""
        return self.spec.freeze(self.explicit_parameters(), self.slopes)

    def pieces(self) -> Pieces | None:
        """Affine pieces of the map, if it is piecewise linear with one channel."""
        return self.spec.pieces(self.explicit_parameters())

    def roughness(self) -> Float[Tensor, ""]:
        """Roughness of the map, the total variation of its slopes, for the training penalty."""
        return self.spec.roughness(self.explicit_parameters())
