"""Candidates tried so far for the model of a log, the settings decided so far, and the resulting
choice."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ssm_study.models.structured_spec import AUTO, AUTOMATIC, StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.candidates import (
    Candidate,
    Row,
    Settings,
    Trial,
    best_of,
    linear_trial,
    structured_trial,
)
from ssm_study.training.folds import FOLDS

LINEAR = "linear output error"
STRUCTURED = "structured"
REFIT_BEYOND = 1.25  # times the error on held-out folds


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Specification with every setting decided, the table of candidates, and the chosen model's
    mean error on held-out folds, percent. Without a table nothing was tried.

    `is_linear`: the output-error model itself is to be taken, of this order and delay.
    """

    spec: StructuredSpec
    rows: tuple[Row, ...] = ()
    error: float | None = None
    is_linear: bool = False

    def words(self, automatic: Sequence[str]) -> str:
        """Words on the settings that were left open and what was chosen, of how many. Empty if
        nothing was."""
        if not self.rows:
            return ""
        settings = ", ".join(
            f"{spoken(name)} {spoken(getattr(self.spec, name))}" for name in automatic
        )
        return f"{settings}: of {len(self.rows)} models compared on {FOLDS} folds"

    def asks_for_refit(self, error_validation: float) -> bool:
        """Whether validation records are predicted far worse than held-out folds are. The training
        records then do not show what the others do."""
        if self.error is None or not self.spec.refit:
            return False
        return error_validation > REFIT_BEYOND * self.error


def spoken(value: object) -> str:
    """A name or value of a setting in words: `dead_time`, true, 5."""
    return {"True": "yes", "False": "no"}.get(str(value), str(value).replace("_", " "))


@dataclass(kw_only=True)
class Search:
    """Candidates tried so far on the folds of one data set, and the settings decided so far."""

    spec: StructuredSpec
    folds: Sequence[DataSet]
    seed: int
    announce: Callable[[str], None]
    decided: Settings = field(default_factory=dict)
    tried: list[Candidate] = field(default_factory=list)
    chosen: list[Candidate] = field(default_factory=list)
    certified: dict[int, bool] = field(default_factory=dict)  # by identity of the candidate

    def is_open(self, name: str) -> bool:
        """Whether the user left this setting to the log, and nothing decided it yet."""
        return bool(getattr(self.spec, name) == AUTO) and name not in self.decided

    def structured(self, question: str, settings: Settings) -> Candidate:
        """Candidate with neurons that has these settings and those decided, scored on the folds."""
        spec = self.completed(settings)
        settings = {name: getattr(spec, name) for name in self.spec.automatic_settings}
        known = self.already_tried(STRUCTURED, settings)
        if known is not None:
            return known
        best = best_of(self.tried) if self.tried else None
        return self.note(
            question, STRUCTURED, settings, structured_trial(spec, self.folds, self.seed, best)
        )

    def completed(self, settings: Settings) -> StructuredSpec:
        """Specification with these settings, those decided, and defaults for the others."""
        wanted = self.decided | settings
        if wanted.get("neurons") == 0:
            wanted["input_path"] = "none"  # there are no neurons for it to reach
        automatic = self.spec.automatic_settings
        return with_defaults(
            replace(self.spec, **{name: wanted[name] for name in automatic if name in wanted})
        )

    def linear(self, question: str, order: int, delay: int) -> Candidate:
        """Candidate that is a linear output-error model, scored on the folds."""
        settings = {"order": order, "delay": delay}
        known = self.already_tried(LINEAR, settings)
        if known is not None:
            return known
        return self.note(question, LINEAR, settings, linear_trial(self.folds, order, delay))

    def value_of(self, name: str) -> Any:
        """Value of a setting as it was decided, or as the user has it."""
        return self.decided.get(name, getattr(self.spec, name))

    @property
    def integrates(self) -> bool:
        """Whether an integrator is set apart behind the model."""
        return self.value_of("integrating_output") is True

    @property
    def may_be_linear(self) -> bool:
        """Whether neither neurons nor an input or output map were asked for."""
        open_or_none = (AUTO, 0)
        sizes = (self.spec.neurons, self.spec.knots)
        return all(size in open_or_none for size in sizes) and self.spec.output_knots == 0

    def can_be_certified(self, candidate: Candidate) -> bool:
        """Whether a state feedback of the candidate's model is certified at any rate. True where
        the specification does not ask."""
        largest_rate = getattr(self.spec.among_starts, "largest_rate", None)
        if largest_rate is None or candidate.example is None:
            return True
        if id(candidate) not in self.certified:
            self.certified[id(candidate)] = largest_rate(candidate.example) > 0.0
        return self.certified[id(candidate)]

    def note(self, question: str, model: str, settings: Settings, trial: Trial) -> Candidate:
        """Add a candidate to the list, and print how it did."""
        candidate = Candidate(
            question=question,
            model=model,
            settings=settings,
            errors=trial.errors,
            start=trial.start,
            example=trial.example,
        )
        self.tried.append(candidate)
        self.announce(candidate.words)
        return candidate

    def already_tried(self, model: str, settings: Settings) -> Candidate | None:
        """The candidate with exactly these settings, if there is one."""
        alike = [one for one in self.tried if (one.model, one.settings) == (model, settings)]
        return alike[0] if alike else None

    def take(self, candidate: Candidate, settings: Settings) -> None:
        """Decide the open settings as this candidate has them."""
        self.chosen.append(candidate)
        self.decided |= {name: value for name, value in settings.items() if self.is_open(name)}

    def choice_of(self, candidate: Candidate | None) -> Choice:
        """Choice with all that was decided, and the sizes of this candidate."""
        decided = dict(self.decided)
        is_linear = candidate is not None and candidate.model == LINEAR
        if candidate is not None:
            without_neurons = {"neurons": 0, "knots": 0, "input_path": "none"}
            decided |= candidate.settings | (without_neurons if is_linear else {})
        automatic = self.spec.automatic_settings
        open_settings = {name: decided[name] for name in automatic if name in decided}
        chosen = [*self.chosen] if candidate is None else [*self.chosen, candidate]
        return Choice(
            spec=with_defaults(replace(self.spec, **open_settings)),
            rows=self.rows(chosen),
            error=None if candidate is None else candidate.mean_error,
            is_linear=is_linear,
        )

    def rows(self, chosen: Sequence[Candidate]) -> tuple[Row, ...]:
        """Table of the candidates that were tried."""
        return tuple(
            candidate.row(
                chosen=any(candidate is one for one in chosen),
                certified=self.certified.get(id(candidate)),
            )
            for candidate in self.tried
        )


def with_defaults(spec: StructuredSpec) -> StructuredSpec:
    """Specification with the default of `model=structured` for each setting that is still open."""
    return replace(spec, **{name: AUTOMATIC[name] for name in spec.automatic_settings})
