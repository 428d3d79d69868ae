"""The signals everyone shares: channels, trajectories, data sets, and the two numbers that score a simulation."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A named physical quantity, e.g. `Channel(name="armature_voltage", unit="V")`."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One experiment: `u[k]` is held over `[k, k+1) step_s`, `y[k]` is sampled at `k step_s`, before `u[k]` acts.

    Shapes: `u (T, m)`, `y (T, p)`, both in physical units. Raises `BadRequest` for unequal lengths, values that are
    not finite, or a sampling time that is not positive.
    """

    u: Float[np.ndarray, "T m"]
    y: Float[np.ndarray, "T2 p"]
    step_s: float
    name: str = "trajectory"

    def __post_init__(self) -> None:
        require(self.step_s > 0, "step_s", self.step_s, "the sampling time must be positive", "give it in seconds")
        require(
            len(self.u) == len(self.y),
            f"{self.name}.u, {self.name}.y",
            (len(self.u), len(self.y)),
            "input and output differ in length",
            "cut both to the same samples",
        )
        for label, values in (("u", self.u), ("y", self.y)):
            bad = np.argwhere(~np.isfinite(values))
            require(
                len(bad) == 0,
                f"{self.name}.{label}",
                "NaN or infinity",
                f"first at sample {bad[0][0] if len(bad) else 0}",
                "remove or interpolate these samples",
            )

    def __len__(self) -> int:
        return len(self.u)

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        return np.arange(len(self.u)) * self.step_s


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """Separate training, validation and test records of one system.

    `start_up_samples` are simulated but not scored. The equilibrium `(input_equilibrium, output_equilibrium)` is where
    the model's `S_u(0) = 0` sits; the scales are pure gains around it, so that zero stays zero.
    """

    training: tuple[Trajectory, ...]
    validation: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    input_equilibrium: Float[np.ndarray, "m"]
    output_equilibrium: Float[np.ndarray, "p"]
    input_scale: Float[np.ndarray, "m"]
    output_scale: Float[np.ndarray, "p"]
    start_up_samples: int = 0
    metadata: dict[str, str] = field(default_factory=dict)

    @property
    def step_s(self) -> float:
        return self.training[0].step_s


def fit_percent(y: Float[np.ndarray, "T p"], y_hat: Float[np.ndarray, "T p"], start_up_samples: int = 0) -> float:
    """`100 (1 - ||y - y_hat|| / ||y - mean(y)||)`, Frobenius norms over all channels, after the start-up samples."""
    y, y_hat = y[start_up_samples:], y_hat[start_up_samples:]
    return float(100.0 * (1.0 - np.linalg.norm(y - y_hat) / np.linalg.norm(y - y.mean(axis=0))))


def rmse(y: Float[np.ndarray, "T p"], y_hat: Float[np.ndarray, "T p"], start_up_samples: int = 0) -> float:
    """`sqrt(mean((y - y_hat)^2))` in the unit of y, after the start-up samples."""
    return float(np.sqrt(np.mean((y[start_up_samples:] - y_hat[start_up_samples:]) ** 2)))
