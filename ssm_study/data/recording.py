"""Reading of one recorded experiment from the columns and a range of samples of a file."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.channel_names import Names, as_name_tuple, name_channels
from ssm_study.data.clock import (
    EvenlySpacedRows,
    count_log_samples,
    cut_pieces_at_missing_values,
    require_equal_period,
)
from ssm_study.data.clock_column import (
    clock_column_seconds,
    find_clock_column,
    has_row_number_column,
    refuse_backward_clock,
    refuse_clock_as_signal,
    unreadable_clock_remarks,
    unreadable_clock_sentence,
)
from ssm_study.data.clock_restarts import resample_experiments
from ssm_study.data.log_refusals import add_look_command_to_error, missing_values_error
from ssm_study.data.missing_codes import missing_code_remarks
from ssm_study.data.readers.reader import (
    Reader,
    Table,
    choose_reader,
    read_table,
    refuse_equal_columns,
)
from ssm_study.data.text_layout import TextSettings
from ssm_study.refusal import BadRequest, require, require_at_least, require_positive
from ssm_study.signals import Channel, Trajectory

ClockTimes = Float[np.ndarray, "T"]

# Of a file without names whose first column counts the rows; the evidence then has a doubt.
ASSUMED_SECOND = "and a row is taken to last one second"


@dataclass(frozen=True, kw_only=True)
class ColumnSettings:
    """Base class of settings that state which columns of a log file are inputs, outputs and times.

    Without `time` the clock is found by its name, or as the nameless first column. `separator`,
    `decimal` and `header` state what is otherwise found in a text. `decimate` n keeps every n-th
    output and the mean input of the n samples from there on: what a hold would have applied.
    `differentiate` turns a position into the velocity `y[k] = (q[k] - q[k-1]) / step_s`, whose
    running sum times `step_s` is the position again, exactly; the first sample is used up by it.
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
        require_positive("data.step_s", self.step_s, "give it in seconds")
        require_at_least(1, "data.decimate", self.decimate, "use 1 to keep every sample")
        jitter = self.jitter_tolerance
        problem = "not in [0, 1)"
        require(0 <= jitter < 1, "data.jitter_tolerance", jitter, problem, "use 0.05")
        _ = self.text_settings  # refuses what is no separator or decimal mark
        self._check_columns("data.input", self.input)
        self._check_columns("data.output", self.output)
        inputs = set(as_name_tuple(self.input))
        both = inputs & set(as_name_tuple(self.output))
        are_apart = self.has_output_files or not both
        remedy = "name other columns, or data.output_path"
        require(are_apart, "data.output", sorted(both), "is an input too", remedy)

    def _check_columns(self, field: str, names: Names) -> None:
        """Raise `BadRequest` for input or output names that are empty, repeated, or the name of the
        time column."""
        columns = as_name_tuple(names)
        is_named = len(columns) > 0 and all(columns)
        require(is_named, field, names, "names no column", "name at least one")
        twice = [name for name in columns if columns.count(name) > 1]
        problem = "the same column twice"
        require(not twice, field, twice[:1], problem, "name each column once")
        is_clock = self.time is not None and str(self.time) in columns
        problem = "is the clock (data.time)"
        require(not is_clock, field, self.time, problem, "name a signal")

    @property
    def text_settings(self) -> TextSettings:
        """Format of a text file (separator, decimal mark, header), as far as the configuration
        states it."""
        return TextSettings(separator=self.separator, decimal=self.decimal, header=self.header)

    @property
    def has_output_files(self) -> bool:
        """Whether the outputs of an experiment are in files of their own."""
        return False

    @property
    def searches_clock(self) -> bool:
        """Whether the time column of a log must be detected because the configuration names
        none."""
        return True

    @property
    def inputs(self) -> tuple[Channel, ...]:
        """Names and units of the input channels of a recording."""
        return name_channels(self.input, self.input_unit, "input", self.has_output_files)

    @property
    def measured_outputs(self) -> tuple[Channel, ...]:
        """Names and units of the outputs as measured, before any differentiation. With
        `differentiate`, `outputs` are their rates."""
        return name_channels(self.output, self.output_unit, "output", self.has_output_files)

    @property
    def outputs(self) -> tuple[Channel, ...]:
        """Names and units of the outputs of the data set, after differentiation if that is
        requested."""
        if not self.differentiate:
            return self.measured_outputs
        rates = []
        for channel in self.measured_outputs:
            rates.append(Channel(name=f"{channel.name}_rate", unit=f"{channel.unit}/s"))
        return tuple(rates)

    def read_record(
        self,
        path: Path,
        output_path: Path | None = None,
        *,
        first: int = 0,
        last: int | None = None,
    ) -> Trajectory:
        """Read a range of samples of a log file as one record in physical units. Outputs come from
        `output_path` where it is given.

        Raises `BadRequest`, also for a log with gaps, which consists of several records.
        """
        pieces, remark = self.read_pieces(path, output_path, first=first, last=last)
        remedy = "cut the file there, or name it data.path alone"
        is_single_piece = len(pieces) == 1
        problem = f"it is several records with gaps between them ({remark})"
        require(is_single_piece, f"{path.name} (pieces)", len(pieces), problem, remedy)
        return replace(pieces[0], first=0)

    def read_pieces(
        self,
        path: Path,
        output_path: Path | None = None,
        *,
        first: int = 0,
        last: int | None = None,
    ) -> tuple[list[Trajectory], str]:
        """Read a log file as records between its gaps and missing values, and describe how it was
        read.

        Each piece says at which sample of the log it begins. A refusal of what the file holds ends
        with the command that shows it.
        """
        try:
            pieces, remarks = self._read_evenly_spaced_rows(path, output_path or path)
        except BadRequest as error:
            raise add_look_command_to_error(error, path) from error
        whole = range(first, count_log_samples(pieces) if last is None else last)
        problem = f"no such samples, {path.name} has {count_log_samples(pieces)}"
        inside = first < whole.stop <= count_log_samples(pieces)
        remedy = "count from 0"
        require(inside, "data.first, data.last", (first, whole.stop), problem, remedy)
        records = []
        for values, start in zip(pieces.values, pieces.starts, strict=True):
            a = max(whole.start - start, 0)
            b = min(whole.stop - start, len(values))
            enough = b - a >= 2 * self.decimate + 1
            if enough or len(pieces.values) == 1:
                require_at_least(2 * self.decimate + 1, "samples", b - a, "use a longer record")
                record = self._build_record(values[a:b], pieces.step_s, path)
                at = (start + a) // self.decimate
                records.append(replace(record, first=at))
        remedy = "record for longer, without interruptions"
        require(records, "samples", 0, "no stretch without holes is long enough", remedy)
        return records, "; ".join(remarks)

    def _build_record(
        self, values: Float[np.ndarray, "T c"], period_s: float, path: Path
    ) -> Trajectory:
        """Build a record from evenly spaced samples, decimated and differentiated if requested."""
        u, y = np.split(values, [len(self.inputs)], axis=1)
        u, y = decimate_record(u, y, self.decimate)
        step_s = period_s * self.decimate
        if self.differentiate:
            u = u[1:]
            y = np.diff(y, axis=0) / step_s
        return Trajectory(u=u, y=y, step_s=step_s, name=path.name)

    def _read_evenly_spaced_rows(
        self, path: Path, output_path: Path
    ) -> tuple[EvenlySpacedRows, list[str]]:
        """Read a log file as samples at evenly spaced times, and describe how it was read."""
        time_s, stated_s, values, remarks = self._read_columns(path, output_path)
        if time_s is None:
            period_s = stated_s if self.step_s is None else self.step_s
            if period_s is None:
                problem = "the sampling time is unknown" + unreadable_clock_sentence(remarks)
                remedy = "give it in seconds, or set data.time to the column of times"
                raise BadRequest("data.step_s", None, problem, remedy)
            if stated_s is not None:
                require_equal_period(self.step_s, stated_s, path.name)
            rows = EvenlySpacedRows(values=[values], starts=[0], step_s=period_s, remarks=[])
            pieces = cut_pieces_at_missing_values(rows)
        else:
            pieces = resample_experiments(
                time_s,
                values,
                len(self.inputs),
                path.name,
                step_s=self.step_s,
                tolerance=self.jitter_tolerance,
                resample=self.resample,
            )
        if not pieces.values:
            raise missing_values_error(path, values, [*self.inputs, *self.measured_outputs])
        period = f"step {pieces.step_s:.6g} s"
        return pieces, [*remarks, period, *pieces.remarks]

    def _read_columns(
        self, path: Path, output_path: Path
    ) -> tuple[ClockTimes | None, float | None, Float[np.ndarray, "T2 c"], list[str]]:
        """Read the signals and times of a log from its input and output files, with remarks on the
        reading. Rows of two files must belong together."""
        sides = [
            (path, as_name_tuple(self.input), self.inputs),
            (output_path, as_name_tuple(self.output), self.measured_outputs),
        ]
        wanted_columns: dict[Path, dict[str, str]] = {}
        for file, names, channels in sides:
            units = [channel.unit for channel in channels]
            named = dict(zip(names, units, strict=True))
            wanted_columns.setdefault(file, {}).update(named)
        logs = {file: self._read_file(file, units) for file, units in wanted_columns.items()}
        columns = []
        for file, names, _ in sides:
            table = logs[file].table
            own = [table.columns[name] for name in names]
            columns.append(np.stack(own, axis=1))
        u, y = columns
        problem = f"has {len(y)} rows, {path.name} {len(u)}"
        remedy = "cut them to the same length"
        require(len(u) == len(y), "data.output_path", output_path, problem, remedy)
        times = [log.time_s for log in logs.values() if log.time_s is not None]
        tables = [log.table for log in logs.values()]
        if len(logs) > 1 and times:
            self._refuse_unequal_times(times, tables, output_path, len(u))
        remarks = [remark for log in logs.values() for remark in log.remarks]
        stated_s = next((table.step_s for table in tables if table.step_s), None)
        time_s = times[0] if times else None
        return time_s, stated_s, np.hstack([u, y]), remarks

    def _refuse_unequal_times(
        self, times: list[np.ndarray], tables: list[Table], output_path: Path, rows: int
    ) -> None:
        """Raise `BadRequest` for an input file and an output file whose rows have different
        times."""
        recordings = any(table.time_s is not None for table in tables) and self.time is None
        problem = "log times count from each recording's own start"
        remedy = "put both signals into one recording"
        require(not recordings, "data.output_path", output_path, problem, remedy)
        if len(times) < 2:
            return
        differences = np.abs(times[0] - times[1])
        late_s = float(np.nanmax(differences))
        problem = f"its rows are up to {late_s:.3g} s away from those of the inputs"
        close = late_s <= self.jitter_tolerance * np.ptp(times[0]) / rows
        require(close, "data.output_path", output_path, problem, "log both on one clock")

    def _read_file(self, file: Path, units: dict[str, str]) -> "_LogFile":
        """Read the requested signals and the times from one log file."""
        reader = choose_reader(file, self.text_settings)
        wanted_columns = dict(units)
        if self.time is not None:
            wanted_columns[str(self.time)] = ""
        table = read_table(file, wanted_columns, missing=True, reader=reader)
        remarks = [f"{file.name}: {table.remark}"] if table.remark else []
        remarks += missing_code_remarks(table, list(units))
        refuse_equal_columns(table, list(units), file)
        time_s = table.time_s
        if self.time is not None:
            is_stated = self.step_s is not None
            time_s, words = clock_column_seconds(str(self.time), table, is_stated=is_stated)
            remarks.append(words)
        elif time_s is None and self.searches_clock:
            time_s, clock_remarks = self._find_clock(file, reader, table, list(units))
            remarks += clock_remarks
        return _LogFile(table=table, time_s=time_s, remarks=remarks)

    def _find_clock(
        self, file: Path, reader: Reader, table: Table, signals: list[str]
    ) -> tuple[ClockTimes | None, list[str]]:
        """Find the column of a log file that contains the times, by its title or place, and name
        the column in words."""
        try:
            contents = reader.read_all_columns(file)
        except BadRequest:
            return None, []  # a format that lists no columns
        length = len(table.columns[signals[0]])
        own = [table.columns[name] for name in signals]
        columns = contents.columns.items()
        signal_titles = [title for title, values in columns if equals_any_column(values, own)]
        refuse_clock_as_signal(contents, signal_titles, file)
        title = find_clock_column(contents, signal_titles)
        if title is None or len(contents.columns[title]) != length:
            refuse_backward_clock(contents, signal_titles, file, is_stated=self.step_s is not None)
            time_s, remarks = self._times_from_row_numbers(contents, length)
            return time_s, [*remarks, *unreadable_clock_remarks(contents)]
        time_s, words = clock_column_seconds(title, contents, is_stated=self.step_s is not None)
        return time_s, [words]

    def _times_from_row_numbers(
        self, contents: Table, length: int
    ) -> tuple[ClockTimes | None, list[str]]:
        """Times of a log whose first column has the row numbers instead of times. In a file without
        names they count as seconds (which the evidence doubts); they are None if the sampling time
        is stated. Raises `BadRequest` otherwise."""
        if not has_row_number_column(contents):
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
    """Columns and times read from one log file, with a remark on how the file was read."""

    table: Table
    time_s: ClockTimes | None
    remarks: list[str]


@dataclass(frozen=True, kw_only=True)
class Recording(ColumnSettings):
    """One experiment in a log file, given by the file, its columns and a range of samples. It
    consists of the samples `first` to `last - 1` of the file at `path`."""

    path: str
    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(0, "data.first", self.first, "count samples from 0")

    @property
    def searches_clock(self) -> bool:
        return self.step_s is None

    def read_experiment(self) -> Trajectory:
        """Read a recorded experiment from a log file, in physical units."""
        return self.read_record(Path(self.path), first=self.first, last=self.last)


def equals_any_column(values: ClockTimes, columns: list[np.ndarray]) -> bool:
    """Whether a column has the same numbers as one of several other columns."""
    return any(np.array_equal(values, column, equal_nan=True) for column in columns)


def decimate_record(
    u: Float[np.ndarray, "T m"], y: Float[np.ndarray, "T p"], factor: int
) -> tuple[Float[np.ndarray, "T2 m"], Float[np.ndarray, "T2 p"]]:
    """Decimate a record: every n-th output sample, and the mean of the input over each n samples. A
    hold would have applied that mean."""
    periods = len(u) // factor
    blocks = u[: periods * factor].reshape(periods, factor, -1)
    return blocks.mean(axis=1), y[: periods * factor : factor]
