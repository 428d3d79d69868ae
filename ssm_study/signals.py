"""Signals, scaling and data sets. The signals everyone shares: channels, trajectories, data
sets, and the two numbers that score a simulation."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require, require_positive


@dataclass(frozen=True, kw_only=True)
class Channel:
    """Name and unit of a physical quantity, such as `Channel(name="armature_voltage",
    unit="V")`."""

    name: str
    unit: str

    @property
    def name_with_unit(self) -> str:
        """Name of a channel, followed by its unit in parentheses if a unit is known."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Measured or simulated signals of one experiment: inputs, outputs and measured disturbances.
    `u[k]` is constant over `[k, k+1) step_s`, `y[k]` is sampled at `k step_s`, before `u[k]` acts.

    Shapes: `u (T, m)`, `y (T, p)`, both in physical units; `d (T, k)` are measured disturbances,
    held as `u` is, None where there are none. In a `closed_loop` the input answers the output. A
    piece of a longer log begins at sample `first` of it; logs count from 1, and 0 is none. Raises
    `BadRequest` for unequal lengths, values that are not finite, or a sampling time that is not
    positive.
    """

    u: Float[np.ndarray, "T m"]
    y: Float[np.ndarray, "T2 p"]
    step_s: float
    name: str = "trajectory"
    closed_loop: bool = False
    log: int = 0
    first: int = 0
    d: Float[np.ndarray, "T3 k"] | None = None

    def __post_init__(self) -> None:
        require_positive("step_s", self.step_s, "give it in seconds")
        signals = {"u": self.u, "y": self.y}
        if self.d is not None:
            signals["d"] = self.d
        names = ", ".join(f"{self.name}.{label}" for label in signals)
        lengths = tuple(len(values) for values in signals.values())
        problem = "input and output differ in length"
        remedy = "cut both to the same samples"
        require(len(set(lengths)) == 1, names, lengths, problem, remedy)
        for label, values in signals.items():
            bad = np.argwhere(~np.isfinite(values))
            remedy = "remove or interpolate these samples"
            first = f"first at sample {bad[0][0] if len(bad) else 0}"
            require(not len(bad), f"{self.name}.{label}", "NaN or infinity", first, remedy)

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, samples: slice) -> "Trajectory":
        first = self.first + samples.indices(len(self))[0]
        d = None if self.d is None else self.d[samples]
        return replace(self, u=self.u[samples], y=self.y[samples], d=d, first=first)

    @property
    def inputs_and_disturbances(self) -> Float[np.ndarray, "T j"]:
        """Inputs and measured disturbances of a record side by side; the inputs alone if no
        disturbance is measured."""
        return self.u if self.d is None else np.hstack([self.u, self.d])

    @classmethod
    def concatenate(cls, pieces: "Sequence[Trajectory]") -> "Trajectory":
        """Join consecutive records into one record."""
        disturbances = [piece.d for piece in pieces if piece.d is not None]
        return replace(
            pieces[0],
            u=np.concatenate([piece.u for piece in pieces]),
            y=np.concatenate([piece.y for piece in pieces]),
            d=np.concatenate(disturbances) if disturbances else None,
        )

    def with_disturbances_as_inputs(self) -> "Trajectory":
        """Record in which the measured disturbances count as further inputs."""
        return replace(self, u=self.inputs_and_disturbances, d=None)

    @property
    def time_s(self) -> Float[np.ndarray, "T"]:
        """Time of each sample of a record in seconds, from zero."""
        return np.arange(len(self.u)) * self.step_s


SHORTEST_PERIOD = (
    32  # samples: what repeats sooner is a hold or a sine, not an experiment done twice
)


def find_repetition(u: Float[np.ndarray, "T m"]) -> tuple[int, int] | None:
    """Find where an input signal last contains two equal periods in a row, and return their start
    and the period in samples; None if the signal never repeats.

    The inputs must be equal, as commanded ones are; a piece that does not move does not count.
    """
    moving = u - u.mean(axis=0)
    spectrum = np.fft.rfft(moving, n=2 * len(u), axis=0)
    alike = np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=1))[: len(u) // 2 + 1]
    lags = np.arange(SHORTEST_PERIOD, len(alike))
    for lag in lags[np.argsort(-alike[lags] / (len(u) - lags), kind="stable")[:20]]:
        equal = np.all(np.abs(u[lag:] - u[:-lag]) <= 1e-9 * np.ptp(u, axis=0), axis=1)
        changes = np.any(u[1:] != u[:-1], axis=1)[: len(equal)]
        run, moves = (np.concatenate([[0], np.cumsum(flags)]) for flags in (equal, changes))
        starts = np.flatnonzero((run[lag:] - run[:-lag] == lag) & (moves[lag:] - moves[:-lag] > 0))
        if len(starts):
            return int(starts[-1]), int(lag)
    return None


def lagged_inputs(u: Float[np.ndarray, "T m"], lags: int) -> Float[np.ndarray, "K d"]:
    """Regression matrix of present and past inputs, with a column of ones for a constant term. Rows
    `(u[k], ..., u[k - lags], 1)` from sample `lags` on."""
    columns = [u[lags - lag : len(u) - lag] for lag in range(lags + 1)]
    return np.concatenate([*columns, np.ones((len(u) - lags, 1))], axis=1)


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Offsets and scales that convert physical to dimensionless signals. `u = u_eq + s_u v, y =
    y_eq + s_y w`, pure gains around the equilibrium.

    So zero stays zero, and a model with `S_u(0) = S_y(0) = 0` rests at the equilibrium. Shapes:
    `input_* (m,)`, `output_* (p,)`, and `disturbance_* (k,)` of measured disturbances, empty where
    there are none. Raises `BadRequest` for gains that are not positive, another number of
    equilibria than of gains, or entries that are not finite.
    """

    input_scale: Float[np.ndarray, "m"]
    output_scale: Float[np.ndarray, "p"]
    input_equilibrium: Float[np.ndarray, "m"]
    output_equilibrium: Float[np.ndarray, "p"]
    disturbance_scale: Float[np.ndarray, "k"] = field(default_factory=partial(np.zeros, 0))
    disturbance_equilibrium: Float[np.ndarray, "k"] = field(default_factory=partial(np.zeros, 0))

    def __post_init__(self) -> None:
        for side in ("input", "output", "disturbance"):
            gains = getattr(self, f"{side}_scale")
            rest = getattr(self, f"{side}_equilibrium")
            sound = (
                len(gains) == len(rest) and (gains > 0).all() and np.isfinite([gains, rest]).all()
            )
            problem = "needs positive scales, and one finite equilibrium value for each"
            require(
                sound,
                f"{side}_scale, {side}_equilibrium",
                (gains, rest),
                problem,
                "compute the scaling again",
            )

    @classmethod
    def identity(cls, inputs: int, outputs: int) -> "Scale":
        """Scale that leaves inputs and outputs unchanged. `v = u`, `w = y`."""
        m = np.ones(inputs)
        p = np.ones(outputs)
        return cls(input_scale=m, output_scale=p, input_equilibrium=0 * m, output_equilibrium=0 * p)

    @property
    def inputs(self) -> int:
        """Number of inputs of the scaled system."""
        return len(self.input_scale)

    @property
    def outputs(self) -> int:
        """Number of outputs of the scaled system."""
        return len(self.output_scale)

    def scaled_input(self, u: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        """Convert an input from physical to scaled units."""
        return (u - self.input_equilibrium) / self.input_scale

    def physical_input(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch m"]:
        """Convert an input from scaled to physical units."""
        return self.input_equilibrium + self.input_scale * v

    def scaled_output(self, y: Float[np.ndarray, "*batch p"]) -> Float[np.ndarray, "*batch p"]:
        """Convert an output from physical to scaled units."""
        return (y - self.output_equilibrium) / self.output_scale

    @property
    def disturbances(self) -> int:
        """Number of measured disturbances of the scaled system."""
        return len(self.disturbance_scale)

    def scaled_disturbance(self, d: Float[np.ndarray, "*batch k"]) -> Float[np.ndarray, "*batch k"]:
        """Convert a measured disturbance from physical to scaled units."""
        return (d - self.disturbance_equilibrium) / self.disturbance_scale

    def with_disturbances_as_inputs(self) -> "Scale":
        """Scale of signals in which the measured disturbances count as further inputs."""
        return replace(
            self,
            input_scale=np.concatenate([self.input_scale, self.disturbance_scale]),
            input_equilibrium=np.concatenate(
                [self.input_equilibrium, self.disturbance_equilibrium]
            ),
            disturbance_scale=np.zeros(0),
            disturbance_equilibrium=np.zeros(0),
        )

    def physical_output(self, w: Float[np.ndarray, "*batch p"]) -> Float[np.ndarray, "*batch p"]:
        """Convert an output from scaled to physical units."""
        return self.output_equilibrium + self.output_scale * w

    def append_equilibrium_input(
        self, inputs: Iterable[Float[np.ndarray, "_ m"]]
    ) -> list[Float[np.ndarray, "_ m"]]:
        """Append the equilibrium input, as a record with one sample, to a list of input records."""
        return [*inputs, self.input_equilibrium[None]]


Trajectories = tuple[Trajectory, ...]
Limit = (
    float | Sequence[float] | None
)  # of every input, or one for each; None where it is not given
Ends = tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]


def input_limits(lower: Limit, upper: Limit, inputs: Sequence[Float[np.ndarray, "_ m"]]) -> Ends:
    """Lower and upper limit of each input, as given or else taken from the range of the recorded
    inputs. Raises `BadRequest` if their number differs from that of the inputs."""
    recorded = np.concatenate(inputs)
    limits = []
    for name, given_limit, end in (
        ("lower", lower, recorded.min(axis=0)),
        ("upper", upper, recorded.max(axis=0)),
    ):
        limit = end if given_limit is None else np.asarray(given_limit, dtype=float).reshape(-1)
        fits = len(limit) in (1, len(end))
        remedy = "give one for all, or one for each"
        require(fits, f"loop.input_{name}", given_limit, f"there are {len(end)} inputs", remedy)
        limits.append(np.broadcast_to(limit, end.shape).copy())
    return limits[0], limits[1]


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """Separate training, validation and test records of one system. The first `start_up_samples` of
    each are simulated but not scored.

    `mismatch_records` are for the mismatch alone (`robustness.mismatch`): no fit, no early stopping
    and no score uses them. `disturbances` are measured, and no actuator moves them.
    """

    training: Trajectories
    validation: Trajectories
    test: Trajectories
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    scale: Scale
    mismatch_records: Trajectories = ()
    start_up_samples: int = 0
    metadata: dict[str, str] = field(default_factory=dict)
    disturbances: tuple[Channel, ...] = ()

    @property
    def training_inputs(self) -> list[Float[np.ndarray, "_ m"]]:
        """Inputs of the training records, with the equilibrium input appended as a further
        record."""
        return self.scale.append_equilibrium_input(record.u for record in self.training)

    @property
    def step_s(self) -> float:
        """Sampling period of the records in seconds."""
        return self.training[0].step_s

    def with_disturbances_as_inputs(self) -> "DataSet":
        """Data set in which the measured disturbances count as further inputs."""
        if not self.disturbances:
            return self
        records = self._map_records(Trajectory.with_disturbances_as_inputs)
        return replace(
            self,
            **records,  # type: ignore[arg-type]  # fields of one type
            inputs=(*self.inputs, *self.disturbances),
            disturbances=(),
            scale=self.scale.with_disturbances_as_inputs(),
        )

    def _map_records(self, change: Callable[[Trajectory], Trajectory]) -> dict[str, Trajectories]:
        """Changed copies of the records of each part, by the name of the part."""
        parts = ("training", "validation", "test", "mismatch_records")
        return {part: tuple(map(change, getattr(self, part))) for part in parts}

    def with_one_output(self, number: int) -> "DataSet":
        """Data set of all inputs and one output, whose number counts from zero."""
        chosen = slice(number, number + 1)
        records = self._map_records(lambda record: replace(record, y=record.y[:, chosen]))
        output_scale = self.scale.output_scale[chosen]
        equilibrium = self.scale.output_equilibrium[chosen]
        scale = replace(self.scale, output_scale=output_scale, output_equilibrium=equilibrium)
        return replace(self, **records, outputs=self.outputs[chosen], scale=scale)  # type: ignore[arg-type]

    def shift_out_dead_time(self, samples: int) -> "DataSet":
        """Remove a dead time by pairing each output with the input from as many samples before.
        Measured disturbances act without it."""
        shortest = min(len(one) for one in (*self.training, *self.validation, *self.test))
        problem = f"the shortest record has {shortest} samples"
        remedy = "log longer records, or a shorter dead time"
        require(samples < shortest, "model.dead_time", samples, problem, remedy)

        def advance_outputs(records: Trajectories) -> Trajectories:
            """Copy of records in which each output is moved earlier by the dead time, to the sample
            of the input that causes it."""
            return tuple(
                replace(one[samples:], u=one.u[: len(one) - samples], first=one.first)
                for one in records
            )

        return replace(
            self,
            training=advance_outputs(self.training),
            validation=advance_outputs(self.validation),
            test=advance_outputs(self.test),
        )


def fit_percent(
    y: Float[np.ndarray, "T p"], y_hat: Float[np.ndarray, "T p"], start_up_samples: int = 0
) -> float:
    """Fit of a simulated output to the measured one, in percent. `100 (1 - ||y - y_hat|| / ||y -
    mean(y)||)`, Frobenius norms over all channels, after the start-up samples."""
    y = y[start_up_samples:]
    y_hat = y_hat[start_up_samples:]
    return fit_from_relative_error(np.linalg.norm(y - y_hat) / np.linalg.norm(y - y.mean(axis=0)))


def fit_from_relative_error(relative_error: float | np.floating) -> float:
    """Convert a relative error to a fit in percent, `100 (1 - relative error)`. The error is
    relative to the output's deviation from its mean."""
    return float(100.0 * (1.0 - relative_error))


def rmse(
    y: Float[np.ndarray, "T p"], y_hat: Float[np.ndarray, "T p"], start_up_samples: int = 0
) -> float:
    """Root mean square error of a simulated output, in the unit of the output. `sqrt(mean((y -
    y_hat)^2))` after the start-up samples."""
    return float(np.sqrt(np.mean((y[start_up_samples:] - y_hat[start_up_samples:]) ** 2)))
