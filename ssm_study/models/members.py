"""Mean output of several models that were trained on one log.

The mean of contracting models contracts, in their metrics side by side, at the largest factor of
its members. Nothing is designed on it: its states are those of all members, so that control stays
with one of them. Source: docs/models.md, "Several models, one mean".
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data.metrics import benchmark_rmse
from ssm_study.models.metrics import Simulation, numbered_columns
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.signals import DataSet

FITS = ("fit_validation_members_percent", "fit_test_members_percent")
NAMES = ("members", *FITS)


def mean_output_of_models(
    members: Sequence[Any],
    u: Float[np.ndarray, "*batch T m"],
    d: Float[np.ndarray, "*batch T k"] | None = None,
) -> Float[np.ndarray, "*batch T p"]:
    """Mean of the free-run outputs of several models (an ensemble), from the equilibrium. Measured
    disturbances that are not given stay at their equilibrium."""
    loads = {} if d is None else {"d": d}
    outputs_of_members = [model.simulate(u, **loads) for model in members]
    return np.mean(outputs_of_members, axis=0)


def simulate_ensemble_mean(members: Sequence[Any], data: DataSet) -> tuple[Simulation, Simulation]:
    """Simulate the validation and test records by the mean output of several models (an ensemble).
    The kind of initial state is the one that predicts better."""
    runs = [simulate_validation_and_test(model, data) for model in members]
    validation, test = zip(*runs, strict=True)
    return mean_simulation(validation), mean_simulation(test)


def mean_simulation(runs: Sequence[Simulation]) -> Simulation:
    """Average of several models' simulated outputs on the same records."""
    simulated_records = (run.simulated for run in runs)
    by_record = zip(*simulated_records, strict=True)
    mean_outputs = (np.mean(outputs, axis=0) for outputs in by_record)
    means = tuple(mean_outputs)
    return replace(runs[0], simulated=means, starts=())


def member_columns(members: Sequence[Any], data: DataSet) -> dict[str, Any]:
    """Table columns on the mean of several models: how many there are, and the fits of the mean, on
    a benchmark also its scores. A single member is another model that predicts in place of the
    chosen one."""
    if not members:
        return {}
    validation, test = simulate_ensemble_mean(members, data)
    fits = (validation.fit_percent, test.fit_percent)
    columns: dict[str, Any] = {"members": len(members)}
    columns |= zip(FITS, fits, strict=True)
    scores = benchmark_rmse(data, test.simulated) if "benchmark" in data.metadata else ()
    return columns | numbered_columns("score_members_", scores)
