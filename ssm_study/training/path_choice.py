"""Whether the output answers within the sample, asked of the training and validation records."""

from dataclasses import replace
from typing import Any

import numpy as np

from ssm_study.data.splits import without_fold
from ssm_study.models.baselines.regression import output_error
from ssm_study.signals import DataSet, Trajectories, Trajectory
from ssm_study.training.metrics import mean_fit
from ssm_study.training.structured_choice import FIT, FOLDS, START_UP

ORDER = 3  # of the linear models that are compared
LEAST_GAIN = 3.0  # percent points of held-out fit: no loop is closed with a direct path
SHORTEST_FOLD = 4 * START_UP  # samples: in shorter held-out pieces the two cannot be told apart
Row = dict[str, Any]


def choose_feedthrough(data: DataSet) -> tuple[bool, list[Row]]:
    """True where a direct path from input to output predicts held-out pieces better; and the table.

    Linear output-error models of one order, with and without the input of the same sample, are
    compared on folds of the training and validation records, each fold's fit at least zero. The
    path must gain `LEAST_GAIN` on average and more than one standard error of its gains. No test
    record is looked at. False for several outputs and for short records.
    """
    both = (*data.training, *data.validation)
    longest = max(both, key=len)
    few = len(both) < FOLDS
    if data.scale.outputs != 1 or (few and len(longest) < FOLDS * SHORTEST_FOLD):
        return False, []
    fits = {delay: _held_out_fits(data, delay) for delay in (1, 0)}
    gains = fits[0] - fits[1]
    standard_error = float(gains.std(ddof=1)) / np.sqrt(len(gains))
    mean_gain = float(gains.mean())
    answers_at_once = bool(mean_gain > max(LEAST_GAIN, standard_error))
    rows = [
        {
            "model": "linear output error",
            "order": ORDER,
            "feedthrough": delay == 0,
            FIT: float(values.mean()),
            "fit_worst_fold_percent": float(values.min()),
            "chosen": (delay == 0) == answers_at_once,
        }
        for delay, values in fits.items()
    ]
    return answers_at_once, rows


def _held_out_fits(data: DataSet, delay: int) -> np.ndarray:
    """Fit to each held-out fold, percent, never below zero: one divergent piece decides nothing."""
    fits = []
    for fold in range(FOLDS):
        training, held_out = _without_fold((*data.training, *data.validation), fold)
        unscored = data.start_up_samples or START_UP
        part = replace(data, training=training, start_up_samples=unscored)
        with np.errstate(all="ignore"):
            fit = mean_fit(output_error(part, ORDER, delay), held_out, part)
        fits.append(max(fit, 0.0) if np.isfinite(fit) else 0.0)
    return np.array(fits)


def _without_fold(records: Trajectories, fold: int) -> tuple[Trajectories, Trajectories]:
    """Records that train and records that are held out: whole ones where there are enough, else
    pieces of the long ones."""
    if len(records) >= FOLDS:
        kept = tuple(record for k, record in enumerate(records) if k % FOLDS != fold)
        return kept, records[fold::FOLDS]
    training: list[Trajectory] = []
    held_out: list[Trajectory] = []
    for record in records:
        if len(record) < FOLDS * SHORTEST_FOLD:
            training.append(record)
            continue
        pieces, out = without_fold(record, fold, FOLDS)
        training += pieces
        held_out.append(out)
    return tuple(training), tuple(held_out)
