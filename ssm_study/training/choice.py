"""Choose the settings of a model by its error on held-out folds. The model that a log deserves:
paths first, then sizes, by folds of training and validation.

Cheap models decide cheap questions: linear ones the delay, and how many states a linear model
needs; structured ones, trained for a few steps, decide the rest. Of candidates that are about as
good the smallest is taken. The test records are not looked at. What is fixed in the specification
stays fixed. Why so, and what was tried: docs/models.md, "What the log decides".
"""

from collections.abc import Callable, Iterator

from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.choice_of_paths import choose_delay, choose_input_path, choose_integrator
from ssm_study.training.choice_of_size import first_certified, sized_candidates
from ssm_study.training.folds import folds_of
from ssm_study.training.search import Choice, Search, with_defaults

MOST_TRAINED = 3  # choices, one after the other, until a model of one is certified


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
    """Choice of the settings, and after it those that would be made if no model of it could be
    certified. The paths are the same in all."""
    folds = folds_of(data) if spec.automatic_settings else ()
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
    """Return a function that prints a line per candidate where somebody watches, else nothing."""
    from rich.console import Console

    console = Console(stderr=True)
    if not (progress and console.is_terminal):
        return lambda _: None
    return lambda words: console.print(f"choice by folds: {words}", highlight=False)


def refit_words(fit_validation_percent: float) -> str:
    """Sentence on why the validation records were trained on, too."""
    return (
        f"; trained again with the validation records, which the training records alone predict "
        f"at {fit_validation_percent:.1f} % only"
    )
