"""Overview of a log on one screen: columns, sampling, response of the output, and a command that
fits a model.

Each sentence is a measurement on the log alone; none of them decides anything about a model.
"""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ssm_study.data.clock import INTERPOLATED
from ssm_study.data.clock_column import (
    clock_column_seconds,
    find_clock_column,
    has_row_number_column,
    is_evenly_spaced,
    resembles_clock,
)
from ssm_study.data.column_facts import ColumnFacts, summarise_column
from ssm_study.data.command_words import quote_for_command, unit_overrides
from ssm_study.data.log_checks import angle_wrap_sentences
from ssm_study.data.log_dynamics import FEEDTHROUGH, INTEGRATOR, describe_log_dynamics
from ssm_study.data.other_columns import (
    possible_disturbance_names,
    possible_disturbance_sentences,
    set_point_names,
    set_point_sentences,
)
from ssm_study.data.readers.reader import Table, choose_reader
from ssm_study.data.recorded import RecordedData
from ssm_study.data.signal_guess import doubtful_guess_sentences, guess_input_and_output
from ssm_study.data.text_layout import TextSettings
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Trajectory

MOST_SKIPPED = 6  # entries that are listed one by one
MOST_LETTERS = 40  # of the name of a study
ONE_SIGNAL = "one signal alone: if the output lies in another file, name that data.output_path"
NO_SIGNALS = "no command yet: name the columns with --input and --output, and look again"
NO_COMMAND = "no command yet: change what the line `not read yet` names, and look again"


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Columns, sampling period and text format that the user states for a log; None if unstated."""

    input: str | None = None
    output: str | None = None
    time: str | None = None
    step_s: float | None = None
    disturbance: str | None = None
    text: TextSettings = field(default_factory=TextSettings)

    def as_data_source(self, path: Path, u: str, y: str) -> RecordedData:
        """Data source that reads a log with the settings that the user stated."""
        return RecordedData(
            path=str(path),
            input=u,
            output=y,
            time=self.time,
            step_s=self.step_s,
            disturbance=self.disturbance,
            separator=self.text.separator,
            decimal=self.text.decimal,
            header=self.text.header,
        )

    def overrides(self) -> list[str]:
        """Command-line overrides, such as `data.time=t`, for the stated settings of a log."""
        words = [f"data.time={quote_for_command(self.time)}"] if self.time is not None else []
        words += [f"data.step_s={self.step_s:g}"] if self.step_s is not None else []
        if self.disturbance is not None:
            words.append(f"data.disturbance={quote_for_command(self.disturbance)}")
        for name, value in vars(self.text).items():
            if value is not None:
                text = str(value).lower()
                words.append(f"data.{name}={quote_for_command(text)}")
        return words


@dataclass(frozen=True, kw_only=True)
class LogOverview:
    """Overview of a log: summary of each column, sentences on the dynamics, fitting command."""

    path: Path
    columns: list[ColumnFacts]
    skipped: dict[str, str]
    sentences: list[str]
    command: str
    records: list[Trajectory]
    input: str | None
    output: str | None
    disturbance: str | None = None
    step_is_known: bool = True
    disturbed_command: str = ""
    reference_command: str = ""

    def __str__(self) -> str:
        lines = [f"{self.path.name}", *(column.as_table_line() for column in self.columns)]
        lines += skipped_column_lines(self.skipped)
        lines += [f"- {sentence}" for sentence in self.sentences]
        lines += ["", self.command]
        if self.disturbed_command:
            lines += ["", "or with what was measured too:", self.disturbed_command]
        if self.reference_command:
            lines += ["", "or if a controller made the input:", self.reference_command]
        return "\n".join(lines)


def skipped_column_lines(skipped: dict[str, str]) -> list[str]:
    """Lines of text on the columns of a log that were skipped, shortened if there are many."""
    worth = skipped
    if len(skipped) > MOST_SKIPPED:
        long = [(name, why) for name, why in skipped.items() if "samples" in why]
        worth = {name: why for name, why in long if not why.startswith("has 1 ")}
    lines = [f"  {name}: skipped, {why}" for name, why in worth.items()]
    others = len(skipped) - len(worth)
    return lines + ([f"  {others} texts, empty and single values skipped"] if others else [])


def refuse_wrong_types(path: object, step_s: object, settings: object) -> None:
    """Raise `BadRequest` for a path, period or settings of a wrong type."""
    is_path = isinstance(path, str | Path)
    require(is_path, "path", type(path).__name__, "is no path", "give the name of a file")
    is_number = isinstance(step_s, int | float) and not isinstance(step_s, bool)
    fits = step_s is None or is_number
    require(fits, "step_s", step_s, "is no sampling time", "give it in seconds")
    is_settings = settings is None or isinstance(settings, TextSettings)
    kind = type(settings).__name__
    require(is_settings, "settings", kind, "are no TextSettings", "leave them out")


def look(
    path: str | Path,
    *,
    input: str | int | None = None,
    output: str | int | None = None,
    time: str | int | None = None,
    step_s: float | None = None,
    disturbance: str | int | None = None,
    settings: TextSettings | None = None,
) -> LogOverview:
    """Examine a log file, and propose the command that fits a model to the log.

    Input and output are guessed by their names and by which column holds levels, unless they are
    named. Raises `BadRequest` for a file that cannot be read at all.
    """
    refuse_wrong_types(path, step_s, settings)
    path = Path(path)
    stated = LogSettings(
        input=column_as_text(input),
        output=column_as_text(output),
        time=column_as_text(time),
        step_s=step_s,
        disturbance=column_as_text(disturbance),
        text=settings or TextSettings(),
    )
    return examine_log(path, stated)


def examine_log(path: Path, stated: LogSettings) -> LogOverview:
    """Examine a log file whose columns and format are partly stated by the user."""
    table = choose_reader(path, stated.text).read_all_columns(path)
    require_numeric_column(path, table)
    facts = [summarise_column(name, table) for name in table.columns]
    clock = stated.time if stated.time is not None else clock_column_name(table)
    u, y = choose_input_and_output(table, facts, clock, stated)
    sentences = [f"read: {table.remark}"] if table.remark else []
    are_named = (stated.input is not None, stated.output is not None)
    doubts = doubtful_guess_sentences(facts, table.skipped, (u, y), are_named)
    reading = LogReading(records=[], step_is_known=True, sentences=[])
    others: list[str] = []
    if u is None or y is None:
        sentences.append(ONE_SIGNAL)
    elif doubts:
        sentences += doubts
        u = y = None
    else:
        sentences += signal_choice_sentences(facts, (u, y), stated)
        source = stated.as_data_source(path, u, y)
        reading = examine_signals(path, table, clock, source)
        sentences += reading.sentences
        sentences += angle_wrap_sentences(table.columns, y)
        counters = [column.name for column in facts if is_counter(column, table)]
        others = possible_disturbance_names(facts, clock, (u, y, stated.disturbance))
        others = [name for name in others if name not in counters]
        sentences += possible_disturbance_sentences(others)
    command = NO_SIGNALS if doubts else study_command(path, u, y, stated, reading, facts, sentences)
    return LogOverview(
        path=path,
        columns=facts,
        skipped=table.skipped,
        sentences=sentences,
        command=command,
        records=reading.records,
        input=u,
        output=y,
        disturbance=stated.disturbance,
        step_is_known=reading.step_is_known,
        disturbed_command=command_with_disturbance(command, others, stated, facts),
        reference_command=command_with_reference(command, facts, (u, y), stated),
    )


def require_numeric_column(path: Path, table: Table) -> None:
    """Raise `BadRequest` for a log without any column of numbers."""
    problem = "has no column of numbers"
    remedy = "export it as CSV"
    reasons = [f"{name}: {reason}" for name, reason in table.skipped.items()]
    cells = [reason for reason in reasons if " in line " in reason]
    objects = [reason for reason in reasons if "object of class" in reason]
    if cells or objects:
        problem = f"{problem} ({(cells or objects)[0]})"
        remedy = "correct the file there" if cells else "save its numbers as matrices"
    require(table.columns, "data.path", path, problem, remedy)


@dataclass(frozen=True, kw_only=True)
class LogReading:
    """Input and output records of a log, with remarks on how the log was read."""

    records: list[Trajectory]
    step_is_known: bool
    sentences: list[str]


def column_as_text(column: str | int | None) -> str | None:
    """Convert the name or number of a column to text; None is returned as None."""
    return None if column is None else str(column)


def choose_input_and_output(
    table: Table, facts: Sequence[ColumnFacts], clock: str | None, stated: LogSettings
) -> tuple[str | None, str | None]:
    """Choose the input and output columns of a log, as stated or else guessed."""
    free = []
    for column in facts:
        is_stated = column.name == stated.disturbance
        if not (is_stated or is_counter(column, table)):
            free.append(column)
    u, y = guess_input_and_output(free, clock)
    if stated.input is not None:
        u = stated.input
    if stated.output is not None:
        y = stated.output
    return u, y


def is_counter(column: ColumnFacts, table: Table) -> bool:
    """Whether a column only counts rows or times, judged by its even increase, title or unit."""
    if is_evenly_spaced(table.columns[column.name]):
        return True
    return resembles_clock(column.name, column.unit, table.columns[column.name])


def signal_choice_sentences(
    facts: Sequence[ColumnFacts], signals: tuple[str, str], stated: LogSettings
) -> list[str]:
    """Sentences on guessed input and output columns, and on possible set points."""
    u, y = signals
    sentences = []
    guessed = [f"input {u}"] if stated.input is None else []
    guessed += [f"output {y}"] if stated.output is None else []
    if guessed:
        sentences.append(f"guessed: {', '.join(guessed)} (--input and --output say otherwise)")
    set_points = set_point_names(facts, (*signals, stated.time))
    return sentences + set_point_sentences(set_points)


def clock_column_name(table: Table) -> str | None:
    """Name of the column of a log that contains the times or the row numbers; None if there is
    none."""
    if has_row_number_column(table):
        return next(iter(table.columns))
    return find_clock_column(table, ())


def examine_signals(
    path: Path, table: Table, clock: str | None, source: RecordedData
) -> LogReading:
    """Read the input and output of a log as a study would read them, and describe their dynamics.

    If only the sampling time is missing, lags, rests and noise are computed from the samples alone.
    """
    try:
        records, remark = source.read_pieces(path)
    except BadRequest as error:
        remedy = error.remedy.split("; `ssm-study look")[0]
        refusal = f"not read yet: {error.field} = {error.value}: {error.problem}; {remedy}"
        concerns_step = error.field == "data.step_s"
        sentences = [refusal]
        if concerns_step or clock is not None:
            sentences += clock_sentences(table, clock)
        if error.field != "data.step_s" or error.value is not None:
            return LogReading(records=[], step_is_known=clock is not None, sentences=sentences)
        try:
            records, _ = replace(source, step_s=1.0).read_pieces(path)
        except BadRequest:
            return LogReading(records=[], step_is_known=False, sentences=sentences)
        sentences += describe_log_dynamics(records)
        return LogReading(records=records, step_is_known=False, sentences=sentences)
    prefix = f"{path.name}: {table.remark}; "
    is_interpolated = INTERPOLATED in remark
    dynamics = describe_log_dynamics(records, is_interpolated=is_interpolated)
    sentences = [remark.removeprefix(prefix), *dynamics]
    return LogReading(records=records, step_is_known=True, sentences=sentences)


def clock_sentences(table: Table, clock: str | None) -> list[str]:
    """Sentences on the time column and the sampling period of a log."""
    if clock is None or clock not in table.columns:
        return ["no clock found: set data.step_s (seconds), or data.time (the column of times)"]
    if has_row_number_column(table):
        return []
    time_s, words = clock_column_seconds(clock, table)
    steps = np.diff(time_s[np.isfinite(time_s)])
    forwards = steps[steps > 0]
    median_s = float(np.median(forwards)) if len(forwards) else 0.0
    return [f"{words}: median period {median_s:.5g} s"]


def study_command(
    path: Path,
    u: str | None,
    y: str | None,
    stated: LogSettings,
    reading: LogReading,
    facts: Sequence[ColumnFacts],
    sentences: Sequence[str],
) -> str:
    """Command line that fits a model to a log, ready to be pasted into a shell."""
    study = f"study={study_name(path)} data=recorded"
    if u is None or y is None:
        columns = "data.input=COLUMN data.output_path=FILE data.output=COLUMN data.step_s=SECONDS"
        return f"ssm-study run {study} data.path={quote_for_command(str(path))} {columns}"
    if not reading.records:
        return NO_COMMAND
    words = [f"ssm-study run {study}", f"data.path={quote_for_command(str(path))}"]
    words += [
        f"data.input={quote_for_command(u)}",
        f"data.output={quote_for_command(y)}",
        *stated.overrides(),
        *unit_overrides(facts, {"input": u, "output": y, "disturbance": stated.disturbance}),
    ]
    if not reading.step_is_known and stated.step_s is None:
        words.append("data.step_s=SECONDS")
    text = " ".join(sentences)
    words += [setting for setting in (INTEGRATOR, FEEDTHROUGH) if setting in text]
    return " ".join(words)


def command_with_disturbance(
    command: str, others: Sequence[str], stated: LogSettings, facts: Sequence[ColumnFacts]
) -> str:
    """Command that fits a model to a log, with the only other signal as measured disturbance."""
    if len(others) != 1 or command == NO_COMMAND or stated.disturbance is not None:
        return ""
    units = unit_overrides(facts, {"disturbance": others[0]})
    words = [command, f"data.disturbance={quote_for_command(others[0])}", *units]
    return " ".join(words)


def command_with_reference(
    command: str, facts: Sequence[ColumnFacts], signals: Sequence[str | None], stated: LogSettings
) -> str:
    """Command that fits a model to a log made in a closed loop, with the only column that is named
    like its set point."""
    names = set_point_names(facts, (*signals, stated.time))
    if len(names) != 1 or not command.startswith("ssm-study run") or None in signals:
        return ""
    return f"{command} data.reference={quote_for_command(names[0])}"


def study_name(path: Path) -> str:
    """Name of the study of a log: the file name in plain letters, without suffix."""
    letters = unicodedata.normalize("NFKD", path.stem).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", letters)
    return plain.strip("_-")[:MOST_LETTERS].strip("_-") or "log"
