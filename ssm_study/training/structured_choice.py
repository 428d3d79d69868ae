"""Order, neurons, input path and ridge of a structured model from the training records alone: by
held-out folds."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ssm_study.data.splits import without_fold
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.metrics import mean_fit
from ssm_study.training.structured_fit import StructuredFit

FOLDS = 4
ORDERS = (2, 3, 4, 6)
NEURONS = (2, 4)
PATHS = ("none", "staged")
RIDGES = (1e-6, 1e-4)
STEPS = 30  # inside the contracting set, each start of each fold
START_UP = 20  # samples of a held-out piece that estimate its state, where a data set names none
NEARLY = 0.3  # percent points: within so much of the best fit the smallest model is taken
FIT = "fit_held_out_percent"
Row = dict[
    str, Any
]  # sizes that were tried, their fit over the held-out folds and on the worst of them


def choose(spec: StructuredSpec, data: DataSet, seed: int) -> tuple[StructuredSpec, list[Row]]:
    """The spec with its sizes chosen, and the table of the choice; no validation or test record is
    looked at.

    First order and neurons on a grid, then the input path, then the ridge. The fit is that of the
    free run over the held-out pieces. Within `NEARLY` of the best the smallest model is taken.
    """
    folds = list(held_out(data))

    def tried(**sizes: Any) -> Row:
        fits = [_fit(replace(spec, **sizes), fold, seed) for fold in folds]
        return sizes | {FIT: float(np.mean(fits)), "fit_worst_fold_percent": min(fits)}

    given = {"input_path": spec.input_path, "ridge": spec.ridge}
    best = smallest(table := [tried(order=n, neurons=q, **given) for n in ORDERS for q in NEURONS])
    for name, values in (("input_path", PATHS), ("ridge", RIDGES)):
        table += [
            tried(**chosen(best) | {name: value})
            for value in values
            if value != getattr(spec, name)
        ]
        best = smallest(table)
    return replace(spec, **chosen(best)), [one | {"chosen": one is best} for one in table]


def chosen(row: Row) -> Row:
    """The sizes alone."""
    return {name: row[name] for name in ("order", "neurons", "input_path", "ridge")}


def smallest(table: list[Row]) -> Row:
    """Row of the smallest model among those within `NEARLY` of the best fit."""
    near = [one for one in table if one[FIT] >= max(other[FIT] for other in table) - NEARLY]
    return min(
        near,
        key=lambda one: (one["order"] + one["neurons"], one["input_path"] != "none", -one[FIT]),
    )


def held_out(data: DataSet) -> Iterator[DataSet]:
    """Training data with a fold taken out as `test`: whole records where there are enough, else
    pieces of each.

    A piece starts in motion, so its first samples estimate its state and are not scored.
    """
    if len(data.training) >= FOLDS:
        for k in range(FOLDS):
            kept = tuple(record for i, record in enumerate(data.training) if i % FOLDS != k)
            yield replace(data, training=kept, validation=kept, test=data.training[k::FOLDS])
        return
    unscored = data.start_up_samples or START_UP
    for k in range(FOLDS):
        parts = [without_fold(record, k, FOLDS) for record in data.training]
        kept = tuple(piece for pieces, _ in parts for piece in pieces)
        out = tuple(piece for _, piece in parts)
        yield replace(data, training=kept, validation=kept, test=out, start_up_samples=unscored)


def _fit(spec: StructuredSpec, fold: DataSet, seed: int) -> float:
    """Fit on the held-out pieces, percent, never below zero, of the start that fits the kept pieces
    best."""
    fits = [StructuredFit(spec, fold, seed + 1000 * start) for start in range(spec.starts)]
    for fit in fits:
        fit.advance(STEPS)
    best = min(fits, key=lambda fit: float(fit.loss))
    return (
        max(mean_fit(best.stored(), fold.test, fold), 0.0) if np.isfinite(float(best.loss)) else 0.0
    )
