"""Search instead of grid: Optuna asks, the study's own runs answer; stopped at any instant, the same command goes on.

A trial is a run like any other, named by its configuration: asked twice, it is computed once. The trials are kept in
`.search/journal.jsonl` of the study folder; several searches may work on one study at a time.
"""

import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from optuna.storages.journal import BaseJournalBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from ssm_study.refusal import require
from ssm_study.results.columns import BY_NAME
from ssm_study.results.durable import is_locked, locked_or_none

FOLDER, JOURNAL, SEARCHER, WORDS = ".search", "journal.jsonl", "searcher", "words"
MAXIMIZE, MINIMIZE = optuna.study.StudyDirection.MAXIMIZE, optuna.study.StudyDirection.MINIMIZE
Answer = Callable[[list[list[str]]], list[Mapping[str, Any] | None]]


@dataclass(frozen=True)
class FlockedJournal(BaseJournalBackend):
    """Optuna's log as one JSON line per entry, under a flock that dies with its holder; a torn last line is dropped."""

    path: Path

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:
        lines = self.path.read_bytes().split(b"\n")[:-1] if self.path.exists() else []
        yield from (json.loads(line) for line in lines[log_number_from:])

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        with self.path.open("ab") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            self._drop_torn_line(stream.fileno())
            stream.write(b"".join(json.dumps(log).encode() + b"\n" for log in logs))
            stream.flush()
            os.fsync(stream.fileno())

    def _drop_torn_line(self, descriptor: int) -> None:
        content = self.path.read_bytes()
        os.ftruncate(descriptor, content.rfind(b"\n") + 1)


@dataclass(frozen=True, kw_only=True)
class Search:
    """`trials` in total, not further ones; `maximise` and `minimise` name columns of the record."""

    study: Path
    trials: int
    maximise: tuple[str, ...]
    minimise: tuple[str, ...]
    seed: int
    at_once: int

    def __post_init__(self) -> None:
        require(self.trials >= 1, "hydra.sweeper.trials", self.trials, "nothing to try", "give 1 or more")
        require(self.at_once >= 1, "hydra.sweeper.at_once", self.at_once, "nothing to try", "give 1 or more")
        require(
            bool(self.columns), "hydra.sweeper.maximise", [], "no objective", "name a column, e.g. fit_test_percent"
        )
        for column in self.columns:
            number = column in BY_NAME and BY_NAME[column].kind in ("Float64", "Int64")
            require(number, "hydra.sweeper", column, "not a column of numbers", "name a column such as stable_fraction")

    @property
    def columns(self) -> tuple[str, ...]:
        return self.maximise + self.minimise

    def run(self, space: Mapping[str, Override], fixed: list[str], answer: Answer) -> optuna.Study:
        """Ask for trials, have them answered `at_once` at a time, tell what came of them, until there are `trials`."""
        folder = self.study / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        name = f"{secrets.token_hex(6)}.lock"
        with locked_or_none(folder / name):
            study = self.open()
            self._answer(study, self._abandoned(study, name), answer)
            while (missing := self.trials - len(study.get_trials(deepcopy=False))) > 0:
                asked = [self._ask(study, space, fixed, name) for _ in range(min(missing, self.at_once))]
                self._answer(study, asked, answer)
        with suppress(FileNotFoundError):
            (folder / name).unlink()
        return study

    def open(self) -> optuna.Study:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        journal = FlockedJournal(self.study / FOLDER / JOURNAL)
        return optuna.create_study(
            study_name="+".join(self.columns),
            storage=optuna.storages.JournalStorage(journal),
            directions=[MAXIMIZE] * len(self.maximise) + [MINIMIZE] * len(self.minimise),
            sampler=optuna.samplers.TPESampler(seed=self.seed),
            load_if_exists=True,
        )

    def _ask(self, study: optuna.Study, space: Mapping[str, Override], fixed: list[str], name: str) -> int:
        trial = study.ask()
        words = [*fixed, *(f"{key}={suggestion(trial, key, override)}" for key, override in space.items())]
        trial.set_user_attr(SEARCHER, name)
        trial.set_user_attr(WORDS, words)
        return trial.number

    def _abandoned(self, study: optuna.Study, ours: str) -> list[int]:
        """Trials asked for by searches that are no more; one that nobody has signed yet may be a living search's."""
        others = (path for path in (self.study / FOLDER).glob("*.lock") if path.name != ours)
        alone = not any(is_locked(path) for path in others)
        running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING, TrialState.WAITING))
        return [trial.number for trial in running if self._is_abandoned(trial, alone)]

    def _is_abandoned(self, trial: FrozenTrial, alone: bool) -> bool:
        name = trial.user_attrs.get(SEARCHER)
        return alone if name is None else not is_locked(self.study / FOLDER / str(name))

    def _answer(self, study: optuna.Study, numbers: list[int], answer: Answer) -> None:
        trials = study.get_trials(deepcopy=False)
        words = [trials[number].user_attrs.get(WORDS) for number in numbers]
        known = [(number, list(asked)) for number, asked in zip(numbers, words, strict=True) if asked is not None]
        for number in set(numbers) - {number for number, _ in known}:
            study.tell(number, state=TrialState.FAIL)  # killed between asking and noting what was asked
        for (number, _), record in zip(known, answer([asked for _, asked in known]) if known else [], strict=True):
            values = objectives(record, self.columns)
            state = TrialState.FAIL if values is None else None
            study.tell(number, values, state=state, skip_if_finished=True)


def objectives(record: Mapping[str, Any] | None, columns: Iterable[str]) -> list[float] | None:
    """The record's numbers, or None where the run failed or one of them is missing (infeasible: no loop)."""
    values = [record.get(column) if record else None for column in columns]
    numbers = [float(value) for value in values if isinstance(value, (int, float)) and not isinstance(value, bool)]
    return numbers if len(numbers) == len(values) else None


def suggestion(trial: Trial, key: str, override: Override) -> str:
    """`interval(a,b)` a number between, `tag(log,interval(a,b))` on a logarithmic scale, else one of those listed."""
    value = override.value()
    if isinstance(value, IntervalSweep):
        assert value.start is not None
        assert value.end is not None
        return repr(trial.suggest_float(key, float(value.start), float(value.end), log="log" in value.tags))
    words = [str(word) for word in override.sweep_string_iterator()]
    if isinstance(value, RangeSweep) and all(word.lstrip("-").isdigit() for word in words):
        return str(trial.suggest_int(key, int(words[0]), int(words[-1]), step=int(value.step)))
    return str(trial.suggest_categorical(key, words))
