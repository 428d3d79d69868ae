"""Choice of a model's settings by cross-validation, its error on held-out parts of the records. The
model that a log deserves: paths first, then sizes, by folds of training and validation.

Cheap models decide cheap questions: linear ones the delay, and how many states a linear model
needs; structured ones, trained for a few steps, decide the rest. Of candidates that are about as
good the smallest is taken. The test records are not looked at. What is fixed in the specification
stays fixed. Why so, and what was tried: docs/models.md, "What the log decides".
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice

from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.candidates import Candidate
from ssm_study.training.choice_of_leader import find_uncertified_leader, offer_leader
from ssm_study.training.choice_of_paths import choose_delay, choose_input_path, choose_integrator
from ssm_study.training.choice_of_products import choose_bilinear_model
from ssm_study.training.choice_of_regression import (
    add_clearly_better_regression,
    choose_regression,
    score_regressions,
)
from ssm_study.training.choice_of_size import (
    decide_on_integrator,
    models_of_other_structure,
    simplest_certifiable_candidate,
    try_model_sizes,
)
from ssm_study.training.folds import make_folds
from ssm_study.training.search import SettingsChoice, SettingsSearch, fill_in_defaults

REFIT_WORDS = "; trained on the training and validation records"
MOST_TRAINED = 3  # choices beside a leader, one after the other, until a model is certified


def iterate_model_choices(
    spec: StructuredSpec, data: DataSet, seed: int, print_line: Callable[[str], None]
) -> Iterator[SettingsChoice]:
    """Iterate over complete model settings, chosen by cross-validation, from the best to ones that
    are easier to certify.

    The paths are the same in all. Records too short for folds choose nothing: the defaults of
    `model=structured` are taken.
    """
    folds = make_folds(data) if spec.automatic_settings else ()
    if not folds:
        yield SettingsChoice(spec=fill_in_defaults(spec))
        return
    search = SettingsSearch(spec=spec, folds=folds, seed=seed, announce=print_line)
    choose_delay(search, data)
    choose_integrator(search, data)
    also_integrating = decide_on_integrator(search)
    choose_input_path(search)
    candidates = try_model_sizes(search, also_integrating=also_integrating)
    if not candidates:
        yield search.build_settings_choice(None)
        return
    regressions = score_regressions(search)
    predictor = choose_bilinear_model(search, data)
    regression = None
    if predictor is None:
        regression = choose_regression(search, candidates, regressions)
    if predictor is None and regression is None:
        candidates = add_clearly_better_regression(candidates, regressions)
    leader = find_uncertified_leader(search, candidates) if regression is None else None
    if leader is not None:
        yield from offer_leader(search, leader, predictor)
    others = iterate_over_candidates(search, candidates, regression, predictor)
    yield from islice(others, MOST_TRAINED)


def iterate_over_candidates(
    search: SettingsSearch,
    candidates: list[Candidate],
    regression: Candidate | None,
    predictor: BilinearSpec | None,
) -> Iterator[SettingsChoice]:
    """Iterate over the choices that a regression and candidate models make, from the best to ones
    that are easier to certify. A candidate whose training was not certified is removed."""
    if regression is not None:
        yield search.build_settings_choice(regression)
    while candidates:
        chosen = simplest_certifiable_candidate(search, candidates)
        others = models_of_other_structure(candidates, chosen)
        choice = search.build_settings_choice(chosen, others)
        yield replace(choice, predictor=predictor)
        if not search.is_certifiable(chosen):  # then none of them can
            return
        search.certified[id(chosen)] = False  # trained on all records it was not
        candidates.remove(chosen)


def make_progress_printer(progress: bool, task: str = "choice by folds") -> Callable[[str], None]:
    """Make a function that prints progress lines of a task, or that does nothing if progress is
    switched off."""
    from rich.console import Console

    console = Console(stderr=True)
    if not (progress and console.is_terminal):
        return lambda _: None
    return lambda words: console.print(f"{task}: {words}", highlight=False)
