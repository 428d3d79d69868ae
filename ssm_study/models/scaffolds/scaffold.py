"""Interface of the static maps before and after the recurrence, and how they are stored.

`Scaffold` is what is stored, replayed, certified and deployed; `Trainable` is what a yaml of the
group `scaffold` says. Members are found by `names`, the kind that JSON says.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float, Int

from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound
from ssm_study.family import Family
from ssm_study.models import scaffolds
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.refusal import require, require_one_of
from ssm_study.signals import Scale
from ssm_study.systems import AGAIN, StateSpace, array_from_json

FLAT = (Network, Scale, StateSpace)  # their entries stand beside those of what holds them


class JsonDataclass:
    """Base class of dataclasses that can be written to JSON and read back exactly. Fields are
    arrays, numbers, words, `FLAT` nouns, others of this kind, or tuples."""

    kind: ClassVar[str | None] = None

    def to_json(self) -> dict[str, Any]:
        """Convert the fields of a dataclass to plain values for JSON. Floats are read back as the
        same float64. An empty array that a field has by default is left out."""
        data = {} if self.kind is None else {"kind": self.kind}
        for field, value in _json_fields(self):
            nested = _json_fields(value) if isinstance(value, FLAT) else [(field, value)]
            data |= {part.name: _to_json_value(own) for part, own in nested}
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Any:
        """Build a dataclass instance from its JSON form. Raises `BadRequest` that names a missing
        or malformed entry."""
        return _build_from_json(cls, data)


def _json_fields(instance: Any) -> list[tuple[Field[Any], Any]]:
    """Fields of a dataclass instance that are written to JSON, with their values."""
    all_fields = fields(instance)
    entries = [(field, getattr(instance, field.name)) for field in all_fields]
    return [
        (field, value) for field, value in entries if not (_is_optional(field) and not value.size)
    ]


def _is_optional(field: Field[Any]) -> bool:
    """Whether a dataclass field has an empty default, so that an older JSON file may lack it."""
    return field.default_factory is not MISSING


def _to_json_value(value: Any) -> Any:
    """Convert a field's value to lists, numbers and texts that JSON can store."""
    if isinstance(value, tuple):
        return [_to_json_value(part) for part in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.to_json() if isinstance(value, JsonDataclass) else value


def _build_from_json(kind: Any, data: Mapping[str, Any]) -> Any:
    """Build an instance of a given dataclass from its JSON form."""
    hints = get_type_hints(kind)
    all_fields = fields(kind)
    needed = (field for field in all_fields if field.name in data or not _is_optional(field))
    entries = {
        field.name: _read_json_field(hints[field.name], field.name, data) for field in needed
    }
    return kind(**entries)


def _read_json_field(kind: Any, key: str, data: Mapping[str, Any]) -> Any:
    """Read one field of a dataclass from its JSON form."""
    if kind in FLAT:
        return _build_from_json(kind, data)
    if get_origin(kind) is tuple:
        stored_list = data.get(key)
        require(isinstance(stored_list, list), key, stored_list, "is not a list", AGAIN)
        parts = (_read_json_field(get_args(kind)[0], key, {key: part}) for part in data[key])
        return tuple(parts)
    if kind is float:
        return float(array_from_json(data, key, 0))
    if kind is str or issubclass(kind, JsonDataclass):
        needed = str if kind is str else Mapping
        description = "a text" if kind is str else "an object"
        stored_value = data.get(key)
        require(isinstance(stored_value, needed), key, stored_value, f"is not {description}", AGAIN)
        return data[key] if kind is str else kind.from_json(data[key])
    axes = kind.dim_str.split()
    values = array_from_json(data, key, len(axes))
    return values.astype(np.int64) if kind.dtype is Int else values


Free = dict[str, Tensor]
# `(points (h,), slopes (h + 1,), offsets (h + 1,))`: `S(v) = slopes_j v + offsets_j` from point j -
# 1 to j.
Pieces = tuple[Tensor, Tensor, Tensor]
Square = Float[np.ndarray, "m m"]
ROUNDING = (
    0.01  # of the largest slope: rounds the total variation off where a slope does not change
)


class Scaffold(Family, JsonDataclass):
    """Base class of a model's static input and output maps; all Jacobians of a map lie in a known
    ball. `S: R^m -> R^k` with `S(0) = 0` exactly, as explicit parameters only.

    Scaled units on both sides. Every member is a frozen dataclass that is written to and read from
    JSON without loss.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of output channels and input channels of a static map."""
        portable = self.as_portable()
        outputs, inputs = portable.linear.shape
        return outputs, inputs

    @property
    def outputs(self) -> int:
        """Number of output channels of a static map."""
        return self.shape[0]

    @property
    def inputs(self) -> int:
        """Number of input channels of a static map."""
        return self.shape[1]

    @abstractmethod
    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        """Evaluate a static map at every vector of a batch."""

    @abstractmethod
    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """Jacobian matrix of a static map at one point. At a break point it has the slope to its
        right (of the pre-activation)."""

    @abstractmethod
    def slope_bound(self) -> SlopeBound:
        """Ball of matrices that contains every Jacobian of a static map, as a bound on its slopes.
        `alpha I + beta Delta`."""

    @abstractmethod
    def jacobian_centre(self) -> Square | None:
        """Centre of the ball of a static map's Jacobians, a matrix that the model's linear part can
        absorb."""

    def compose_with_output_matrix(self, m: Square) -> "Scaffold":
        """Composition of a static map with a matrix that multiplies the map's output. `v -> m
        S(v)`, m the inverse of `jacobian_centre()`; only called where there is one."""
        raise NotImplementedError(f"{self.kind}: no centre, so nothing to move")

    def compose_with_input_matrix(self, m: Square) -> "Scaffold":
        """Composition of a static map with a matrix that multiplies the map's input. `v -> S(m v)`,
        m the inverse of `jacobian_centre()`."""
        return self.compose_with_output_matrix(m)

    @abstractmethod
    def as_portable(self) -> PortableMap:
        """Convert a static map to plain arrays: a matrix and a leaky-ReLU network."""

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Any:
        """Read a static map of any kind from its JSON form. Raises `BadRequest` for an unknown
        kind, and as `JsonDataclass` does."""
        if "as_portable" not in cls.__abstractmethods__:
            return super().from_json(data)
        require_one_of(kinds := Scaffold.members(scaffolds), "kind", data.get("kind"))
        kind = kinds[data["kind"]]
        return kind.from_json(data)


def tensor_to_numpy(values: Float[Tensor, "..."]) -> Float[np.ndarray, "..."]:
    """Convert a torch tensor to a NumPy float64 array."""
    exact_values = values.detach().cpu().double()
    return exact_values.numpy().copy()


def zero_preserving_offsets(
    points: Float[Tensor, "*c h"], slopes: Float[Tensor, "*c h1"]
) -> Float[Tensor, "*c h1"]:
    """Offsets with which affine pieces join continuously to a map that is exactly zero at zero."""
    slopes_before = slopes[..., :-1]
    slopes_after = slopes[..., 1:]
    slope_changes = slopes_before - slopes_after
    jumps = slope_changes * points  # what keeps the map continuous at each point
    jumps_above_zero = torch.where(points > 0, jumps, 0.0)
    beyond = jumps_above_zero.cumsum(-1)
    jumps_below_zero = torch.where(points <= 0, jumps, 0.0)
    from_zero_down = jumps_below_zero.flip(-1)
    before = from_zero_down.cumsum(-1).flip(-1)
    first_jump = jumps[..., :1]
    zero = torch.zeros_like(first_jump)
    right_parts = [zero, beyond]
    left_parts = [before, zero]
    return torch.cat(right_parts, -1) - torch.cat(left_parts, -1)


def evaluate_piecewise_linear_map(
    pieces: Pieces, v: Float[Tensor, "*batch c"]
) -> Float[Tensor, "*batch c"]:
    """Evaluate a piecewise-linear map, given by break points, slopes and offsets, at every vector
    of a batch. Points, slopes and offsets have one row per channel."""
    points, slopes, offsets = pieces
    rows_of_channels = v.flatten(0, -2)
    flat = rows_of_channels.mT.contiguous()  # searchsorted wants rows that lie in order
    fixed_points = points.detach()
    fixed_values = flat.detach()
    piece = torch.searchsorted(fixed_points, fixed_values, right=True)
    piece_slopes = slopes.gather(-1, piece)
    piece_offsets = offsets.gather(-1, piece)
    mapped = piece_slopes * flat + piece_offsets
    return mapped.mT.reshape(v.shape)


def relative_roughness(slopes: Float[Tensor, "*c h1"]) -> Float[Tensor, "*c"]:
    """Total variation of a piecewise-linear map's slope, relative to the largest slope. The
    absolute value is rounded off at one percent of that slope.

    A step from flat to steep costs the same however many pieces it takes; spikes between two levels
    of the data, which fit noise and widen the slope interval that a certificate must cover, cost
    extra.
    """
    fixed_slopes = slopes.detach()
    largest_slope = fixed_slopes.amax(-1, keepdim=True)
    relative = slopes / largest_slope
    changes = relative.diff()
    rounded_sizes = torch.sqrt(changes**2 + ROUNDING**2)
    return (rounded_sizes - ROUNDING).sum(-1)
