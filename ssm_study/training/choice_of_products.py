"""Choice of a bilinear model (with products of input and state), only where cross-validation
clearly prefers it.

A model of that class is fitted in a second (`models.bilinear_spec`), so it is tried on every log
that it can be fitted to, also where a direct path was chosen, which it lacks: neurons without a
product can need one only to make up for that. It predicts in place of the chosen model where its
error on held-out pieces is far below that of every other candidate. Control stays with the chosen
model, since what is proved of products of input and state is less (docs/models.md).
"""

from collections.abc import Sequence

import numpy as np

from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.models.metrics import Simulation
from ssm_study.models.warm_start import PAST, SAMPLES
from ssm_study.signals import DataSet
from ssm_study.training.candidates import (
    LARGEST_ERROR,
    Candidate,
    CandidateErrors,
    relative_rms_error,
)
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.search import PRODUCTS, SettingsSearch

PRODUCTS_GAIN = 0.25  # of the error of every other candidate that products must remove
SIZES = ((2, 3), (3, 5))  # states and nodes
STARTS = 4  # of the fit that predicts
FOLD_STEPS = 30  # of the fits that are compared on the folds
UNTRIED = {"dead_time": 0, "integrating_output": False}  # a direct path is compared on the folds


def choose_bilinear_model(search: SettingsSearch, data: DataSet) -> BilinearSpec | None:
    """Settings of a bilinear model if it predicts clearly better than every other candidate model,
    otherwise None."""
    others = [*search.tried]
    if not (others and can_try_bilinear_model(search, data)):
        return None
    candidates = [cross_validate_bilinear_model(search, order, nodes) for order, nodes in SIZES]
    best = min(candidates, key=lambda candidate: candidate.mean_error_percent)
    are_worse = (other.is_clearly_worse(best, PRODUCTS_GAIN) for other in others)
    if not all(are_worse):
        return None
    good_enough = (each for each in candidates if not each.is_clearly_worse(best))
    simplest = next(good_enough)
    search.chosen.append(simplest)
    order = int(simplest.settings["order"])
    nodes = int(simplest.settings["nodes"])
    return BilinearSpec(order=order, nodes=nodes, starts=STARTS)


def can_try_bilinear_model(search: SettingsSearch, data: DataSet) -> bool:
    """Whether a bilinear model can be fitted to the data and the user's settings leave room for
    one. It takes one input and no measured disturbance, and the user must have fixed neither size
    nor members."""
    input_count = data.scale.inputs
    is_simple = input_count == 1 and not data.disturbances
    sizes = ("order", "neurons")
    is_undecided = all(search.is_undecided(name) for name in sizes)
    is_alone = search.spec.members == 1
    lacks_nothing = all(search.setting_value(name) == value for name, value in UNTRIED.items())
    return is_simple and is_undecided and is_alone and lacks_nothing


def cross_validate_bilinear_model(search: SettingsSearch, order: int, nodes: int) -> Candidate:
    """Fit a bilinear model on every cross-validation fold, and compute its errors on the held-out
    parts."""
    spec = BilinearSpec(order=order, nodes=nodes, starts=1, steps=FOLD_STEPS)
    settings = {"order": order, "nodes": nodes}
    trial = bilinear_errors_on_folds(spec, search.folds)
    return search.add_candidate("prediction", PRODUCTS, settings, trial)


def bilinear_errors_on_folds(spec: BilinearSpec, folds: Sequence[DataSet]) -> CandidateErrors:
    """Free-run errors of a bilinear model on the held-out parts of the cross-validation folds. With
    one start the held-out part chooses nothing."""
    trial = CandidateErrors()
    for fold in folds:
        with np.errstate(all="ignore"):
            model = spec.fit_model(fold)
            run = Simulation.simulate_records(model, fold.test, fold.start_up_samples)
            error = relative_rms_error(run, fold)
            fit_training = records_fit_percent(model, fold.training, fold)
        finite = np.isfinite(fit_training)
        trial.example = model
        error_in_training = 100.0 - fit_training if finite else LARGEST_ERROR
        trial.training_errors.append(error_in_training)
        for name in (SAMPLES, PAST):
            trial.by_start[name].append(error)
    return trial
