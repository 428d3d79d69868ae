"""One recorded experiment: which file, which columns, which clock, which samples."""

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.readers.reader import read_table
from ssm_study.refusal import BadRequest, at_least, positive, require
from ssm_study.signals import Channel, Trajectory

Names = str | int | list[str] | list[int] | tuple[str, ...]
AGREEMENT = (
    1e-3  # relative difference allowed between the claimed sampling time and the one the times show
)


def listed(names: Names) -> tuple[str, ...]:
    """One name or several, as several; a column without a name goes by its number."""
    return (str(names),) if isinstance(names, str | int) else tuple(map(str, names))


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns `input` and `output` of a file, or of a file each, and the clock of their rows
    (docs/data.md).

    `decimate` n keeps every n-th output and the mean input of the n samples from there on: what a
    hold would have
    applied. `differentiate` turns a position into the velocity `y[k] = (q[k] - q[k-1]) / step_s`,
    whose running sum
    times `step_s` is the position again, exactly; the first sample is spent on it.
    """

    input: Names
    output: Names
    step_s: float | None = None
    time: str | int | None = None
    input_unit: Names = ""
    output_unit: Names = ""
    jitter_tolerance: float = 0.05
    resample: bool = False
    decimate: int = 1
    differentiate: bool = False

    def __post_init__(self) -> None:
        positive("data.step_s", self.step_s, "give it in seconds")
        at_least(1, "data.decimate", self.decimate, "use 1 to keep every sample")
        jitter = self.jitter_tolerance
        require(0 <= jitter < 1, "data.jitter_tolerance", jitter, "not in [0, 1)", "use 0.05")
        for field, names in (("data.input", self.input), ("data.output", self.output)):
            require(
                len(listed(names)) > 0 and all(listed(names)),
                field,
                names,
                "names no column",
                "name at least one",
            )
        both = set(listed(self.input)) & set(listed(self.output))
        remedy = "name other columns, or data.output_path"
        require(self.apart or not both, "data.output", sorted(both), "is an input too", remedy)

    @property
    def apart(self) -> bool:
        """Whether the outputs stand in files of their own."""
        return False

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return _channels(self.input, self.input_unit, "input", self.apart)

    @property
    def measured(self) -> tuple[Channel, ...]:
        """What stands in the files; the `outputs` unless `differentiate` makes them rates, in the
        unit per second."""
        return _channels(self.output, self.output_unit, "output", self.apart)

    @property
    def outputs(self) -> tuple[Channel, ...]:
        rates = tuple(Channel(name=f"{c.name}_rate", unit=f"{c.unit}/s") for c in self.measured)
        return rates if self.differentiate else self.measured

    def read_from(
        self,
        path: Path,
        output_path: Path | None = None,
        *,
        first: int = 0,
        last: int | None = None,
    ) -> Trajectory:
        """Samples `first` to before `last`, in physical units, outputs from `output_path` where it
        is given.

        Raises `BadRequest`, always in one sentence.
        """
        time_s, u, y = self._read(path, output_path or path)
        values, step_s = self._on_clock(time_s, np.hstack([u, y]), path.name)
        end, problem = (
            len(values) if last is None else last,
            f"no such samples, {path.name} has {len(values)}",
        )
        require(
            first < end <= len(values),
            "data.first, data.last",
            (first, end),
            problem,
            "count from 0",
        )
        at_least(2 * self.decimate + 1, "samples", end - first, "use a longer record")
        u, y = np.split(values[first:end], [len(self.inputs)], axis=1)
        u, y = decimated(u, y, self.decimate)
        step_s *= self.decimate
        if self.differentiate:
            u, y = u[1:], np.diff(y, axis=0) / step_s
        return Trajectory(u=u, y=y, step_s=step_s, name=path.name)

    def _read(
        self, path: Path, output_path: Path
    ) -> tuple[Float[np.ndarray, "T"] | None, Float[np.ndarray, "T2 m"], Float[np.ndarray, "T2 p"]]:
        """Times, inputs and outputs; each file is read once, and the rows of two must go
        together."""
        sides = [
            (path, listed(self.input), self.inputs),
            (output_path, listed(self.output), self.measured),
        ]
        wanted: dict[Path, dict[str, str]] = {}
        for file, names, channels in sides:
            clock = {} if self.time is None else {str(self.time): "s"}
            wanted.setdefault(file, clock).update(
                zip(names, (c.unit for c in channels), strict=True)
            )
        tables = {file: read_table(file, units) for file, units in wanted.items()}
        u, y = (
            np.stack([tables[file].columns[name] for name in names], axis=1)
            for file, names, _ in sides
        )
        found = [
            t.time_s if self.time is None else t.columns[str(self.time)] for t in tables.values()
        ]
        times = [time_s for time_s in found if time_s is not None]
        problem, remedy = f"has {len(y)} rows, {path.name} {len(u)}", "cut them alike"
        require(len(u) == len(y), "data.output_path", output_path, problem, remedy)
        if len(tables) > 1 and times:
            problem, remedy = (
                "log times count from each recording's own start",
                "put both signals into one recording",
            )
            require(self.time is not None, "data.output_path", output_path, problem, remedy)
            late_s = float(np.abs(times[0] - times[1]).max())
            problem = f"its rows are up to {late_s:.3g} s away from those of the inputs"
            close = late_s <= self.jitter_tolerance * np.ptp(times[0]) / len(u)
            require(close, "data.output_path", output_path, problem, "log both on one clock")
        return times[0] if times else None, u, y

    def _on_clock(
        self, time_s: Float[np.ndarray, "T"] | None, values: Float[np.ndarray, "T c"], where: str
    ) -> tuple[Float[np.ndarray, "T2 c"], float]:
        """The rows on a uniform clock, and its period."""
        if time_s is None:
            if self.step_s is None:
                problem, remedy = (
                    "the sampling time is unknown",
                    "give it, or name the column data.time",
                )
                raise BadRequest("data.step_s", None, problem, remedy)
            return values, self.step_s
        mean_s = mean_period_s(time_s, np.inf if self.resample else self.jitter_tolerance, where)
        if not self.resample:
            agrees = self.step_s is None or abs(self.step_s - mean_s) <= AGREEMENT * mean_s
            remedy = "correct one of them (units?), or leave step_s null"
            require(
                agrees,
                "data.step_s",
                self.step_s,
                f"the times of {where} show {mean_s:.6g} s",
                remedy,
            )
            return values, mean_s if self.step_s is None else self.step_s
        step_s = mean_s if self.step_s is None else self.step_s
        # Half a rounding error more than the last period, so that a whole number of periods gives
        # all its samples.
        clock = time_s[0] + step_s * np.arange(int((time_s[-1] - time_s[0]) / step_s + 1e-9) + 1)
        return np.stack([np.interp(clock, time_s, column) for column in values.T], axis=1), step_s


@dataclass(frozen=True, kw_only=True)
class Recording(Columns):
    """Samples `first` to before `last` of the columns of the file at `path`."""

    path: str
    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(0, "data.first", self.first, "count samples from 0")

    def read(self) -> Trajectory:
        """The experiment in physical units; refuses as `read_from`."""
        return self.read_from(Path(self.path), first=self.first, last=self.last)


def mean_period_s(time_s: Float[np.ndarray, "T"], tolerance: float, where: str) -> float:
    """Of times that increase and lie within `tolerance` periods of where their mean clock puts
    them; refuses others."""
    at_least(2, f"{where} (time)", len(time_s), "use a longer record")
    k = int(np.argmax(np.diff(time_s) <= 0)) + 1
    problem = f"sample {k} is not later than the one before"
    require(time_s[k] > time_s[k - 1], f"{where} (time)", time_s[k], problem, "sort the record")
    mean_s = float((time_s[-1] - time_s[0]) / (len(time_s) - 1))
    late = np.abs(time_s - time_s[0] - mean_s * np.arange(len(time_s))) / mean_s
    worst = int(np.argmax(late))
    problem = f"sample {worst} is {late[worst]:.2g} periods off a uniform clock, and {tolerance:g} is tolerated"
    remedy = (
        "set data.resample=true to interpolate onto a uniform clock, or raise data.jitter_tolerance"
    )
    require(late[worst] <= tolerance, f"{where} (time)", time_s[worst], problem, remedy)
    return mean_s


def decimated(
    u: Float[np.ndarray, "T m"], y: Float[np.ndarray, "T p"], every: int
) -> tuple[Float[np.ndarray, "T2 m"], Float[np.ndarray, "T2 p"]]:
    """Every n-th output, and the mean input of the samples from there to the next: what a hold
    would have applied."""
    periods = len(u) // every
    return u[: periods * every].reshape(periods, every, -1).mean(axis=1), y[
        : periods * every : every
    ]


def plain_name(column: str) -> str:
    """`Motor voltage (V)` becomes `Motor_voltage_V`, `ω` becomes `omega`."""
    letters = unicodedata.normalize("NFKD", column)
    spelled = "".join(_spelled(letter) for letter in letters)
    return re.sub(r"[^0-9A-Za-z]+", "_", spelled).strip("_") or "signal"


def _spelled(letter: str) -> str:
    """`ω` -> `omega`, `Ω` -> `Omega`, `°` -> `deg`; another letter stays."""
    if letter == "\N{DEGREE SIGN}":
        return "deg"
    name = re.match(r"GREEK (SMALL|CAPITAL) LETTER (FINAL )?([A-Z]+)", unicodedata.name(letter, ""))
    if name is None:
        return letter
    word = name[3].lower()
    return word if name[1] == "SMALL" else word.title()


def _channels(names: Names, units: Names, side: str, apart: bool) -> tuple[Channel, ...]:
    """Recordings store signals under plain names: `Motor voltage (V)` becomes `Motor_voltage_V`.

    A number says which side it is of, `input_0`; so does every name of files apart, where two may
    be equal.
    """
    columns, stated = listed(names), listed(units)
    stated = ("",) * len(columns) if stated == ("",) else stated
    problem, remedy = f"there are {len(columns)} columns", "give one unit per column"
    require(len(stated) == len(columns), f"data.{side}_unit", units, problem, remedy)
    plain = [plain_name(column) for column in columns]
    twice = next((name for name in plain if plain.count(name) > 1), "")
    problem = f"two of them would be called {twice}"
    require(not twice, f"data.{side}", ", ".join(columns), problem, "rename a column of the log")
    plain = [f"{side}_{words}" if apart or words[0].isdigit() else words for words in plain]
    return tuple(Channel(name=name, unit=unit) for name, unit in zip(plain, stated, strict=True))
