"""The model that a log deserves: paths first, then sizes, by folds of training and validation.

Cheap models decide cheap questions: linear ones the delay, and how many states a linear model
needs; structured ones, trained for a few steps, decide the rest. Of candidates that are about as
good the smallest is taken. The test records are not looked at. What is fixed in the specification
stays fixed. Why so, and what was tried: docs/models.md, "What the log decides".
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from ssm_study.data.log_dynamics import first_answer
from ssm_study.models.structured_spec import AUTO, AUTOMATIC, StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.candidates import (
    Candidate,
    Row,
    Settings,
    Trial,
    best_of,
    first_not_behind,
    linear_model,
    linear_trial,
    structured_trial,
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
CARRIES = 0.25  # share of the modes' gains that such modes have
MOST_TRAINED = 3  # choices, one after the other, until a model of one is certified
REFIT_BEYOND = 1.25  # times the error on held-out folds
LINEAR_ORDERS = (1, 2, 3, 4, 6, 8, 10)
HIGH_LINEAR_ORDERS = (14, 20)  # one by one, while all that are smaller are behind
ONE_LAYER_ORDERS = (3, 8)  # least and most
TRIED_SIZE: Settings = {"order": 3, "neurons": 5, "knots": 16}  # while paths are chosen
SIZES: tuple[Settings, ...] = (  # the smallest first; with one layer before them
    {"order": 3, "neurons": 1, "knots": 0},
    TRIED_SIZE,
)
INTEGRATING_SIZES: tuple[Settings, ...] = (  # one friction neuron on a velocity can be certified
    {"order": 1, "neurons": 1, "knots": 0},
    {"order": 1, "neurons": 2, "knots": 0},
    {"order": 2, "neurons": 1, "knots": 0},
    *SIZES,
)
LARGER: tuple[Settings, ...] = (  # one by one, while all that are smaller are behind
    {"order": 5, "neurons": 5, "knots": 16},
    {"order": 8, "neurons": 5, "knots": 16},
)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The specification with everything decided, the table of what was tried, and the mean error
    of the chosen model on held-out folds, percent; without a table nothing was tried.

    `is_linear`: the output-error model itself is to be taken, of this order and delay.
    """

    spec: StructuredSpec
    rows: tuple[Row, ...] = ()
    error: float | None = None
    is_linear: bool = False

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
    certified: dict[int, bool] = field(default_factory=dict)  # by identity of the candidate

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
        best = best_of(self.tried) if self.tried else None
        return self.note(
            question, STRUCTURED, settings, structured_trial(spec, self.folds, self.seed, best)
        )

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
        return self.note(question, LINEAR, settings, linear_trial(self.folds, order, delay))

    def value_of(self, name: str) -> Any:
        """A setting as it was decided, or as the user has it."""
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
        """Whether a state feedback of its example is certified at any rate; yes where nobody
        asks."""
        largest_rate = getattr(self.spec.among_starts, "largest_rate", None)
        if largest_rate is None or candidate.example is None:
            return True
        if id(candidate) not in self.certified:
            self.certified[id(candidate)] = largest_rate(candidate.example) > 0.0
        return self.certified[id(candidate)]

    def note(self, question: str, model: str, settings: Settings, trial: Trial) -> Candidate:
        """Put a candidate on the list, and say how it did."""
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
        """Decide settings that are open, by this candidate."""
        self.chosen.append(candidate)
        self.decided |= {name: value for name, value in settings.items() if self.is_open(name)}

    def choice_of(self, candidate: Candidate | None) -> Choice:
        """The specification with all that was decided, and the sizes of this candidate."""
        decided = dict(self.decided)
        is_linear = candidate is not None and candidate.model == LINEAR
        if candidate is not None:
            without_neurons = {"neurons": 0, "knots": 0, "input_path": "none"}
            decided |= candidate.settings | (without_neurons if is_linear else {})
        automatic = self.spec.automatic
        open_settings = {name: decided[name] for name in automatic if name in decided}
        chosen = [*self.chosen] if candidate is None else [*self.chosen, candidate]
        return Choice(
            spec=with_defaults(replace(self.spec, **open_settings)),
            rows=self.rows(chosen),
            error=None if candidate is None else candidate.mean_error,
            is_linear=is_linear,
        )

    def rows(self, chosen: Sequence[Candidate]) -> tuple[Row, ...]:
        """The table of what was tried."""
        return tuple(
            candidate.row(
                chosen=any(candidate is one for one in chosen),
                certified=self.certified.get(id(candidate)),
            )
            for candidate in self.tried
        )


def choose_model(
    spec: StructuredSpec, data: DataSet, seed: int, announce: Callable[[str], None]
) -> Choice:
    """Decide every setting that is `auto`, and return the table of what was tried.

    Records too short for folds choose nothing: the defaults of `model=structured` are taken.
    """
    return next(ranked_choices(spec, data, seed, announce))


def ranked_choices(
    spec: StructuredSpec, data: DataSet, seed: int, announce: Callable[[str], None]
) -> Iterator[Choice]:
    """The choice, and after it those that would be made if no model of it could be certified; the
    paths are the same in all."""
    folds = folds_of(data) if spec.automatic else ()
    if not folds:
        yield Choice(spec=with_defaults(spec))
        return
    search = Search(spec=spec, folds=folds, seed=seed, announce=announce)
    choose_delay(search, data)
    choose_integrator(search, data)
    choose_input_path(search)
    candidates = sized_candidates(search)
    if not candidates:
        yield search.choice_of(None)
    while candidates:
        chosen = first_certified(search, candidates)
        yield search.choice_of(chosen)
        if not search.can_be_certified(chosen):  # then none of them can
            return
        search.certified[id(chosen)] = False  # trained on all records it was not
        candidates.remove(chosen)


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
    """Whether modes of a linear model that hardly forget make a good part of the output; no for
    several outputs.

    A mode that a zero cancels says nothing: a model of more states than the records need has such
    modes anywhere.
    """
    if data.scale.outputs != 1:
        return False
    with np.errstate(all="ignore"):
        system = linear_model(with_joined_records(data), SLOW_ORDER, direct=False).linear
        modes, vectors = np.linalg.eig(system.a)
        residues = np.abs(system.c @ vectors).T * np.abs(np.linalg.solve(vectors, system.b + 0j))
        radii = np.minimum(np.abs(modes), 1.0 - 1e-9)
        gains = residues.sum(axis=1) / (1.0 - radii)
    share = gains[radii > INTEGRATES].sum() / gains.sum()
    return bool(share > CARRIES)


def choose_input_path(search: Search) -> None:
    """Decide whether the input reaches the neurons. With an integrator it never does: neurons that
    can cut off the input leave nothing that could be certified."""
    if not search.is_open("input_path"):
        return
    if search.integrates or search.spec.neurons == 0:
        search.decided["input_path"] = "none"
        return
    decide(search, "input path", "input_path", ("none", "free"), DELAY_GAIN)


def sized_candidates(search: Search) -> list[Candidate]:
    """Candidates for order, neurons and knots, the smallest first; none where nothing is open.

    Linear models of growing order are tried by output error first.
    """
    if not any(search.is_open(name) for name in ("order", "neurons", "knots")):
        return []
    candidates = [] if search.integrates else static_input_sizes(search)
    sizes = INTEGRATING_SIZES if search.integrates else SIZES
    candidates += [search.structured("size", size) for size in sizes]
    needs_order = int(candidates[0].settings["order"]) > int(TRIED_SIZE["order"])
    for larger in LARGER:
        if first_not_behind(candidates) is not candidates[-1] and not needs_order:
            break
        needs_order = False
        candidates.append(search.structured("size", larger))
    return candidates


def static_input_sizes(search: Search) -> list[Candidate]:
    """Candidates without neurons: the best linear one, and one layer of about its order."""
    order = int(TRIED_SIZE["order"])
    candidates = []
    if search.folds[0].scale.outputs == 1 and search.is_open("order"):
        linear = best_linear(search)
        order = int(linear.settings["order"])
        candidates.append(
            linear
            if search.may_be_linear
            else search.structured("size", {"order": order, "neurons": 0, "knots": 0})
        )
    least, most = ONE_LAYER_ORDERS
    one_layer = {"order": min(max(order, least), most), "neurons": 0, "knots": 16}
    return [*candidates, search.structured("size", one_layer)]


def best_linear(search: Search) -> Candidate:
    """The linear output-error model of the smallest order that is not behind the best."""
    feedthrough = search.value_of("feedthrough") is True
    delay = 0 if feedthrough else 1 + int(search.value_of("dead_time"))
    tried = [search.linear("linear order", order, delay) for order in LINEAR_ORDERS]
    for order in HIGH_LINEAR_ORDERS:
        if first_not_behind(tried) is not tried[-1]:
            break
        tried.append(search.linear("linear order", order, delay))
    return first_not_behind(tried)


def first_certified(search: Search, candidates: Sequence[Candidate]) -> Candidate:
    """The smallest candidate that is not behind the best of those that can be certified; where none
    can, of all.

    Certificates are asked for as they are needed, of the model trained without the last fold.
    """
    left = list(candidates)
    while left:
        chosen = first_not_behind(left)
        if search.can_be_certified(chosen):
            return chosen
        left.remove(chosen)
    return first_not_behind(candidates)
