"""What every scaffolding answers: its value, its Jacobian, and its explicit parameters as JSON."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import BadRequest, require


class Scaffold(ABC):
    """A static map `S: R^m -> R^k` with `S(0) = 0` exactly, held as explicit parameters only.

    Scaled units on both sides. Every concrete class is a frozen dataclass that is written to and read from JSON
    without loss; free (trainable) parameters live on the torch side and are mapped to these by `freeze()`.
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def inputs(self) -> int:
        """`m`, the number of input channels."""

    @property
    @abstractmethod
    def outputs(self) -> int:
        """`k`, the number of output channels."""

    @abstractmethod
    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        """`S(v)` for every vector of the batch."""

    @abstractmethod
    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        """`dS/dv` at one point; at a break point, the slope to its right (of the pre-activation)."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Kind and explicit parameters; floats read back to the same float64."""


def array_from_json(data: Mapping[str, Any], key: str, dimensions: int) -> Float[np.ndarray, "..."]:
    """`data[key]` as a finite float64 array of that many dimensions; raises `BadRequest` otherwise."""
    require(key in data, key, "missing", "the stored model lacks this entry", "write model.json again")
    try:
        values = np.asarray(data[key], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(key, data[key], "not a rectangular array of numbers", "write model.json again") from error
    if values.size == 0 and values.ndim < dimensions:
        values = values.reshape((0,) * dimensions)
    require(
        values.ndim == dimensions and bool(np.isfinite(values).all()),
        key,
        f"shape {values.shape}",
        f"expected a finite array of {dimensions} dimension(s)",
        "write model.json again",
    )
    return values


def arrays_from_json(data: Mapping[str, Any], key: str, dimensions: int) -> tuple[Float[np.ndarray, "..."], ...]:
    """A list of arrays, one per layer."""
    require(isinstance(data.get(key), list), key, data.get(key), "expected a list of layers", "write model.json again")
    return tuple(array_from_json({key: layer}, key, dimensions) for layer in data[key])
