"""One recorded experiment: which file, which columns, which clock, which samples."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.columns import Wanted, read_table
from ssm_study.data.sampling import mean_period_s, resampled, uniform_step_s
from ssm_study.data.table import Table
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, Trajectory

Names = str | list[str] | tuple[str, ...]


def listed(names: Names) -> tuple[str, ...]:
    """One name or several, as several."""
    return (names,) if isinstance(names, str) else tuple(names)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Columns `input` and `output` of the file at `path`, samples `first` to before `last`.

    The clock is `step_s`, or the column `time` (seconds; MCAP brings its own), or both, which must then agree.
    Samples off a uniform clock by more than `jitter_tolerance` periods are refused unless `resample` is true.
    `decimate` n keeps every n-th output and the mean input of the n samples from there on: what a hold would have
    applied. `differentiate` turns a position into the velocity `y[k] = (q[k] - q[k-1]) / step_s`, whose running sum
    times `step_s` is the position again, exactly; the first sample is spent on it.
    """

    path: str
    input: Names
    output: Names
    step_s: float | None = None
    time: str | None = None
    first: int = 0
    last: int | None = None
    input_unit: Names = ""
    output_unit: Names = ""
    jitter_tolerance: float = 0.05
    resample: bool = False
    decimate: int = 1
    differentiate: bool = False
    name: str = "recording"

    def __post_init__(self) -> None:
        step_s = self.step_s
        require(step_s is None or 0 < step_s < np.inf, "data.step_s", step_s, "must be positive", "give it in seconds")
        require(self.decimate >= 1, "data.decimate", self.decimate, "must be at least 1", "use 1 to keep every sample")
        require(self.first >= 0, "data.first", self.first, "must not be negative", "count samples from 0")
        require(
            0 <= self.jitter_tolerance < 1, "data.jitter_tolerance", self.jitter_tolerance, "not in [0, 1)", "use 0.05"
        )
        for field, names in (("data.input", self.input), ("data.output", self.output)):
            require(len(listed(names)) > 0 and all(listed(names)), field, names, "names no column", "name at least one")
        both = set(listed(self.input)) & set(listed(self.output))
        require(not both, "data.output", sorted(both), "is an input too", "name other columns")

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return _channels(self.input, self.input_unit, "data.input_unit")

    @property
    def outputs(self) -> tuple[Channel, ...]:
        """With `differentiate` the unit is the position's per second."""
        channels = _channels(self.output, self.output_unit, "data.output_unit")
        if not self.differentiate:
            return channels
        return tuple(Channel(name=f"{c.name}_rate", unit=f"{c.unit}/s") for c in channels)

    def read(self) -> Trajectory:
        """The experiment in physical units. Raises `BadRequest`, always in one sentence."""
        table = self._table()
        u = np.stack([table.columns[name] for name in listed(self.input)], axis=1)
        y = np.stack([table.columns[name] for name in listed(self.output)], axis=1)
        both, step_s = self._on_clock(table, np.concatenate([u, y], axis=1))
        both = self._cut(both)
        u, y = decimated(both[:, : u.shape[1]], both[:, u.shape[1] :], self.decimate)
        step_s *= self.decimate
        if self.differentiate:
            u, y = u[1:], np.diff(y, axis=0) / step_s
        return Trajectory(u=u, y=y, step_s=step_s, name=self.name)

    def _table(self) -> Table:
        names = [*listed(self.input), *listed(self.output)]
        units = [c.unit for c in self.inputs]
        units += [c.unit for c in _channels(self.output, self.output_unit, "data.output_unit")]
        if self.time is not None:
            names, units = [*names, self.time], [*units, "s"]
        return read_table(Path(self.path), Wanted(names=tuple(names), units=tuple(units)))

    def _on_clock(self, table: Table, values: Float[np.ndarray, "T c"]) -> tuple[Float[np.ndarray, "T2 c"], float]:
        time_s = table.time_s if self.time is None else table.columns[self.time]
        if time_s is None and self.step_s is None:
            raise BadRequest(
                "data.step_s", None, "the sampling time is unknown", "give it, or name the column data.time"
            )
        if time_s is None:
            return values, float(self.step_s or 0.0)
        where = Path(self.path).name
        if self.resample:
            step_s = mean_period_s(time_s, where) if self.step_s is None else self.step_s
            mean_period_s(time_s, where)
            return resampled(time_s, values, step_s), step_s
        return values, uniform_step_s(time_s, self.step_s, self.jitter_tolerance, where)

    def _cut(self, values: Float[np.ndarray, "T c"]) -> Float[np.ndarray, "T2 c"]:
        last = len(values) if self.last is None else self.last
        require(
            self.first < last <= len(values),
            "data.first, data.last",
            (self.first, last),
            f"no such samples, {Path(self.path).name} has {len(values)}",
            "count from 0",
        )
        kept = values[self.first : last]
        fewest = 2 * self.decimate + 1
        require(len(kept) >= fewest, "samples", len(kept), f"at least {fewest} are needed", "use a longer record")
        return kept


def decimated(
    u: Float[np.ndarray, "T m"], y: Float[np.ndarray, "T p"], every: int
) -> tuple[Float[np.ndarray, "T2 m"], Float[np.ndarray, "T2 p"]]:
    """Every n-th output, and the mean input of the samples from there to the next: what a hold would have applied."""
    periods = len(u) // every
    return u[: periods * every].reshape(periods, every, -1).mean(axis=1), y[: periods * every : every]


def _channels(names: Names, units: Names, field: str) -> tuple[Channel, ...]:
    columns, stated = listed(names), listed(units)
    stated = ("",) * len(columns) if stated == ("",) else stated
    require(len(stated) == len(columns), field, units, f"there are {len(columns)} columns", "give one unit per column")
    return tuple(Channel(name=_identifier(name), unit=unit) for name, unit in zip(columns, stated, strict=True))


def _identifier(column: str) -> str:
    """`Motor voltage (V)` becomes `Motor_voltage_V`: recordings store signals under names without other characters."""
    words = re.sub(r"[^0-9A-Za-z]+", "_", column).strip("_") or "signal"
    return f"signal_{words}" if words[0].isdigit() else words
