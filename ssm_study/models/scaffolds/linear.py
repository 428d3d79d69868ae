"""Linear static map, `S(v) = gain v`."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import PortableMap
from ssm_study.bounds.slopes import (
    SlopeBound,
    ball_around_scaled_identity,
    bound_from_ball,
    bound_from_interval,
)
from ssm_study.models.lazy_torch import Tensor
from ssm_study.models.scaffolds.scaffold import Free, Scaffold, Square
from ssm_study.models.scaffolds.trainable import MapContext, Trainable


@dataclass(frozen=True, kw_only=True)
class LinearScaffold(Scaffold, names=("linear",)):
    """Linear static map `S(v) = gain v`. `gain (k, m)` is the identity where the model has no
    nonlinearity."""

    gain: Float[np.ndarray, "k m"]

    @classmethod
    def identity(cls, channels: int) -> "LinearScaffold":
        """Identity map with a given number of channels."""
        return cls(gain=np.eye(channels))

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        return v @ self.gain.T

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:  # noqa: ARG002 - the same everywhere
        return self.gain.copy()

    def slope_bound(self) -> SlopeBound:
        if self.gain.shape == (1, 1):
            scalar_gain = self.gain[0, 0]
            gain = Fraction(float(scalar_gain))
            return bound_from_interval(gain, gain, "construction")
        ball = ball_around_scaled_identity(self.gain, 0.0)
        return bound_from_ball(ball, "construction")

    def jacobian_centre(self) -> Square:
        return self.gain

    def compose_with_output_matrix(self, m: Square) -> "LinearScaffold":
        return self.identity(len(m))

    def as_portable(self) -> PortableMap:
        return PortableMap(linear=self.gain, network=None)


@dataclass(frozen=True, kw_only=True)
class Linear(Trainable):
    """Setting that makes a static map the identity, without parameters to train. A trainable gain
    would only repeat what B or C already contain."""

    fixed = ("gain",)

    def initial_values(
        self,
        frame: MapContext,
        rng: np.random.Generator,  # noqa: ARG002
    ) -> dict[str, Float[np.ndarray, "..."]]:
        channel_count = frame.samples.shape[1]
        return {"gain": np.eye(channel_count)}

    def explicit_parameters(self, free: Free, slopes: tuple[float, float]) -> Tensor:  # noqa: ARG002
        return free["gain"]

    def evaluate(self, explicit: Tensor, v: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:  # noqa: ARG002
        return v

    def to_numpy(self, explicit: Tensor, slopes: tuple[float, float]) -> LinearScaffold:  # noqa: ARG002
        return LinearScaffold.identity(len(explicit))
