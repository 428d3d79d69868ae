"""Result-table columns that describe the data: their origin, what their inputs excite, and
benchmark scores."""

import warnings
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.columns import Column
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory, rmse

# rmse_mm: of an output in m; rmse_milli: of any unit; position_mm: of what a velocity integrates to
SCORES = ("rmse", "rmse_mm", "rmse_milli", "position_mm")
# Of the input's range: fewer hide a gap between levels, more are empty for a few dozen levels.
BINS = 20
RANK_TOLERANCE = (
    4e-13  # samples x machine epsilon, of the largest singular value: below it all is rounding
)
SAMPLES_FOR_ORDER = 2000
HIGHEST_ORDER = 50  # looked no further: a model of order 24 is identifiable by then

SETTING_COLUMNS = (
    Column("seed", "Int64", word="Seed", setting="seed"),
    Column("excitation", "string", word="Excitation", setting="excitation"),
    Column("fold", "Int64", word="Fold that tests", setting="data.fold"),
    Column("fresh_sets", "Int64", word="Fresh data sets", setting="data.fresh_sets"),
)

COLUMNS = (
    *SETTING_COLUMNS,
    Column("data_source", "string", word="Data"),
    Column("benchmark", "string", word="Benchmark"),
    Column("disturbances", "string", word="Measured disturbances"),
    Column("input_coverage", "Float64", "high", "coverage", "Input amplitude coverage", "–"),
    Column("excitation_order", "Int64", "high", word="Order of persistent excitation"),
    Column("excitation_warning", "string"),
)


def data_set_columns(data: DataSet) -> dict[str, Any]:
    """Table columns that describe a data set: its origin and how well its inputs excite the
    plant."""
    disturbances = [channel.name for channel in data.disturbances]
    order = HIGHEST_ORDER
    for record in data.training:
        order = persistency_order(record.u, at_most=order)
    return {
        "data_source": data.metadata.get("source"),
        "benchmark": data.metadata.get("benchmark"),
        "disturbances": ", ".join(disturbances) or None,
        "input_coverage": input_coverage(data),
        "excitation_order": order,
        "excitation_warning": warn_of_two_level_input(data),
    }


def benchmark_rmse(data: DataSet, y_hat: tuple[Float[np.ndarray, "_ p"], ...]) -> tuple[float, ...]:
    """Root mean square error on each test record, computed as a public benchmark prescribes. The
    start-up samples do not count; the unit is that of `data.metadata["score"]`."""
    problem = f"there are {len(data.test)} test records"
    remedy = "score all"
    is_complete = len(y_hat) == len(data.test)
    require(is_complete, "y_hat", len(y_hat), problem, remedy)
    pairs = list(zip(data.test, y_hat, strict=True))
    score = data.metadata.get("score", "rmse")
    if score == "position_mm":
        return tuple(position_rmse_mm(r, y, data.start_up_samples) for r, y in pairs)
    factor = 1.0 if score == "rmse" else 1000.0
    start = data.start_up_samples
    errors = []
    for record, y in pairs:
        errors.append(factor * rmse(record.y, y, start))
    return tuple(errors)


def position_rmse_mm(
    record: Trajectory, velocity_hat: Float[np.ndarray, "T 1"], start_up_samples: int
) -> float:
    """Root mean square error, in mm, of the position obtained by integrating a simulated velocity.
    `1000 rms(q - q_hat)` with `q[k] = q[s] + step_s sum(y[s+1..k])`, started at the measured
    position `q[s]`.

    The recorded velocity is the position's backward difference, so its running sum is the measured
    position exactly; `s` is the last start-up sample. Velocities in m/s.
    """
    scored = slice(start_up_samples, None)
    error = velocity_hat[scored] - record.y[scored]
    drift = np.cumsum(error) * record.step_s
    rms = np.sqrt(np.mean(drift**2))
    return float(1000.0 * rms)


class UnidentifiableSlopesWarning(UserWarning):
    """Warning that the training inputs take too few levels to identify the slopes of a static input
    map."""


def input_coverage(data: DataSet) -> float:
    """Fraction of the input's amplitude range that the training data visit, for the input channel
    where it is smallest. The range has `BINS` equal bins.

    The range of a channel is that of all its records, so a two-level signal scores 2 / `BINS`. In
    [0, 1].
    """
    training = np.concatenate([r.u for r in data.training])
    records = (*data.training, *data.validation, *data.test)
    everything = np.concatenate([record.u for record in records])
    low = everything.min(axis=0)
    width = np.ptp(everything, axis=0)
    if not width.all():
        return 0.0
    places = BINS * (training - low) / width
    bins = np.minimum(places.astype(int), BINS - 1)
    visited = [len(np.unique(column)) for column in bins.T]
    return min(visited) / BINS


def warn_of_two_level_input(data: DataSet) -> str | None:
    """Warn of a training input that takes at most two levels, and return the text of the warning;
    None if no input does."""
    training = np.concatenate([r.u for r in data.training])
    for j, channel in enumerate(data.inputs):
        values = training[:, j]
        levels = len(np.unique(values))
        if levels <= 2:
            sentence = (
                f"excitation of {channel.name}: {levels} levels only, so the slopes of a "
                "nonlinear S_u between them are not identifiable; train on many levels "
                "(`ssm-study excite` for a log, excitation=aprbs for a simulated plant)."
            )
            warnings.warn(sentence, UnidentifiableSlopesWarning, stacklevel=2)
            return sentence
    return None


def persistency_order(u: Float[np.ndarray, "T m"], at_most: int = HIGHEST_ORDER) -> int:
    """Order of persistent excitation of an input signal, or `at_most` if it is higher. The order is
    the largest L for which the block Hankel matrix of L rows of u has full row rank `m L`.

    A linear system of order n is identifiable from such data if `L >= n + its lag + 1` (Willems et
    al. 2005). Judged on the first 2000 samples.
    """
    u = u[:SAMPLES_FOR_ORDER] - u.mean(axis=0)
    samples, inputs = u.shape
    deepest = min(at_most, (samples + 1) // (inputs + 1))
    order = 0
    too_deep = deepest + 1
    depth = deepest
    while too_deep - order > 1:  # the ranks are nested, so halving finds the last full one
        columns = len(u) - depth + 1
        shifted = [u[k : k + columns].T for k in range(depth)]
        hankel = np.concatenate(shifted)
        singular_values = np.linalg.svd(hankel, compute_uv=False)
        largest = singular_values[0]
        smallest = singular_values[-1]
        is_full = smallest > RANK_TOLERANCE * largest
        if is_full:
            order = depth
        else:
            too_deep = depth
        depth = (order + too_deep) // 2
    return order
