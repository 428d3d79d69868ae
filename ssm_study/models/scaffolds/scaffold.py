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


class Explicit:
    """Base class of dataclasses that are written to JSON and read from it. Fields are arrays,
    numbers, words, `FLAT` nouns, others of this kind, or tuples."""

    kind: ClassVar[str | None] = None

    def to_json(self) -> dict[str, Any]:
        """Fields of the object as plain values for JSON. Floats are read back as the same float64.
        An empty array that a field has by default is left out."""
        data = {} if self.kind is None else {"kind": self.kind}
        for field, value in _json_fields(self):
            nested = _json_fields(value) if isinstance(value, FLAT) else [(field, value)]
            data |= {part.name: _to_plain(own) for part, own in nested}
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Any:
        """Build the object from its JSON form. Raises `BadRequest` that names a missing or
        malformed entry."""
        return _build_from_json(cls, data)


def _json_fields(of: Any) -> list[tuple[Field[Any], Any]]:
    """Fields of an object that are written to JSON, with their values."""
    all_fields = fields(of)
    entries = [(field, getattr(of, field.name)) for field in all_fields]
    return [
        (field, value) for field, value in entries if not (_is_optional(field) and not value.size)
    ]


def _is_optional(field: Field[Any]) -> bool:
    """Whether a field is empty by default, so that older files lack it."""
    return field.default_factory is not MISSING


def _to_plain(value: Any) -> Any:
    """Convert a value to plain lists and numbers for JSON."""
    if isinstance(value, tuple):
        return [_to_plain(part) for part in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.to_json() if isinstance(value, Explicit) else value


def _build_from_json(kind: Any, data: Mapping[str, Any]) -> Any:
    """Build an object of a given class from its JSON form."""
    hints = get_type_hints(kind)
    all_fields = fields(kind)
    needed = (field for field in all_fields if field.name in data or not _is_optional(field))
    entries = {field.name: _read_entry(hints[field.name], field.name, data) for field in needed}
    return kind(**entries)


def _read_entry(kind: Any, key: str, data: Mapping[str, Any]) -> Any:
    """Read one field of an object from its JSON form."""
    if kind in FLAT:
        return _build_from_json(kind, data)
    if get_origin(kind) is tuple:
        stored_list = data.get(key)
        require(isinstance(stored_list, list), key, stored_list, "expected a list", AGAIN)
        parts = (_read_entry(get_args(kind)[0], key, {key: part}) for part in data[key])
        return tuple(parts)
    if kind is float:
        return float(array_from_json(data, key, 0))
    if kind is str or issubclass(kind, Explicit):
        needed = str if kind is str else Mapping
        stored_value = data.get(key)
        require(
            isinstance(stored_value, needed),
            key,
            stored_value,
            "missing or not what it should be",
            AGAIN,
        )
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


class Scaffold(Family, Explicit):
    """Base class of static maps whose Jacobians lie in a known ball. `S: R^m -> R^k` with `S(0) =
    0` exactly, as explicit parameters only.

    Scaled units on both sides. Every member is a frozen dataclass that is written to and read from
    JSON without loss.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of output and input channels of the static map."""
        portable = self.as_portable()
        outputs, inputs = portable.linear.shape
        return outputs, inputs

    @property
    def outputs(self) -> int:
        """Number of output channels of the static map."""
        return self.shape[0]

    @property
    def inputs(self) -> int:
        """Number of input channels of the static map."""
        return self.shape[1]

    @abstractmethod
    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        """Evaluate the static map at every vector of a batch."""

    @abstractmethod
    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """Jacobian of the static map at one point. At a break point it has the slope to its right
        (of the pre-activation)."""

    @abstractmethod
    def bound(self) -> SlopeBound:
        """Bound on the slopes of the static map: a ball that contains all its Jacobians. `alpha I +
        beta Delta`."""

    @abstractmethod
    def jacobian_centre(self) -> Square | None:
        """Centre matrix of the map's Jacobians, which may be moved into the linear part."""

    def compose_with_output_matrix(self, m: Square) -> "Scaffold":
        """Static map whose output is multiplied by a matrix. `v -> m S(v)`, m the inverse of
        `jacobian_centre()`; only called where there is one."""
        raise NotImplementedError(f"{self.kind}: no centre, so nothing to move")

    def compose_with_input_matrix(self, m: Square) -> "Scaffold":
        """Static map whose input is first multiplied by a matrix. `v -> S(m v)`, m the inverse of
        `jacobian_centre()`."""
        return self.compose_with_output_matrix(m)

    @abstractmethod
    def as_portable(self) -> PortableMap:
        """The same map as plain arrays: a matrix and a leaky-ReLU network."""

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Any:
        """Read a static map of any kind from its JSON form. Raises `BadRequest` for an unknown
        kind, and as `Explicit` does."""
        if "as_portable" not in cls.__abstractmethods__:
            return super().from_json(data)
        require_one_of(kinds := Scaffold.members(scaffolds), "kind", data.get("kind"))
        kind = kinds[data["kind"]]
        return kind.from_json(data)


def tensor_to_numpy(values: Float[Tensor, "..."]) -> Float[np.ndarray, "..."]:
    """Convert a tensor to a float64 array."""
    exact_values = values.detach().cpu().double()
    return exact_values.numpy().copy()


def zero_preserving_offsets(
    points: Float[Tensor, "*c h"], slopes: Float[Tensor, "*c h1"]
) -> Float[Tensor, "*c h1"]:
    """Offsets of affine pieces that join continuously to a map that is exactly zero at zero."""
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


def evaluate_pieces(pieces: Pieces, v: Float[Tensor, "*batch c"]) -> Float[Tensor, "*batch c"]:
    """Evaluate a piecewise-linear map at every vector of a batch. Points, slopes and offsets have
    one row per channel."""
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
    """Total variation of a map's slope, relative to its largest slope. The absolute value is
    rounded off at one percent of that slope.

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
