"""What training adds to the squared error: roughness of the scaffoldings, and the Hankel singular values' sum."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ssm_study.models.torch_hankel import hankel_singular_values
from ssm_study.models.torch_ssm import TorchSSM


@dataclass(frozen=True, kw_only=True)
class Penalties:
    """`roughness_weight (TV(S_u') + TV(S_y')) + hankel_weight sum(sigma) / max(sigma)`.

    Both terms are free of scale, so a weight of 0.001 means a thousandth of the output's variance. The second is the
    nuclear norm of the Hankel operator: it drives the singular values of redundant states to zero, one after the other.
    """

    roughness_weight: float
    hankel_weight: float

    def of(self, model: TorchSSM) -> Float[Tensor, "*models"]:
        total = torch.zeros((), dtype=model.lru.nu.dtype, device=model.lru.nu.device)
        if self.roughness_weight > 0:
            total = total + self.roughness_weight * (model.scaffold_in.roughness() + model.scaffold_out.roughness())
        if self.hankel_weight > 0:
            sigma = hankel_singular_values(model.lru.modes(), model.lru.reals)
            total = total + self.hankel_weight * sigma.sum() / sigma.max()
        return total
