"""Overview of a log on one screen: its columns, its clock, how the output responds to the input,
and a command that fits it.

Each sentence is a measurement on the log alone; none of them decides anything about a model.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ssm_study.data.clock_column import (
    clock_column_seconds,
    find_clock_column,
    first_column_counts_rows,
    is_evenly_spaced,
)
from ssm_study.data.log_dynamics import FEEDTHROUGH, INTEGRATOR, describe_log_dynamics
from ssm_study.data.readers.reader import Table, choose_reader, fold_title, title_without_unit
from ssm_study.data.recorded import RecordedData
from ssm_study.data.text_layout import TextSettings
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Trajectory

MOST_SKIPPED = 6  # entries that are listed one by one
HELD = 0.5  # share of samples at which a column that holds levels does not change
HOLDS_COUNT = 0.4  # weight, against a word of the name, of how long a column holds its levels
FEW_LEVELS_COUNT = 0.2  # the same of how few levels it has
STEADY_COUNTS = 0.3  # the same, against an input, of a column that hardly moves from its mean
STEADY = 0.1  # range over the largest magnitude, below which a column hardly moves
MOST_NAMED = 4  # columns that move besides input and output, by name in the sentence on them
INPUT_WORDS = ("u", "in", "input", "command", "cmd", "pwm", "duty", "valve", "heater", "voltage",
               "power", "signal", "inputsignal", "servo", "torque", "force", "rudder", "flow",
               "current", "us", "setting", "inputdata", "throttle", "pump", "ph", "q")  # fmt: skip
OUTPUT_WORDS = ("y", "t", "out", "output", "speed", "temperature", "temp", "position", "level",
                "angle", "rate", "rpm", "velocity", "encoder", "enconder", "pos", "measured",
                "ti", "pressure", "height", "outputdata")  # fmt: skip
SET_POINT_WORDS = ("sp", "setpoint", "set", "ref", "reference", "target", "desired", "wanted", "r",
                   "tsp", "soll", "sollwert", "goal", "demand")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ColumnFacts:
    """Range, number of levels and missing values of one column of a log. One column: its unit,
    range, how many values it takes, how many are missing."""

    name: str
    unit: str
    low: float
    high: float
    levels: int
    missing: int
    held: float
    rows: int

    def table_line(self) -> str:
        """One line of text with the title, range and levels of a column."""
        name = (self.name or "(no name)")[:28]
        unit = f"[{self.unit}]" if self.unit else ""
        return f"  {name:<28} {unit:<8}{self.range_words()}".rstrip()

    def range_words(self) -> str:
        """Range, levels and missing values of a column in words."""
        if not self.levels:
            return "empty"
        if self.levels == 1:
            missing = f", {self.missing} missing" if self.missing else ""
            return f"{self.low:>11.5g} throughout{missing}"
        holds = f", holds {self.held:.0%} of the time" if self.held > HELD else ""
        missing = f", {self.missing} missing" if self.missing else ""
        numbers = f"{self.low:>11.5g} ... {self.high:<11.5g} {self.levels:>6} values"
        return f"{numbers}{holds}{missing}"


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Columns and clock of a log as the user states them. None leaves a setting to be found."""

    input: str | None = None
    output: str | None = None
    time: str | None = None
    step_s: float | None = None
    text: TextSettings = field(default_factory=TextSettings)

    def as_data_source(self, path: Path, u: str, y: str) -> RecordedData:
        """Data source of a run that reads the log with the stated settings."""
        return RecordedData(
            path=str(path),
            input=u,
            output=y,
            time=self.time,
            step_s=self.step_s,
            separator=self.text.separator,
            decimal=self.text.decimal,
            header=self.text.header,
        )

    def overrides(self) -> list[str]:
        """Command-line words for the settings of a log that the user states."""
        words = [f"data.time={quote_for_command(self.time)}"] if self.time is not None else []
        words += [f"data.step_s={self.step_s:g}"] if self.step_s is not None else []
        for name, value in vars(self.text).items():
            words += (
                [f"data.{name}={quote_for_command(str(value).lower())}"]
                if value is not None
                else []
            )
        return words


@dataclass(frozen=True, kw_only=True)
class LogLook:
    """Overview of a log: facts on its columns, sentences on its dynamics, and the command that fits
    it. Contents of a log: facts of its columns, sentences, the command, and the signals if read."""

    path: Path
    columns: list[ColumnFacts]
    skipped: dict[str, str]
    sentences: list[str]
    command: str
    records: list[Trajectory]
    input: str | None
    output: str | None
    step_is_known: bool = True

    def __str__(self) -> str:
        lines = [f"{self.path.name}", *(column.table_line() for column in self.columns)]
        lines += skipped_column_lines(self.skipped)
        lines += [f"- {sentence}" for sentence in self.sentences]
        return "\n".join([*lines, "", self.command])


def skipped_column_lines(skipped: dict[str, str]) -> list[str]:
    """Lines of text that say which columns of a log were skipped, and why. Lines on what was
    skipped and why; of a long list, those with numbers, and how many more."""
    worth = skipped
    if len(skipped) > MOST_SKIPPED:
        worth = {name: why for name, why in skipped.items() if "samples" in why}
        worth = {name: why for name, why in worth.items() if not why.startswith("has 1 ")}
    lines = [f"  {name}: skipped, {why}" for name, why in worth.items()]
    others = len(skipped) - len(worth)
    return lines + ([f"  {others} texts, empty and single values skipped"] if others else [])


def look(
    path: str | Path,
    *,
    input: str | int | None = None,
    output: str | int | None = None,
    time: str | int | None = None,
    step_s: float | None = None,
    settings: TextSettings | None = None,
) -> LogLook:
    """Examine a log file and propose the command that fits a model to it.

    Input and output are guessed by their names and by which column holds levels, unless they are
    named. Raises `BadRequest` for a file that cannot be read at all.
    """
    path = Path(path)
    stated = LogSettings(
        input=None if input is None else str(input),
        output=None if output is None else str(output),
        time=None if time is None else str(time),
        step_s=step_s,
        text=settings or TextSettings(),
    )
    table = choose_reader(path, stated.text).contents(path)
    require(table.columns, "data.path", path, "has no column of numbers", "export it as CSV")
    facts = [column_facts(name, table) for name in table.columns]
    signals = [column for column in facts if not is_evenly_spaced(table.columns[column.name])]
    clock = stated.time if stated.time is not None else clock_column_name(table)
    guessed_u, guessed_y = guess_signals(signals, clock)
    u = guessed_u if stated.input is None else stated.input
    y = guessed_y if stated.output is None else stated.output
    sentences = [f"read: {table.remark}"] if table.remark else []
    records: list[Trajectory] = []
    step_is_known = True
    if u is None or y is None:
        sentences.append("one column alone: name a file for input and output each")
    else:
        if None in (stated.input, stated.output):
            sentences.append(f"guessed: input {u}, output {y} (--input and --output say otherwise)")
        sentences += set_point_sentences(facts, (u, y), stated)
        records, step_is_known, found = examine_signals(
            path, table, clock, stated.as_data_source(path, u, y)
        )
        sentences += [*found, *other_signal_sentences(facts, clock, (u, y))]
    return LogLook(
        path=path,
        columns=facts,
        skipped=table.skipped,
        sentences=sentences,
        command=study_command(path, u, y, stated, step_is_known, sentences),
        records=records,
        input=u,
        output=y,
        step_is_known=step_is_known,
    )


def set_point_sentences(
    facts: Sequence[ColumnFacts], signals: tuple[str, str], stated: LogSettings
) -> list[str]:
    """Sentences on columns whose titles suggest a set point."""
    names = [column.name for column in facts if is_set_point_title(column.name)]
    others = [name for name in names if name not in (*signals, stated.time)]
    if not others:
        return []
    settings = " or ".join(f"data.reference={quote_for_command(name)}" for name in others)
    return [f"named like a set point: if a controller made the input, state {settings}"]


def clock_column_name(table: Table) -> str | None:
    """Name of the column that is the clock of a log, or that counts its rows."""
    if first_column_counts_rows(table):
        return next(iter(table.columns))
    return find_clock_column(table, ())


def examine_signals(
    path: Path, table: Table, clock: str | None, source: RecordedData
) -> tuple[list[Trajectory], bool, list[str]]:
    """Read the input and output of a log as a run does, and describe their dynamics or the obstacle
    to reading them. Also returns whether the sampling time is known.

    Where the sampling time alone is missing, lags, rests and noise are those of the samples.
    """
    try:
        records, remark = source.read_pieces(path)
    except BadRequest as error:
        remedy = error.remedy.split("; `ssm-study look")[0]
        refusal = f"not read yet: {error.field} = {error.value}: {error.problem}; {remedy}"
        sentences = [refusal, *clock_sentences(table, clock)]
        if error.field != "data.step_s" or error.value is not None:
            return [], clock is not None, sentences
        try:
            records, _ = replace(source, step_s=1.0).read_pieces(path)
        except BadRequest:
            return [], False, sentences
        return records, False, [*sentences, *describe_log_dynamics(records)]
    prefix = f"{path.name}: {table.remark}; "
    return records, True, [remark.removeprefix(prefix), *describe_log_dynamics(records)]


def column_facts(name: str, table: Table) -> ColumnFacts:
    """Compute range, levels and missing values of one column of a log."""
    values = table.columns[name]
    finite = values[np.isfinite(values)]
    held = float((np.diff(finite) == 0).mean()) if len(finite) > 1 else 0.0
    return ColumnFacts(
        name=name,
        unit=table.units.get(name, ""),
        low=float(finite.min(initial=np.inf)) + 0.0,  # no minus before a zero
        high=float(finite.max(initial=-np.inf)) + 0.0,
        levels=len(np.unique(finite)),
        missing=len(values) - len(finite),
        held=held,
        rows=len(values),
    )


def guess_signals(facts: Sequence[ColumnFacts], clock: str | None) -> tuple[str | None, str | None]:
    """Guess which columns of a log are input and output, by words in their titles, then by their
    levels."""
    moving = [column for column in facts if column.name != clock and column.levels > 1]
    if len(moving) < 2:
        return None, None
    free = [column for column in moving if not is_set_point_title(column.name)]
    moving = free if len(free) > 1 else moving
    u = max(moving, key=input_score)
    others = [column for column in moving if column is not u]
    y = max(others, key=lambda column: title_word_score(column.name, OUTPUT_WORDS))
    return u.name, y.name


def is_set_point_title(name: str) -> bool:
    """Whether a column's title is that of a set point, as `r`, `ref`, `T1 setpoint`, `TSP1` and
    `speed_target` are."""
    return title_word_score(name, SET_POINT_WORDS) == 1.0


def other_signal_sentences(
    facts: Sequence[ColumnFacts], clock: str | None, signals: tuple[str, str]
) -> list[str]:
    """Sentence that lists the varying columns besides input and output, for they may be
    disturbances."""
    titles = [column.name for column in facts]
    places = [column_index(titles, name) for name in (*signals, clock)]
    moving = [
        column.name
        for k, column in enumerate(facts)
        if column.levels > 1 and k not in places and not is_set_point_title(column.name)
    ]
    if not moving:
        return []
    named = ", ".join(moving[:MOST_NAMED])
    more = f" and {len(moving) - MOST_NAMED} more" if len(moving) > MOST_NAMED else ""
    return [
        f"measured too: {named}{more}; what moves the output and is not commanded belongs in "
        "data.disturbance=[COLUMN]"
    ]


def column_index(titles: Sequence[str], name: str | None) -> int | None:
    """Index of the column that a name or number on the command line means. Which column a name of
    the command means; None for a name of none of them."""
    if name is None or name in titles:
        return None if name is None else titles.index(name)
    plain = [fold_title(title_without_unit(title)) for title in titles]
    if fold_title(name) in plain:
        return plain.index(fold_title(name))
    return int(name) if name.isdigit() and int(name) < len(titles) else None


def input_score(column: ColumnFacts) -> float:
    """Score of how likely a column of a log is the input of the plant. How much a column looks like
    an input: by its name, by how it holds few levels, and by how far it moves. Columns that are
    alike in this are taken in their order."""
    few_levels = max(0.0, 1.0 - 2.0 * column.levels / column.rows)
    by_levels = HOLDS_COUNT * round(column.held, 1) + FEW_LEVELS_COUNT * round(few_levels, 1)
    magnitude = max(abs(column.low), abs(column.high))
    is_steady = column.high - column.low < STEADY * magnitude
    return title_word_score(column.name, INPUT_WORDS) + by_levels - STEADY_COUNTS * is_steady


def title_word_score(name: str, words: tuple[str, ...]) -> float:
    """Score of how well a column's title matches a list of words. One if a word of the name is
    among the words, a half if one begins with them."""
    parts = [part for part in re.split(r"[^a-z]+", name.lower()) if part]
    if any(part in words for part in parts):
        return 1.0
    long_words = [word for word in words if len(word) > 3]
    return 0.5 if any(part.startswith(word) for part in parts for word in long_words) else 0.0


def clock_sentences(table: Table, clock: str | None) -> list[str]:
    """Sentences on which column is the clock of a log, and what sampling period it shows."""
    if clock is None or clock not in table.columns:
        return ["no clock found: give data.step_s in seconds, or name the column data.time"]
    if first_column_counts_rows(table):
        return []
    time_s, words = clock_column_seconds(clock, table)
    steps = np.diff(time_s[np.isfinite(time_s)])
    median_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return [f"{words}: median period {median_s:.5g} s"]


def study_command(
    path: Path,
    u: str | None,
    y: str | None,
    stated: LogSettings,
    step_is_known: bool,
    sentences: Sequence[str],
) -> str:
    """Command line, ready to paste, that runs a study on the log."""
    if u is None or y is None:
        return f"ssm-study run data=recorded data.path={quote_for_command(str(path))} ..."
    words = ["ssm-study run data=recorded", f"data.path={quote_for_command(str(path))}"]
    words += [
        f"data.input={quote_for_command(u)}",
        f"data.output={quote_for_command(y)}",
        *stated.overrides(),
    ]
    if not step_is_known and stated.step_s is None:
        words.append("data.step_s=SECONDS")
    text = " ".join(sentences)
    words += [setting for setting in (INTEGRATOR, FEEDTHROUGH) if setting in text]
    return " ".join(words)


def quote_for_command(text: str) -> str:
    """Quote a value for the shell and the configuration. A value as shell and configuration read it
    back: letters and digits need no quotes."""
    if re.fullmatch(r"[\w./:\-]+", text, re.ASCII):
        return text
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"\"'{escaped}'\""
