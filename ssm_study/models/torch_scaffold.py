"""Static map in torch while it is trained."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

# Points, slopes and offsets: `models.scaffolds.scaffold.Pieces`.
Pieces = tuple[Tensor, Tensor, Tensor]


class TorchScaffold(nn.Module):
    """Static map as a torch module: the free parameters of a `Trainable` in float64.

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

    def explicit(self) -> Any:
        return self.spec.explicit(dict(self.named_parameters()), self.slopes)

    def forward(self, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch k"]:
        return self.spec.evaluate(self.explicit(), v)

    def freeze(self) -> Any:
        return self.spec.frozen(self.explicit(), self.slopes)

    def pieces(self) -> Pieces | None:
        return self.spec.pieces(self.explicit())

    def roughness(self) -> Float[Tensor, ""]:
        return self.spec.roughness(self.explicit())
