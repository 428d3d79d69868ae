"""`S(v) = gain v`: the linear scaffolding."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.scaffold import Scaffold, array_from_json


@dataclass(frozen=True, kw_only=True)
class LinearScaffold(Scaffold):
    """`S(v) = gain v`, `gain (k, m)`; the identity when it stands for "no nonlinearity"."""

    kind: ClassVar[str] = "linear"
    gain: Float[np.ndarray, "k m"]

    @classmethod
    def identity(cls, channels: int) -> "LinearScaffold":
        return cls(gain=np.eye(channels))

    @property
    def inputs(self) -> int:
        return self.gain.shape[1]

    @property
    def outputs(self) -> int:
        return self.gain.shape[0]

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        return v @ self.gain.T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:  # noqa: ARG002 - the same everywhere
        return self.gain.copy()

    def to_json(self) -> dict[str, Any]:
        return {"kind": self.kind, "gain": self.gain.tolist()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "LinearScaffold":
        return cls(gain=array_from_json(data, "gain", 2))
