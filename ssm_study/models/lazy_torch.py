"""Substitute for the module torch, which imports torch only when one of its functions is first
used. It takes two seconds, and reading a stored model needs none.

Only `torch.name` inside functions is possible; annotations say `Tensor`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    Tensor = Any  # jaxtyping then checks shape and type of whatever has both

    class _Torch:
        def __getattr__(self, name: str) -> Any:
            return getattr(import_module("torch"), name)

    torch = _Torch()

__all__ = ["Tensor", "torch"]
