"""Best of several simple models, reported for comparison with the model fitted to a log.

ARX, output error and polynomial NARX of several sizes are fitted to the training records. The one
that simulates the validation records best is scored on the test records. The kind of initial state
from which it runs is chosen in the same way: measured outputs, a state estimated from the first
samples, or one simulated from the log before (`models.baselines.starts`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssm_study.models.baselines.regression import (
    INPUT,
    NarxModel,
    fit_arx,
    fit_narx_models,
    fit_output_error,
)
from ssm_study.models.baselines.starts import OUTPUTS, STARTS, simulate_by_kind_of_start
from ssm_study.models.metrics import Simulation
from ssm_study.signals import DataSet

SHORTEST = 60  # samples: of fewer, a regression says nothing
ARX_ORDERS = (1, 2, 3, 4, 6, 8, 10, 15, 20)
DELAYS = (0, 1, 2, 3, 5, 8)
OUTPUT_ERROR_ORDERS = (1, 2, 3, 4, 6)
NARX_LAGS = (2, 3)
NARX_DEGREES = (2, 3)
NARX_TERMS = (4, 6, 9, 12, 16, 20)
MOST_STARTED = 10  # regressions that are run from every kind of initial state


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Simple fitted model for comparison, with its description and its fit to the validation
    records."""

    words: str
    model: NarxModel
    fit_validation_percent: float
    start: str = OUTPUTS

    def simulate_test(self, data: DataSet) -> Simulation:
        """Free run of a baseline model on the test records."""
        with np.errstate(all="ignore"):
            runs = simulate_by_kind_of_start(self.model, data, data.test, (self.start,))
        return runs[self.start]

    def test_fit_percent(self, data: DataSet) -> float:
        """Fit of a baseline model to the test records in percent; minus infinity if its simulation
        diverges."""
        with np.errstate(all="ignore"):
            return fit_or_minus_infinity(self.simulate_test(data))


def fit_best_baseline(data: DataSet) -> Baseline | None:
    """Fit several simple models for comparison, and return the one with the best fit to the
    validation records.

    None for several outputs, and where the records are too short.
    """
    return max(fit_baselines(data), key=_validation_fit, default=None)


def fit_baselines(data: DataSet) -> list[Baseline]:
    """Fit several simple models (ARX, output error, NARX) for comparison, and compute their fits to
    the validation records.

    Empty for several outputs, and where the records are too short. ARX with up to 20 lags, output
    error with up to 6, NARX of degree 2 and 3 with up to 20 terms; delays up to 8 samples, 0 where
    the input acts at once. Output-error models and the best of the others are run from every kind
    of initial state, the rest from measured outputs only.
    """
    longest = max(len(record) for record in data.training)
    if data.scale.outputs != 1 or longest < SHORTEST:
        return []
    orders = [order for order in ARX_ORDERS if 4 * order < longest]
    tried = [
        _score_baseline(f"ARX with {order} lags, delay {delay}", fit_arx(data, order, delay), data)
        for order in orders
        for delay in DELAYS
    ]
    best_arx = max(tried, key=_validation_fit)
    delay = int(_shortest_input_lag(best_arx.model))
    for lags in NARX_LAGS:
        for degree in NARX_DEGREES:
            for late in sorted({0, 1, delay}):
                for model in fit_narx_models(data, lags, degree, late, NARX_TERMS):
                    tried.append(_score_baseline(_describe_narx(degree, model), model, data))
    tried.sort(key=_validation_fit, reverse=True)
    best = [_score_baseline(each.words, each.model, data, STARTS) for each in tried[:MOST_STARTED]]
    output_error = []
    for order in OUTPUT_ERROR_ORDERS:
        words = f"an output-error model with {order} lags, delay {delay}"
        model = fit_output_error(data, order, delay)
        output_error.append(_score_baseline(words, model, data, STARTS))
    return [*best, *output_error, *tried[MOST_STARTED:]]


def _score_baseline(
    description: str, model: NarxModel, data: DataSet, starts: Sequence[str] = (OUTPUTS,)
) -> Baseline:
    """Compute the validation fit of a simple model, with the best of several kinds of initial
    states."""
    with np.errstate(all="ignore"):
        runs = simulate_by_kind_of_start(model, data, data.validation, starts)
        fits = {start: fit_or_minus_infinity(run) for start, run in runs.items()}
    best = max(fits, key=fits.__getitem__)
    return Baseline(words=description, model=model, fit_validation_percent=fits[best], start=best)


def fit_or_minus_infinity(run: Simulation) -> float:
    """Fit of a free-run simulation in percent; minus infinity if the simulation diverges."""
    fit = run.fit_percent
    return fit if np.isfinite(fit) else -np.inf


def _describe_narx(degree: int, model: NarxModel) -> str:
    """Description of a polynomial NARX model in words."""
    return f"a polynomial NARX of degree {degree} with {len(model.theta)} terms"


def _validation_fit(baseline: Baseline) -> float:
    """Fit of a simple comparison model to the validation records, in percent."""
    return baseline.fit_validation_percent


def _shortest_input_lag(model: NarxModel) -> int:
    """Smallest input delay among the terms of a polynomial NARX model, in samples."""
    inputs = model.codes[model.codes >= INPUT]
    return int((inputs % 1000).min())
