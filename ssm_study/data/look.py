"""Overview of a log on one screen: columns, clock, what moves what, and the command that fits it.

Each sentence is a measurement on the log alone; none of them decides anything about a model.
Lags and noise come from least squares on increments: `dy[k]` on `du[k] ... du[k - LAGS]` and two
earlier `dy`; a lag answers where its coefficient is `SURE` standard errors from zero.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.clock import clock_seconds, find_clock
from ssm_study.data.readers.reader import Table, reader_for
from ssm_study.data.recorded import RecordedData
from ssm_study.data.splits import rest_segments
from ssm_study.data.text_layout import TextSettings
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Trajectory

LAGS = 40
SURE = 6.0  # standard errors
OF_THE_LARGEST = 0.05  # share of the largest answer from which on a lag counts
HELD = 0.5  # share of samples at which a column that holds levels does not change
FED_BACK = 0.1  # share of the input's changes that earlier outputs explain in a closed loop
FORGETS = (
    0.03  # share of its level that an output without an integrator loses over a window, at least
)
DRIFTS = 0.3  # share of its level by which one with an integrator may seem to grow
INTEGRATES = 0.15  # by so much more the input explains the output's change than its level
INPUT_WORDS = ("u", "in", "input", "command", "cmd", "pwm", "duty", "valve", "heater", "voltage",
               "power", "signal", "inputsignal", "servo", "torque", "force", "rudder", "flow",
               "current", "us", "setting", "throttle", "pump", "ph")  # fmt: skip
OUTPUT_WORDS = ("y", "out", "output", "speed", "temperature", "temp", "position", "level", "angle",
                "rate", "rpm", "velocity", "encoder", "enconder", "pos", "measured", "ti",
                "pressure", "height")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ColumnFacts:
    """One column: its unit, range, how many values it takes, how many are missing."""

    name: str
    unit: str
    low: float
    high: float
    levels: int
    missing: int
    held: float

    def line(self) -> str:
        """The facts as a line of a table."""
        holds = f", holds {self.held:.0%} of the time" if self.held > HELD else ""
        missing = f", {self.missing} missing" if self.missing else ""
        name = (self.name or "(no name)")[:28]
        unit = f"[{self.unit}]" if self.unit else ""
        numbers = f"{self.low:>11.5g} ... {self.high:<11.5g} {self.levels:>6} values"
        return f"  {name:<28} {unit:<8}{numbers}{holds}{missing}"


@dataclass(frozen=True, kw_only=True)
class LogLook:
    """Contents of a log: facts of its columns, sentences, the command, and the signals if read."""

    path: Path
    columns: list[ColumnFacts]
    skipped: dict[str, str]
    sentences: list[str]
    command: str
    records: list[Trajectory]
    input: str | None
    output: str | None

    def __str__(self) -> str:
        lines = [f"{self.path.name}", *(column.line() for column in self.columns)]
        lines += [f"  {name}: skipped, {why}" for name, why in self.skipped.items()]
        lines += [f"- {sentence}" for sentence in self.sentences]
        return "\n".join([*lines, "", self.command])


def look(
    path: str | Path,
    *,
    input: str | int | None = None,
    output: str | int | None = None,
    time: str | int | None = None,
    step_s: float | None = None,
    settings: TextSettings | None = None,
) -> LogLook:
    """Examine a log and propose the command that fits it.

    Input and output are guessed by their names and by which column holds levels, unless they are
    named. Raises `BadRequest` for a file that cannot be read at all.
    """
    path = Path(path)
    table = reader_for(path, settings).contents(path)
    require(table.columns, "data.path", path, "has no column of numbers", "export it as CSV")
    facts = [column_facts(name, table) for name in table.columns]
    clock = str(time) if time is not None else find_clock(table, ())
    guessed_in, guessed_out = guess_signals(facts, clock)
    u = guessed_in if input is None else str(input)
    y = guessed_out if output is None else str(output)
    sentences = [f"read: {table.remark}"] if table.remark else []
    records: list[Trajectory] = []
    if u is None or y is None:
        sentences.append("one column alone: name a file for input and output each")
    else:
        if input is None or output is None:
            sentences.append(f"guessed: input {u}, output {y} (--input and --output say otherwise)")
        try:
            source = source_of(path, u, y, time, step_s, settings)
            records, remark = source.read_pieces(path)
            sentences += [remark.split("; ", 1)[-1], *dynamics(records)]
        except BadRequest as error:
            sentences.append(f"not read yet: {error.field} = {error.value}: {error.problem}; "
                             f"{error.remedy.split('; `ssm-study look')[0]}")  # fmt: skip
            sentences += clock_sentences(table, clock)
    command = run_command(path, u, y, time, step_s, records, settings, sentences)
    return LogLook(
        path=path,
        columns=facts,
        skipped=table.skipped,
        sentences=sentences,
        command=command,
        records=records,
        input=u,
        output=y,
    )


def source_of(
    path: Path,
    u: str,
    y: str,
    time: str | int | None,
    step_s: float | None,
    settings: TextSettings | None,
) -> RecordedData:
    """The settings of a run on this log."""
    stated = settings or TextSettings()
    return RecordedData(
        path=str(path),
        input=u,
        output=y,
        time=time,
        step_s=step_s,
        separator=stated.separator,
        decimal=stated.decimal,
        header=stated.header,
    )


def column_facts(name: str, table: Table) -> ColumnFacts:
    """Range, levels, missing values of one column."""
    values = table.columns[name]
    known = values[np.isfinite(values)]
    still = float((np.diff(known) == 0).mean()) if len(known) > 1 else 0.0
    return ColumnFacts(
        name=name,
        unit=table.units.get(name, ""),
        low=float(known.min(initial=np.inf)),
        high=float(known.max(initial=-np.inf)),
        levels=len(np.unique(known)),
        missing=len(values) - len(known),
        held=still,
    )


def guess_signals(facts: list[ColumnFacts], clock: str | None) -> tuple[str | None, str | None]:
    """The columns that are most likely input and output: by their words, then by place."""
    moving = [one for one in facts if one.name != clock and one.levels > 1]
    if len(moving) < 2:
        return None, None
    inputs = sorted(moving, key=lambda one: -word_score(one.name, INPUT_WORDS) - 0.4 * one.held)
    u = inputs[0]
    others = [one for one in moving if one is not u]
    y = max(others, key=lambda one: word_score(one.name, OUTPUT_WORDS))
    return u.name, y.name


def word_score(name: str, words: tuple[str, ...]) -> float:
    """One if a word of the name is among the words, a half if one begins with them."""
    parts = [part for part in re.split(r"[^a-z]+", name.lower()) if part]
    if any(part in words for part in parts):
        return 1.0
    long_words = [word for word in words if len(word) > 3]
    return 0.5 if any(part.startswith(word) for part in parts for word in long_words) else 0.0


def clock_sentences(table: Table, clock: str | None) -> list[str]:
    """Which column the clock is and what period it shows, in words."""
    if clock is None or clock not in table.columns:
        return ["no clock found: give data.step_s in seconds, or name the column data.time"]
    time_s, words = clock_seconds(clock, table)
    steps = np.diff(time_s[np.isfinite(time_s)])
    median_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return [f"{words}: median period {median_s:.5g} s"]


def dynamics(records: list[Trajectory]) -> list[str]:
    """Rests, dead time, integrator, closed loop and noise of the longest stretch, in words."""
    record = max(records, key=len)
    u = record.u[:, 0]
    y = record.y[:, 0]
    if len(record) < 4 * LAGS or np.ptp(u) == 0 or np.ptp(y) == 0:
        return ["too short, or nothing moves: no dynamics measured"]
    rests = sum(len(rest_segments(one)) for one in records)
    sentences = [f"{rests} rests at the input at which the log ends" if rests else "no rest"]
    sentences.append(delay_sentence(u, y))
    share = fed_back_share(u, y)
    if share > FED_BACK:
        sentences.append(
            f"earlier outputs explain {share:.0%} of the input's changes: a closed loop? "
            "name its set point, data.reference"
        )
    levels, changes, lost = explained_by_input(u, y)
    if changes > levels + INTEGRATES and -DRIFTS < lost < FORGETS:
        sentences.append(
            f"integrator: the input explains {max(changes, 0):.0%} of the output's changes and "
            f"{max(levels, 0):.0%} of its level (model.integrating_output=true)"
        )
    sentences.append(noise_sentence(y))
    return sentences


def increments(u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> tuple[np.ndarray, ...]:
    """Regressors `du[k - 0 ... LAGS], dy[k - 1], dy[k - 2]` and `dy[k]`, scaled."""
    du = np.diff(u) / np.std(u)
    dy = np.diff(y) / np.std(y)
    past = max(LAGS, 2)
    columns = [du[past - lag : len(du) - lag] for lag in range(LAGS + 1)]
    columns += [dy[past - lag : len(dy) - lag] for lag in (1, 2)]
    return np.stack(columns, axis=1), dy[past:]


def delay_sentence(u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> str:
    """After how many samples the output answers a change of the input."""
    first = first_answering_lag(u, y)
    if first is None:
        return f"no answer to the input within {LAGS} samples stands out of the noise"
    if first == 0:
        return "the output answers within the same sample (model.feedthrough=true)"
    if first == 1:
        return "the output answers in the next sample: no dead time"
    if first == 2:
        return "the output answers after 2 samples: two lags in a row, or a dead time of one"
    return f"dead time: the output answers after {first} samples"


def first_answering_lag(u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> int | None:
    """Samples until the output answers a change of the input; None where noise hides the answer."""
    x, target = increments(u, y)
    gains, _, rank, _ = np.linalg.lstsq(x, target, rcond=1e-10)
    residual = target - x @ gains
    variance = float(residual @ residual) / max(len(target) - int(rank), 1)
    errors = np.sqrt(np.maximum(variance * np.diag(np.linalg.pinv(x.T @ x)), 1e-300))
    answers = np.abs(gains[: LAGS + 1])
    counts = (answers > SURE * errors[: LAGS + 1]) & (answers > OF_THE_LARGEST * answers.max())
    return int(np.argmax(counts)) if counts.any() else None


def fed_back_share(u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> float:
    """Share of what earlier inputs leave of the input's changes that earlier outputs explain."""
    lags = range(1, 6)
    own = np.stack([*(u[5 - lag : len(u) - lag] for lag in lags), np.ones(len(u) - 5)], axis=1)
    other = np.stack([y[5 - lag : len(y) - lag] for lag in lags], axis=1)
    target = u[5:]
    half = len(own) // 2
    powers = []
    for x in (own, np.hstack([own, other])):
        gains = np.linalg.lstsq(x[:half], target[:half], rcond=1e-9)[0]
        powers.append(float(((target[half:] - x[half:] @ gains) ** 2).mean()))
    return 1.0 - powers[1] / powers[0] if powers[0] > 0 else 0.0


def explained_by_input(
    u: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]
) -> tuple[float, float, float]:
    """Shares of the output's level, and of its change over a window, that the input's mean over the
    window explains by a polynomial of degree three; and how much of its level the output loses over
    the window, an integrator nothing. Of four windows the one whose changes are explained best."""
    best = (0.0, 0.0, 1.0)
    for window in (5, 20, 50, 100):
        if len(u) < 8 * window:
            continue
        mean = np.convolve(u, np.full(window, 1 / window), mode="valid")[:-1:window]
        ends = y[window::window][: len(mean)]
        begins = y[:-window:window][: len(ends)]
        mean = mean[: len(ends)]
        scaled = (mean - mean.mean()) / max(float(mean.std()), 1e-300)
        x = np.stack([scaled**power for power in range(4)], axis=1)
        change = explained(x, ends - begins)
        if change > best[1]:
            with_level = np.hstack([x, begins[:, None]])
            gains = np.linalg.lstsq(with_level, ends - begins, rcond=1e-9)[0]
            best = (explained(x, ends), change, float(-gains[-1]))
    return best


def explained(x: Float[np.ndarray, "K d"], target: Float[np.ndarray, "K"]) -> float:
    """Share of the target's variance that least squares explains."""
    residual = target - x @ np.linalg.lstsq(x, target, rcond=1e-9)[0]
    return 1.0 - float(residual.var() / max(float(target.var()), 1e-300))


def noise_sentence(y: Float[np.ndarray, "T"]) -> str:
    """Resolution of the output, and its noise by second differences."""
    steps = np.abs(np.diff(y))
    moving = steps[steps > 0]
    resolution = float(moving.min()) if len(moving) else 0.0
    values = len(np.unique(y))
    second = np.diff(y, n=2)
    noise = float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))
    coarse = f"; a coarse sensor: steps of {resolution:.3g}" if values < 0.1 * len(y) else ""
    return f"noise at most {noise:.2g}, {noise / np.ptp(y):.2%} of the range{coarse}"


def run_command(
    path: Path,
    u: str | None,
    y: str | None,
    time: str | int | None,
    step_s: float | None,
    records: list[Trajectory],
    settings: TextSettings | None,
    sentences: list[str],
) -> str:
    """The command that fits the log, ready to paste."""
    if u is None or y is None:
        return f"ssm-study run data=recorded data.path={quoted(str(path))} ..."
    words = ["ssm-study run data=recorded", f"data.path={quoted(str(path))}"]
    words += [f"data.input={quoted(u)}", f"data.output={quoted(y)}"]
    words += [f"data.time={quoted(str(time))}"] if time is not None else []
    words += [f"data.step_s={step_s:g}"] if step_s is not None else []
    if not records and step_s is None:
        words.append("data.step_s=SECONDS")
    for name, value in vars(settings or TextSettings()).items():
        words += [f"data.{name}={value}".lower()] if value is not None else []
    said = " ".join(sentences)
    for remedy in ("model.integrating_output=true", "model.feedthrough=true"):
        words += [remedy] if remedy in said else []
    return " ".join(words)


def quoted(text: str) -> str:
    """A value as shell and configuration read it back: letters and digits need no quotes."""
    if re.fullmatch(r"[\w./:\-]+", text, re.ASCII):
        return text
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"\"'{escaped}'\""
