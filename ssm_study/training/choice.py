"""The model that a log deserves: paths first, then sizes, by folds of training and validation.

Cheap models decide cheap questions: linear ones the delay, and how many states a linear model
needs; structured ones, trained for a few steps, decide the rest. Of candidates that are about as
good the smallest is taken. The test records are not looked at. What is fixed in the specification
stays fixed. Why so, and what was tried: docs/models.md, "What the log decides".
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from ssm_study.data.log_dynamics import first_answer
from ssm_study.models.baselines.regression import output_error
from ssm_study.models.structured_spec import AUTO, AUTOMATIC, StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.candidates import (
    Candidate,
    Row,
    Settings,
    best_of,
    first_not_behind,
    linear_errors,
    structured_errors,
)
from ssm_study.training.folds import FOLDS, folds_of, with_joined_records

LINEAR = "linear output error"
STRUCTURED = "structured"
LATE = 3  # samples until the output answers, from which on a dead time is tried
SHORTEST = 200  # samples: of shorter records no lag is read
SLOW_ORDER = 3  # of the linear model whose slowest mode is looked at
DELAY_GAIN = 0.1  # of the error that a dead time must remove, and an integrator, and a free path
DIRECT_GAIN = 0.25  # a direct path more: with it no loop is closed
INTEGRATES = 0.99  # radius of a linear model's slowest mode above which an integrator is tried
REFIT_BEYOND = 1.25  # times the error on held-out folds
LINEAR_ORDERS = (2, 4, 6, 10)
TRIED_SIZE: Settings = {"order": 3, "neurons": 5, "knots": 16}  # while paths are chosen
SIZES: tuple[Settings, ...] = (  # the smallest first
    {"order": 3, "neurons": 0, "knots": 16},
    {"order": 3, "neurons": 1, "knots": 0},
    TRIED_SIZE,
)
LARGER: tuple[Settings, ...] = (  # one by one, while all that are smaller are behind
    {"order": 5, "neurons": 5, "knots": 16},
    {"order": 8, "neurons": 5, "knots": 16},
)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The specification with everything decided, the table of what was tried, and the mean error
    of the chosen model on held-out folds, percent; without a table nothing was tried."""

    spec: StructuredSpec
    rows: tuple[Row, ...] = ()
    error: float | None = None

    def words(self, automatic: Sequence[str]) -> str:
        """Settings that were left open and what was chosen, of how many; "" if nothing was."""
        if not self.rows:
            return ""
        settings = ", ".join(
            f"{spoken(name)} {spoken(getattr(self.spec, name))}" for name in automatic
        )
        return f"{settings}: of {len(self.rows)} models compared on {FOLDS} folds"

    def asks_for_refit(self, fit_validation_percent: float) -> bool:
        """Whether validation records are predicted far worse than held-out folds are: then the
        training records do not show what the others do."""
        if self.error is None or not self.spec.refit:
            return False
        return 100.0 - fit_validation_percent > REFIT_BEYOND * self.error


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

    def is_open(self, name: str) -> bool:
        """Whether the user left this setting to the log, and nothing decided it yet."""
        return bool(getattr(self.spec, name) == AUTO) and name not in self.decided

    def structured(self, question: str, settings: Settings) -> Candidate:
        """A structured model with these settings and those decided, compared on the folds."""
        spec = self.completed(settings)
        settings = {name: getattr(spec, name) for name in self.spec.automatic}
        known = self.already_tried(STRUCTURED, settings)
        if known is not None:
            return known
        best = best_of(self.structured_candidates) if self.structured_candidates else None
        errors = structured_errors(spec, self.folds, self.seed, best)
        return self.note(question, STRUCTURED, settings, errors)

    def completed(self, settings: Settings) -> StructuredSpec:
        """The specification with these settings, those decided, and defaults for the others."""
        wanted = self.decided | settings
        if wanted.get("neurons") == 0:
            wanted["input_path"] = "none"  # there are no neurons for it to reach
        automatic = self.spec.automatic
        return with_defaults(
            replace(self.spec, **{name: wanted[name] for name in automatic if name in wanted})
        )

    def linear(self, question: str, order: int, delay: int) -> Candidate:
        """A linear output-error model, compared on the folds."""
        settings = {"order": order, "delay": delay}
        known = self.already_tried(LINEAR, settings)
        if known is not None:
            return known
        return self.note(question, LINEAR, settings, linear_errors(self.folds, order, delay))

    def note(self, question: str, model: str, settings: Settings, errors: np.ndarray) -> Candidate:
        """Put a candidate on the list, and say how it did."""
        candidate = Candidate(question=question, model=model, settings=settings, errors=errors)
        self.tried.append(candidate)
        self.announce(candidate.words)
        return candidate

    def already_tried(self, model: str, settings: Settings) -> Candidate | None:
        """The candidate with exactly these settings, if there is one."""
        alike = [one for one in self.tried if (one.model, one.settings) == (model, settings)]
        return alike[0] if alike else None

    @property
    def structured_candidates(self) -> list[Candidate]:
        return [candidate for candidate in self.tried if candidate.model == STRUCTURED]

    def take(self, candidate: Candidate, settings: Settings) -> None:
        """Decide settings that are open, by this candidate."""
        self.chosen.append(candidate)
        self.decided |= {name: value for name, value in settings.items() if self.is_open(name)}

    def rows(self) -> tuple[Row, ...]:
        """The table of what was tried."""
        return tuple(
            candidate.row(chosen=any(candidate is one for one in self.chosen))
            for candidate in self.tried
        )


def choose_model(
    spec: StructuredSpec, data: DataSet, seed: int, announce: Callable[[str], None]
) -> Choice:
    """Decide every setting that is `auto`, and return the table of what was tried.

    Records too short for folds choose nothing: the defaults of `model=structured` are taken.
    """
    folds = folds_of(data) if spec.automatic else ()
    if not folds:
        return Choice(spec=with_defaults(spec))
    search = Search(spec=spec, folds=folds, seed=seed, announce=announce)
    choose_delay(search, data)
    choose_integrator(search, data)
    choose_input_path(search)
    final = choose_size(search)
    return Choice(
        spec=with_defaults(replace(spec, **search.decided)),
        rows=search.rows(),
        error=None if final is None else final.mean_error,
    )


def announcer(progress: bool) -> Callable[[str], None]:
    """Prints a line a candidate where somebody watches, else nothing."""
    from rich.console import Console

    console = Console(stderr=True)
    if not (progress and console.is_terminal):
        return lambda _: None
    return lambda words: console.print(f"choice by folds: {words}", highlight=False)


def refit_words(fit_validation_percent: float) -> str:
    """Why the validation records were trained on, too."""
    return (
        f"; trained again with the validation records, which the training records alone predict "
        f"at {fit_validation_percent:.1f} % only"
    )


def with_defaults(spec: StructuredSpec) -> StructuredSpec:
    """The specification with the default of `model=structured` for what is still open."""
    return replace(spec, **{name: AUTOMATIC[name] for name in spec.automatic})


def choose_delay(search: Search, data: DataSet) -> None:
    """Decide whether the output answers late, or within the sample.

    The samples until the output answers are read off the records. A dead time is compared where
    they are `LATE` or more, a direct path where they are none or one, or noise hides the answer.
    """
    lag = answering_lag(data)
    if search.is_open("dead_time"):
        late = lag is not None and lag >= LATE and search.spec.feedthrough is not True
        values = (0, lag - 1) if lag is not None and late else (0,)
        decide(search, "dead time", "dead_time", values, DELAY_GAIN)
    if search.is_open("feedthrough"):
        values = (False, True) if lag is None or lag < LATE - 1 else (False,)
        decide(search, "direct path", "feedthrough", values, DIRECT_GAIN)


def decide(search: Search, question: str, name: str, values: Sequence[object], gain: float) -> None:
    """Take the second value of a setting where it removes that share of the error, else the first.

    Models of one size with and without it are compared; a single value is taken as it is.
    """
    if len(values) == 1:
        search.decided[name] = values[0]
        return
    size = TRIED_SIZE | {"input_path": "none"}
    without, with_it = (search.structured(question, size | {name: value}) for value in values)
    is_needed = without.is_behind(with_it, gain)
    search.take(with_it if is_needed else without, {name: values[int(is_needed)]})


def answering_lag(data: DataSet) -> int | None:
    """Samples until the output first answers any input; None where noise hides it."""
    record = max(with_joined_records(data).training, key=len)
    lags = [
        first_answer(u, y)
        for u, y in product(record.u.T, record.y.T)
        if np.ptp(u) > 0 and np.ptp(y) > 0 and len(record) > SHORTEST
    ]
    answered = [lag for lag in lags if lag is not None]
    return min(answered, default=None)


def choose_integrator(search: Search, data: DataSet) -> None:
    """Decide whether the output is a running sum: tried where a linear model nearly integrates."""
    if search.is_open("integrating_output"):
        tried = search.spec.neurons != 0 and nearly_integrates(data)
        values = (False, True) if tried else (False,)
        decide(search, "integrator", "integrating_output", values, DELAY_GAIN)


def nearly_integrates(data: DataSet) -> bool:
    """Whether the slowest mode of a linear model hardly forgets; no for several outputs."""
    if data.scale.outputs != 1:
        return False
    with np.errstate(all="ignore"):
        model = output_error(with_joined_records(data), SLOW_ORDER, 1)
    recursion = np.concatenate([[1.0], -model.theta[1 : SLOW_ORDER + 1]])
    return bool(np.abs(np.roots(recursion)).max() > INTEGRATES)


def choose_input_path(search: Search) -> None:
    """Decide whether the input reaches the neurons. With an integrator it never does: neurons that
    can cut off the input leave nothing that could be certified."""
    if not search.is_open("input_path"):
        return
    integrates = search.decided.get("integrating_output", search.spec.integrating_output) is True
    if integrates or search.spec.neurons == 0:
        search.decided["input_path"] = "none"
        return
    decide(search, "input path", "input_path", ("none", "free"), DELAY_GAIN)


def choose_size(search: Search) -> Candidate | None:
    """Decide order, neurons and knots: the smallest candidate that is not behind the best.

    Linear models of growing order are tried by output error first, and the best of them as a
    structured model without neurons. None where nothing is open.
    """
    if not any(search.is_open(name) for name in ("order", "neurons", "knots")):
        return None
    integrates = search.decided.get("integrating_output", search.spec.integrating_output) is True
    # A model without neurons has no integrator set apart.
    settings = [size for size in SIZES if size["neurons"] or not integrates]
    if not integrates:
        settings = linear_sizes(search) + settings
    candidates = [search.structured("size", size) for size in settings]
    needs_order = settings[0]["order"] > TRIED_SIZE["order"]
    for larger in LARGER:
        chosen = first_not_behind(candidates)
        if chosen is not candidates[-1] and not needs_order:
            break
        needs_order = False
        settings.append(larger)
        candidates.append(search.structured("size", larger))
    chosen = first_not_behind(candidates)
    search.take(chosen, settings[candidates.index(chosen)])
    return chosen


def linear_sizes(search: Search) -> list[Settings]:
    """The linear model of the smallest order that is not behind the best of several."""
    if search.folds[0].scale.outputs != 1 or not search.is_open("order"):
        return []
    feedthrough = search.decided.get("feedthrough", search.spec.feedthrough) is True
    dead_time = int(search.decided.get("dead_time", search.spec.dead_time))
    delay = 0 if feedthrough else 1 + dead_time
    tried = [search.linear("linear order", order, delay) for order in LINEAR_ORDERS]
    order = first_not_behind(tried).settings["order"]
    return [{"order": order, "neurons": 0, "knots": 0}]
