"""Modules of one architecture as a single module whose tensors have a leading axis: what one does, all do at once."""

import copy
from collections.abc import Hashable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

from ssm_study.models.torch_lift import Lift
from ssm_study.models.torch_lru import LRU
from ssm_study.models.torch_monotone import TorchMonotone
from ssm_study.models.torch_scaffold import TorchIdentity
from ssm_study.models.torch_scalar_mlp import Kinks, TorchScalarMlp
from ssm_study.models.torch_ssm import TorchSSM
from ssm_study.training.objective import Records
from ssm_study.training.optimisers import trainable

M = TypeVar("M", bound=nn.Module)

WITH_LEADING_AXIS = (TorchSSM, LRU, TorchIdentity, TorchScalarMlp, Kinks, TorchMonotone, Records, Lift, nn.ModuleList)


class Vector(nn.Module):
    """The trainable parameters of `module` in a row, of which they become views: an optimiser then has one tensor."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        parts = trainable(module)
        self.values = nn.Parameter(torch.cat([part.detach().flatten() for part in parts]))
        rows = self.values.data.split([part.numel() for part in parts])
        for part, row in zip(parts, rows, strict=True):
            part.data = row.view(part.shape)


class Stack(Generic[M]):
    """`joint` computes for all `modules` what each computes for itself; the parameters stay those of the modules.

    `load` brings what `vectors` hold into `joint`, `hand_back` its gradients to them; modules without trainable
    parameters need none. All must be of one `architecture`.
    """

    def __init__(self, modules: Sequence[M], vectors: Sequence[Vector] = ()) -> None:
        self.joint = copy.deepcopy(modules[0])
        for joint, *parts in zip(self.joint.modules(), *(module.modules() for module in modules), strict=True):
            for name, of_first in joint.named_parameters(recurse=False):
                rows = torch.stack([part.get_parameter(name).detach() for part in parts])
                joint.register_parameter(name, nn.Parameter(rows, of_first.requires_grad))
            for name, _ in joint.named_buffers(recurse=False):
                setattr(joint, name, _filled_up([part.get_buffer(name) for part in parts]))
        self._rows: list[Tensor] = [vector.values for vector in vectors]
        self._parts = trainable(self.joint)

    @torch.no_grad()
    def load(self) -> None:
        columns = torch.stack(self._rows).split([part[0].numel() for part in self._parts], 1)
        for part, column in zip(self._parts, columns, strict=True):
            part.copy_(column.view(part.shape))

    def hand_back(self) -> None:
        """Each vector's gradient becomes a row of the joint one."""
        gradients = [torch.zeros_like(part) if part.grad is None else part.grad for part in self._parts]
        table = torch.cat([gradient.flatten(1) for gradient in gradients], 1)
        for row, gradient in zip(self._rows, table.unbind(0), strict=True):
            row.grad = gradient
        for part in self._parts:
            part.grad = None


def architecture(module: nn.Module) -> tuple[Hashable, ...] | None:
    """What modules of one stack agree in: kinds, settings and shapes. None for a kind that knows no leading axis."""
    parts = list(module.named_modules())
    if any(type(part) not in WITH_LEADING_AXIS for _, part in parts):
        return None
    return tuple((name, type(part).__name__, *_settings(part), *_shapes(part)) for name, part in parts)


def _settings(part: nn.Module) -> list[tuple[str, Hashable]]:
    return [(name, value) for name, value in vars(part).items() if isinstance(value, int | float | str)]


def _shapes(part: nn.Module) -> list[tuple[str, torch.Size]]:
    named = [*part.named_parameters(recurse=False), *part.named_buffers(recurse=False)]
    ragged = isinstance(part, Lift) and part.levels  # each input has its own number of levels
    return [(name, value.shape[1:] if ragged and name == "values" else value.shape) for name, value in named]


def _filled_up(tensors: Sequence[Tensor]) -> Tensor:
    """`(modules, ...)`; where first axes differ in length, zeros fill up the shorter ones."""
    if tensors[0].dim() == 0:
        return torch.stack(list(tensors))
    longest = max(len(tensor) for tensor in tensors)
    fill = [tensor.new_zeros(longest - len(tensor), *tensor.shape[1:]) for tensor in tensors]
    return torch.stack([torch.cat([tensor, zeros]) for tensor, zeros in zip(tensors, fill, strict=True)])
