"""Best simple models beside the model of a log, as columns of the results table.

A log of several outputs has one simple model for each output, driven by all inputs. Source:
docs/models.md, "Baselines".
"""

from dataclasses import dataclass

import numpy as np

from ssm_study.models.best_baseline import (
    Baseline,
    fit_baselines,
    fit_best_baseline,
    fit_or_minus_infinity,
)
from ssm_study.models.metrics import Simulation
from ssm_study.signals import DataSet

VALIDATES_AS_WELL = 1.0  # point of validation fit that a baseline may be behind the best


@dataclass(frozen=True, kw_only=True)
class BaselineOfEachOutput:
    """Best simple model of each output, with a description of all."""

    parts: tuple[Baseline, ...]
    words: str

    def test_fit_percent(self, data: DataSet) -> float:
        """Fit of all outputs together to the test records in percent; minus infinity if a
        simulation diverges."""
        runs = [
            part.simulate_test(data.with_one_output(number))
            for number, part in enumerate(self.parts)
        ]
        by_record = zip(*(run.simulated for run in runs), strict=True)
        together = tuple(np.hstack(outputs) for outputs in by_record)
        simulation = Simulation(
            records=data.test, simulated=together, start_up_samples=data.start_up_samples
        )
        with np.errstate(all="ignore"):
            return fit_or_minus_infinity(simulation)


def fit_baseline_of_each_output(data: DataSet) -> BaselineOfEachOutput | None:
    """Fit several simple models to each output, and keep those with the best fits to the validation
    records; None where the records are too short."""
    parts = []
    words = []
    for number, output in enumerate(data.outputs):
        best = fit_best_baseline(data.with_one_output(number))
        if best is None:
            return None
        parts.append(best)
        words.append(f"{output.name}: {best.words}")
    return BaselineOfEachOutput(parts=tuple(parts), words="; ".join(words))


def baseline_columns(data: DataSet) -> dict[str, object] | None:
    """Table columns on the best simple model: its test fit, and the range of test fits of models
    with about equal validation fit.

    None where the records are too short for any of them. A fit is None if the simulation diverges.
    With several outputs there is no range.
    """
    data = data.with_disturbances_as_inputs()  # a baseline knows no other path
    if data.scale.outputs > 1:
        best_of_each = fit_baseline_of_each_output(data)
        return None if best_of_each is None else _test_columns(best_of_each, data)
    tried = fit_baselines(data)
    if not tried:
        return None
    best = max(tried, key=lambda each: each.fit_validation_percent)
    least_validation_fit = best.fit_validation_percent - VALIDATES_AS_WELL
    near = [each for each in tried if each.fit_validation_percent >= least_validation_fit]
    fits = [each.test_fit_percent(data) for each in near]
    return _test_columns(best, data) | {
        "fit_baseline_lowest_percent": _none_if_infinite(min(fits)),
        "fit_baseline_highest_percent": _none_if_infinite(max(fits)),
    }


def _test_columns(best: Baseline | BaselineOfEachOutput, data: DataSet) -> dict[str, object]:
    """Table columns on one simple model, or on one of each output: description and test fit."""
    fit = _none_if_infinite(best.test_fit_percent(data))
    return {"baseline": best.words, "fit_baseline_percent": fit}


def _none_if_infinite(fit: float) -> float | None:
    """Fit in percent, or None if the fit is infinite."""
    return fit if np.isfinite(fit) else None
