"""One recorded experiment: which file, which columns, which clock, which samples."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.clock import EvenRows, require_agreement, without_missing
from ssm_study.data.clock_column import (
    clock_seconds,
    counts_in_first_column,
    find_clock,
    refuse_backward_clock,
    refuse_clock_as_signal,
)
from ssm_study.data.clock_restarts import on_even_clocks
from ssm_study.data.plain_names import plain_name
from ssm_study.data.readers.reader import FOREIGN, Reader, Table, read_table, reader_for
from ssm_study.data.text_layout import TextSettings
from ssm_study.refusal import BadRequest, at_least, positive, require
from ssm_study.signals import Channel, Trajectory

Names = str | int | list[str] | list[int] | tuple[str, ...]
# Of a file without names whose first column counts the rows; the evidence then has a doubt.
ASSUMED_SECOND = "and a row is taken to last one second"
LOOK = "`ssm-study look {}` shows what is in the file"


def listed(names: Names) -> tuple[str, ...]:
    """Return one name as a list of one. One name or several, as several; a column without a name
    goes by its number."""
    return (str(names),) if isinstance(names, str | int) else tuple(map(str, names))


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Settings that read input and output signals from files. Columns `input` and `output` of a
    file, or of a file each, and the clock of their rows (docs/data.md).

    Without `time` the clock is found by its name, or as the nameless first column. `separator`,
    `decimal` and `header` state what is otherwise found in a text. `decimate` n keeps every n-th
    output and the mean input of the n samples from there on: what a hold would have applied.
    `differentiate` turns a position into the velocity `y[k] = (q[k] - q[k-1]) / step_s`, whose
    running sum times `step_s` is the position again, exactly; the first sample is spent on it.
    """

    input: Names
    output: Names
    step_s: float | None = None
    time: str | int | None = None
    input_unit: Names = ""
    output_unit: Names = ""
    separator: str | None = None
    decimal: str | None = None
    header: bool | None = None
    jitter_tolerance: float = 0.05
    resample: bool = False
    decimate: int = 1
    differentiate: bool = False

    def __post_init__(self) -> None:
        positive("data.step_s", self.step_s, "give it in seconds")
        at_least(1, "data.decimate", self.decimate, "use 1 to keep every sample")
        jitter = self.jitter_tolerance
        require(0 <= jitter < 1, "data.jitter_tolerance", jitter, "not in [0, 1)", "use 0.05")
        _ = self.text_settings  # refuses what is no separator or decimal mark
        for field, names in (("data.input", self.input), ("data.output", self.output)):
            asked = listed(names)
            named = len(asked) > 0 and all(asked)
            require(named, field, names, "names no column", "name at least one")
            twice = [name for name in asked if asked.count(name) > 1]
            require(not twice, field, twice[:1], "the same column twice", "name each column once")
            clock = self.time is not None and str(self.time) in asked
            require(not clock, field, self.time, "is the clock (data.time)", "name a signal")
        both = set(listed(self.input)) & set(listed(self.output))
        remedy = "name other columns, or data.output_path"
        require(self.apart or not both, "data.output", sorted(both), "is an input too", remedy)

    @property
    def text_settings(self) -> TextSettings:
        """Settings of the layout of a text file that the configuration states."""
        return TextSettings(separator=self.separator, decimal=self.decimal, header=self.header)

    @property
    def apart(self) -> bool:
        """Whether the outputs are in files of their own."""
        return False

    @property
    def searches_clock(self) -> bool:
        """Whether an unnamed clock is looked for among the columns."""
        return True

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return read_channels(self.input, self.input_unit, "input", self.apart)

    @property
    def measured(self) -> tuple[Channel, ...]:
        """Channels that are read from the files. They are the `outputs`, unless `differentiate`
        makes those rates, in the unit per second."""
        return read_channels(self.output, self.output_unit, "output", self.apart)

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
        """Read the samples `first` to before `last`, in physical units. Outputs come from
        `output_path` where it is given.

        Raises `BadRequest`, always in one sentence; also for a log with holes, which is several.
        """
        pieces, remark = self.read_pieces(path, output_path, first=first, last=last)
        remedy = "cut the file there, or name it data.path alone"
        one = len(pieces) == 1
        require(one, f"{path.name} (pieces)", len(pieces), f"{remark}: not one record", remedy)
        return replace(pieces[0], first=0)

    def read_pieces(
        self,
        path: Path,
        output_path: Path | None = None,
        *,
        first: int = 0,
        last: int | None = None,
    ) -> tuple[list[Trajectory], str]:
        """Read the stretches of a log between its holes and missing values, and say how it was
        read.

        Each piece says at which sample of the log it begins. A refusal of what the file holds ends
        with the command that shows it.
        """
        try:
            pieces, remarks = self._on_clock(path, output_path or path)
        except BadRequest as error:
            raise refusal_with_look_command(error, path) from error
        whole = range(first, pieces_end(pieces) if last is None else last)
        problem = f"no such samples, {path.name} has {pieces_end(pieces)}"
        inside = first < whole.stop <= pieces_end(pieces)
        require(inside, "data.first, data.last", (first, whole.stop), problem, "count from 0")
        records = []
        for values, start in zip(pieces.values, pieces.starts, strict=True):
            a = max(whole.start - start, 0)
            b = min(whole.stop - start, len(values))
            enough = b - a >= 2 * self.decimate + 1
            if enough or len(pieces.values) == 1:
                at_least(2 * self.decimate + 1, "samples", b - a, "use a longer record")
                at = (start + a) // self.decimate
                records.append(replace(self._record(values[a:b], pieces.step_s, path), first=at))
        require(records, "samples", 0, "no stretch without holes is long enough", "log on")
        return records, "; ".join(remarks)

    def _record(self, values: Float[np.ndarray, "T c"], period_s: float, path: Path) -> Trajectory:
        """Construct one experiment from rows on an even clock, decimated and differentiated."""
        u, y = np.split(values, [len(self.inputs)], axis=1)
        u, y = decimated(u, y, self.decimate)
        step_s = period_s * self.decimate
        if self.differentiate:
            u = u[1:]
            y = np.diff(y, axis=0) / step_s
        return Trajectory(u=u, y=y, step_s=step_s, name=path.name)

    def _on_clock(self, path: Path, output_path: Path) -> tuple[EvenRows, list[str]]:
        """Put the rows on an even clock, and say how the files were read."""
        time_s, stated_s, values, remarks = self._read(path, output_path)
        if time_s is None:
            period_s = stated_s if self.step_s is None else self.step_s
            if period_s is None:
                problem = "the sampling time is unknown"
                remedy = "give it, or name the column data.time"
                raise BadRequest("data.step_s", None, problem, remedy)
            if stated_s is not None:
                require_agreement(self.step_s, stated_s, path.name)
            rows = EvenRows(values=[values], starts=[0], step_s=period_s, remarks=[])
            pieces = without_missing(rows)
        else:
            pieces = on_even_clocks(
                time_s,
                values,
                len(self.inputs),
                path.name,
                step_s=self.step_s,
                tolerance=self.jitter_tolerance,
                resample=self.resample,
            )
        require(pieces.values, path.name, 0, "no row has all its values", "name other columns")
        period = f"step {pieces.step_s:.6g} s"
        return pieces, [*remarks, period, *pieces.remarks]

    def _read(
        self, path: Path, output_path: Path
    ) -> tuple[Float[np.ndarray, "T"] | None, float | None, Float[np.ndarray, "T2 c"], list[str]]:
        """Read times, the sampling time that a file states, inputs beside outputs, and remarks. The
        rows of two files must go together."""
        sides = [
            (path, listed(self.input), self.inputs),
            (output_path, listed(self.output), self.measured),
        ]
        wanted: dict[Path, dict[str, str]] = {}
        for file, names, channels in sides:
            units = dict(zip(names, (c.unit for c in channels), strict=True))
            wanted.setdefault(file, {}).update(units)
        logs = {file: self._read_one(file, units) for file, units in wanted.items()}
        columns = []
        for file, names, _ in sides:
            table = logs[file].table
            columns.append(np.stack([table.columns[name] for name in names], axis=1))
        u, y = columns
        problem = f"has {len(y)} rows, {path.name} {len(u)}"
        remedy = "cut them alike"
        require(len(u) == len(y), "data.output_path", output_path, problem, remedy)
        times = [log.time_s for log in logs.values() if log.time_s is not None]
        tables = [log.table for log in logs.values()]
        if len(logs) > 1 and times:
            self._refuse_apart(times, tables, output_path, len(u))
        remarks = [remark for log in logs.values() for remark in log.remarks]
        stated_s = next((table.step_s for table in tables if table.step_s), None)
        return times[0] if times else None, stated_s, np.hstack([u, y]), remarks

    def _refuse_apart(
        self, times: list[np.ndarray], tables: list[Table], output_path: Path, rows: int
    ) -> None:
        """Refuse two files whose rows are not at the same times."""
        recordings = any(table.time_s is not None for table in tables) and self.time is None
        problem = "log times count from each recording's own start"
        remedy = "put both signals into one recording"
        require(not recordings, "data.output_path", output_path, problem, remedy)
        if len(times) < 2:
            return
        late_s = float(np.nanmax(np.abs(times[0] - times[1])))
        problem = f"its rows are up to {late_s:.3g} s away from those of the inputs"
        close = late_s <= self.jitter_tolerance * np.ptp(times[0]) / rows
        require(close, "data.output_path", output_path, problem, "log both on one clock")

    def _read_one(self, file: Path, units: dict[str, str]) -> "_LogFile":
        """Read the columns of one file that are wanted of it, and its clock."""
        reader = reader_for(file, self.text_settings)
        wanted = dict(units)
        if self.time is not None:
            wanted[str(self.time)] = ""
        table = read_table(file, wanted, missing=True, reader=reader)
        remarks = [f"{file.name}: {table.remark}"] if table.remark else []
        refuse_equal_columns(table, list(units), file)
        time_s = table.time_s
        if self.time is not None:
            is_stated = self.step_s is not None
            time_s, words = clock_seconds(str(self.time), table, is_stated=is_stated)
            remarks.append(words)
        elif time_s is None and self.searches_clock:
            time_s, clock_remarks = self._found_clock(file, reader, table, list(units))
            remarks += clock_remarks
        return _LogFile(table=table, time_s=time_s, remarks=remarks)

    def _found_clock(
        self, file: Path, reader: Reader, table: Table, signals: list[str]
    ) -> tuple[Float[np.ndarray, "T"] | None, list[str]]:
        """Times of the clock that is recognised by its name or place, and which column it is."""
        try:
            contents = reader.contents(file)
        except BadRequest:
            return None, []  # a format that lists no columns
        length = len(table.columns[signals[0]])
        own = [table.columns[name] for name in signals]
        taken = [title for title, values in contents.columns.items() if is_among(values, own)]
        refuse_clock_as_signal(contents, taken, file)
        title = find_clock(contents, taken)
        if title is None or len(contents.columns[title]) != length:
            refuse_backward_clock(contents, taken, file, is_stated=self.step_s is not None)
            return self._counted_rows(contents, length)
        time_s, words = clock_seconds(title, contents, is_stated=self.step_s is not None)
        return time_s, [words]

    def _counted_rows(
        self, contents: Table, length: int
    ) -> tuple[Float[np.ndarray, "T"] | None, list[str]]:
        """Times of a log whose first column counts the rows. They are in seconds in a file without
        names (which the evidence doubts), none where the sampling time is given; refused
        otherwise."""
        if not counts_in_first_column(contents):
            return None, []
        if self.step_s is not None:
            return None, ["the first column counts rows"]
        title, times = next(iter(contents.columns.items()))
        remedy = "give it in seconds (data.time=0 if a row lasts one second)"
        problem = "the first column counts the rows, and how long a row lasts is unknown"
        bare = contents.nameless and len(times) == length
        require(bare, "data.step_s", None, problem, remedy)
        return times, [f"column {title} counts the rows, {ASSUMED_SECOND}"]


@dataclass(frozen=True, kw_only=True)
class _LogFile:
    """The wanted columns of one file, its clock in seconds, and how it was read."""

    table: Table
    time_s: Float[np.ndarray, "T"] | None
    remarks: list[str]


def pieces_end(pieces: EvenRows) -> int:
    """Number of samples of the log up to the end of its last piece."""
    return pieces.starts[-1] + len(pieces.values[-1])


def refusal_with_look_command(error: BadRequest, path: Path) -> BadRequest:
    """Add to a refusal the command that shows what is in the file."""
    remedy = error.remedy.rstrip(".")
    is_foreign = path.suffix.lower() in FOREIGN  # look does not read it either
    if "look" in remedy or is_foreign or not path.is_file():
        return error
    return BadRequest(error.field, error.value, error.problem, f"{remedy}; {LOOK.format(path)}")


def refuse_equal_columns(table: Table, signals: list[str], file: Path) -> None:
    """Refuse two signals that are read from one column under two names, or hold the same
    numbers."""
    for k, name in enumerate(signals):
        for other in signals[:k]:
            equal = np.array_equal(table.columns[name], table.columns[other], equal_nan=True)
            problem = f"holds the numbers of column {other}"
            remedy = "name another column for one of them"
            moves = float(np.nanstd(table.columns[name])) > 0
            require(not (equal and moves), f"{file.name}, column {name}", name, problem, remedy)


@dataclass(frozen=True, kw_only=True)
class Recording(Columns):
    """One experiment to be read from a file. Samples `first` to before `last` of the columns of
    the file at `path`."""

    path: str
    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(0, "data.first", self.first, "count samples from 0")

    @property
    def searches_clock(self) -> bool:
        return self.step_s is None

    def read(self) -> Trajectory:
        """Read the experiment in physical units. Refuses what `read_from` refuses."""
        return self.read_from(Path(self.path), first=self.first, last=self.last)


def is_among(values: Float[np.ndarray, "T"], columns: list[np.ndarray]) -> bool:
    """Whether a column holds the same numbers as one of several columns."""
    return any(np.array_equal(values, column, equal_nan=True) for column in columns)


def decimated(
    u: Float[np.ndarray, "T m"], y: Float[np.ndarray, "T p"], every: int
) -> tuple[Float[np.ndarray, "T2 m"], Float[np.ndarray, "T2 p"]]:
    """Decimate a record by taking every n-th output, with the mean input of the samples from there
    to the next. A hold would have applied that mean."""
    periods = len(u) // every
    blocks = u[: periods * every].reshape(periods, every, -1)
    return blocks.mean(axis=1), y[: periods * every : every]


def read_channels(names: Names, units: Names, side: str, apart: bool) -> tuple[Channel, ...]:
    """Name the channels of a recording. Recordings store signals under plain names: `Motor voltage
    (V)` becomes `Motor_voltage_V`.

    A number says which side it is of, `input_0`; so does every name of files apart, where two may
    be equal.
    """
    columns = listed(names)
    stated = listed(units)
    stated = ("",) * len(columns) if stated == ("",) else stated
    problem = f"there are {len(columns)} columns"
    remedy = "give one unit per column"
    require(len(stated) == len(columns), f"data.{side}_unit", units, problem, remedy)
    plain = [plain_name(column) for column in columns]
    twice = next((name for name in plain if plain.count(name) > 1), "")
    problem = f"two of them would be called {twice}"
    require(not twice, f"data.{side}", ", ".join(columns), problem, "rename a column of the log")
    plain = [f"{side}_{words}" if apart or words[0].isdigit() else words for words in plain]
    return tuple(Channel(name=name, unit=unit) for name, unit in zip(plain, stated, strict=True))
