"""What lies between a plant's output and whoever reads it: quantisation and noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt64
from scipy.special import ndtri

from ssm_study.plants.wrapper import Wrapper
from ssm_study.refusal import require
from ssm_study.signals import Channel

STREAM_BITS = 52  # whole numbers below 2^52 are exact in a float64 state


@dataclass(frozen=True, kw_only=True)
class QuantisedOutput(Wrapper):
    """`y = resolution round(h(x) / resolution)`: an encoder or converter; resolution in the output's unit."""

    resolution: float

    def __post_init__(self) -> None:
        require(
            0 < self.resolution < np.inf, "resolution", self.resolution, "must be positive", "give the output's unit"
        )

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N p"]:
        return self.resolution * np.round(self.plant.output(x) / self.resolution)


@dataclass(frozen=True, kw_only=True)
class NoisyOutput(Wrapper):
    """`y = h(x) + e`, `e ~ N(0, variance)`, independent from sample to sample and between trajectories.

    A plant is a function of its state, so the randomness is one too: an appended state is a stream of whole numbers,
    scrambled at each step together with the input that acted, and read through the normal quantile function. The same
    seed, start and inputs give the same noise. `variance` None takes the plant's own, per output.
    """

    seed: int
    variance: float | None = None

    def __post_init__(self) -> None:
        variance = self.variance
        good = variance is None or 0 <= variance < np.inf
        require(good, "variance", variance, "a variance is never negative", "use 0 for no noise, or null")
        require(self.seed >= 0, "seed", self.seed, "must not be negative", "use 0")

    @property
    def memory(self) -> tuple[Channel, ...]:
        return (Channel(name="noise_stream", unit="1"),)

    @property
    def noise_variance(self) -> tuple[float, ...]:
        own = self.plant.noise_variance
        return own if self.variance is None else (self.variance,) * len(own)

    def fresh_memory(self, y0: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N 1"]:
        return _stream(np.full((len(y0), 1), float(self.seed)), y0)

    def renewed(self, memory: Float[np.ndarray, "N r"], u: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N r"]:
        return _stream(memory, u)

    def output(self, x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N p"]:
        inner, stream = self.split(x)
        y = self.plant.output(inner)
        draws = [(_stream(stream + 1.0 + j, stream) + 0.5) / 2.0**STREAM_BITS for j in range(y.shape[1])]
        return y + np.sqrt(np.array(self.noise_variance)) * ndtri(np.concatenate(draws, axis=1))


def _stream(stream: Float[np.ndarray, "N 1"], signal: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N 1"]:
    """The next whole number of each stream, depending on every bit of the signal."""
    mixed = _scrambled(stream.astype(np.uint64))
    for column in np.ascontiguousarray(signal.T):
        mixed = _scrambled(mixed ^ column.copy().view(np.uint64)[:, None])
    return (mixed >> np.uint64(64 - STREAM_BITS)).astype(np.float64)


def _scrambled(z: UInt64[np.ndarray, "N 1"]) -> UInt64[np.ndarray, "N 1"]:
    """SplitMix64 (Steele, Lea, Flood 2014); multiplication wraps, as it must."""
    z = z + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
