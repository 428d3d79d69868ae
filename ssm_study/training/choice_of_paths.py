"""Choice of a model's dead time, integrator and input paths. Questions about the paths of a model,
in their order: how late the output answers, whether it is a running sum, whether the input reaches
the neurons."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from ssm_study.data.log_dynamics import first_response_lag
from ssm_study.signals import DataSet
from ssm_study.training.candidates import Settings, fit_linear_model
from ssm_study.training.folds import join_training_and_validation
from ssm_study.training.search import SettingsSearch

LATE = 3  # samples until the output answers, from which on a dead time is tried
SHORTEST = 200  # samples: of shorter records no lag is read
SLOW_ORDER = 3  # of the linear model whose slowest mode is looked at
DELAY_GAIN = 0.1  # of the error that a dead time must remove, and an integrator, and a free path
DIRECT_GAIN = 0.25  # a direct path more: with it no loop is closed
INTEGRATES = 0.99  # radius of a linear model's slowest mode above which an integrator is tried
CARRIES = 0.25  # share of the modes' gains that such modes have
TRIED_SIZE: Settings = {"order": 3, "neurons": 5, "knots": 16}  # while paths are chosen


def choose_delay(search: SettingsSearch, data: DataSet) -> None:
    """Choose the dead time of a model, or a feedthrough without dead time, by cross-validation.

    The samples until the output answers are read off the records. A dead time is compared where
    they are `LATE` or more, a direct path where they are none, or noise hides the answer: where the
    output surely answers one sample later, a direct path only stands in for what the model lacks.
    """
    lag = response_delay(data)
    if search.is_undecided("dead_time"):
        late = lag is not None and lag >= LATE and search.spec.feedthrough is not True
        values = (0, lag - 1) if lag is not None and late else (0,)
        choose_between_two_values(search, "dead time", "dead_time", values, DELAY_GAIN)
    if search.is_undecided("feedthrough"):
        values = (False, True) if lag in (None, 0) else (False,)
        choose_between_two_values(search, "direct path", "feedthrough", values, DIRECT_GAIN)


def choose_between_two_values(
    search: SettingsSearch, question: str, name: str, values: Sequence[object], gain: float
) -> None:
    """Choose the second of two values of a setting if it reduces the cross-validation error by
    enough, otherwise the first.

    Models of one size with and without it are compared; a single value is taken as it is.
    """
    if len(values) == 1:
        search.decided[name] = values[0]
        return
    size = TRIED_SIZE | {"input_path": "none"}
    without, with_it = (
        search.score_structured_model(question, size | {name: value}) for value in values
    )
    is_needed = without.is_clearly_worse(with_it, gain)
    adopted = with_it if is_needed else without
    index = int(is_needed)
    chosen_value = values[index]
    search.adopt_settings(adopted, {name: chosen_value})


def response_delay(data: DataSet) -> int | None:
    """Number of samples until the output first responds to the input in a data set; None if noise
    hides it."""
    all_records = join_training_and_validation(data)
    record = max(all_records.training, key=len)
    if len(record) <= SHORTEST:
        return None
    pairs_of_channels = product(record.u.T, record.y.T)
    lags = [first_response_lag(u, y) for u, y in pairs_of_channels]
    answered = [lag for lag in lags if lag is not None]
    return min(answered, default=None)


def choose_integrator(search: SettingsSearch, data: DataSet) -> None:
    """Choose by cross-validation whether the model has an integrator at its output. It is tried if
    a linear model nearly integrates."""
    if search.is_undecided("integrating_output"):
        neurons = search.spec.neurons
        tried = neurons != 0 and is_nearly_integrating(data)
        values = (False, True) if tried else (False,)
        choose_between_two_values(search, "integrator", "integrating_output", values, DELAY_GAIN)


def is_nearly_integrating(data: DataSet) -> bool:
    """Whether very slow modes make up a large part of the output of a linear model fitted to the
    data.

    A mode that a zero cancels says nothing: a model of more states than the records need has such
    modes anywhere.
    """
    if data.scale.outputs != 1:
        return False
    with np.errstate(all="ignore"):
        all_records = join_training_and_validation(data)
        slow_model = fit_linear_model(all_records, SLOW_ORDER, has_feedthrough=False)
        system = slow_model.system_with_disturbances
        modes, vectors = np.linalg.eig(system.a)
        modal_outputs = system.c @ vectors
        by_output = np.abs(modal_outputs).T
        complex_b = system.b + 0j
        modal_inputs = np.linalg.solve(vectors, complex_b)
        by_input = np.abs(modal_inputs)
        residues = by_output * by_input
        moduli = np.abs(modes)
        radii = np.minimum(moduli, 1.0 - 1e-9)
        mode_gains = residues.sum(axis=1)
        gains = mode_gains / (1.0 - radii)
    integrating_gains = gains[radii > INTEGRATES]
    total_gain = gains.sum()
    share = integrating_gains.sum() / total_gain
    return bool(share > CARRIES)


def choose_input_path(search: SettingsSearch) -> None:
    """Choose by cross-validation whether the input acts on the neurons directly. With an integrator
    it never does, since neurons that can cut off the input prevent every certificate."""
    if not search.is_undecided("input_path"):
        return
    if search.has_integrator or search.spec.neurons == 0:
        search.decided["input_path"] = "none"
        return
    paths = ("none", "free")
    choose_between_two_values(search, "input path", "input_path", paths, DELAY_GAIN)
