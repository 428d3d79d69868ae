"""Linear candidate models: output error and ARX as state-space models, scored on the folds."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ssm_study.models.baselines.output_error import fit_output_error
from ssm_study.models.baselines.regression import fit_arx
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.signals import DataSet, Trajectory
from ssm_study.systems import StateSpace
from ssm_study.training.candidates import (
    LINEAR,
    REGRESSION,
    Candidate,
    CandidateErrors,
    is_far_worse_than_best,
)
from ssm_study.training.metrics import records_fit_percent


def cross_validate_linear_model(
    folds: Sequence[DataSet],
    order: int,
    delay: int,
    kind: str = LINEAR,
    largest_time_constant: int | None = None,
    best: Candidate | None = None,
) -> CandidateErrors:
    """Fit a linear model on every cross-validation fold, and compute its errors on the held-out
    parts. A delay of 1 is no dead time, 0 a direct path; the kind is output error or ARX. The last
    folds are left out if the model is far behind `best`."""
    trial = CandidateErrors()
    for fold in folds:
        if best is not None and is_far_worse_than_best(trial.errors, best):
            break
        part = fold.shift_out_dead_time(delay - 1) if delay > 1 else fold
        with np.errstate(all="ignore"):
            model = fit_linear_model(
                part,
                order,
                has_feedthrough=delay == 0,
                kind=kind,
                largest_time_constant=largest_time_constant,
            )
            fit_training = records_fit_percent(model, part.training, part)
            trial.add_error_on_fold(model, part, 100.0 - fit_training)
        fold_time_constant = slowest_time_constant(model)
        trial.time_constant = max(trial.time_constant, fold_time_constant)
    return trial


def slowest_time_constant(model: SSM) -> float:
    """Time constant of a linear model's slowest mode, in samples; infinite if it does not decay."""
    eigenvalues = np.linalg.eigvals(model.system_with_disturbances.a)
    moduli = np.abs(eigenvalues)
    radius = float(moduli.max())
    if radius >= 1.0:
        return float(np.inf)
    return -1.0 / float(np.log(radius)) if radius > 0.0 else 0.0


def fit_linear_model(
    data: DataSet,
    order: int,
    *,
    has_feedthrough: bool,
    kind: str = LINEAR,
    largest_time_constant: int | None = None,
) -> SSM:
    """Fit a linear output-error or ARX model to the training records, as a state-space model. `x+ =
    A x + B u + B_d d, y = C x + D u`.

    The state of a held-out piece can then be estimated from many samples; the recursion itself
    would start from as many noisy outputs as it has lags. Measured disturbances are further inputs
    of the recursion, from one sample before on. A largest time constant, in samples, bounds the
    modes of an output-error model.
    """
    records = delay_disturbances(data) if has_feedthrough else data
    records_with_inputs = records.with_disturbances_as_inputs()
    delay = 0 if has_feedthrough else 1
    if kind == REGRESSION:
        model = fit_arx(records_with_inputs, order, delay)
    else:
        model = fit_output_error(records_with_inputs, order, delay, largest_time_constant)
    f = model.theta[1 : order + 1]
    input_coefficients = model.theta[order + 1 :]
    both = input_coefficients.reshape(-1, order).T  # (lags, inputs and disturbances)
    input_count = data.scale.inputs
    gains = both[:, :input_count]
    d = gains[:1] if has_feedthrough else np.zeros((1, gains.shape[1]))
    by_lag = np.concatenate([gains[1:], 0.0 * d]) if has_feedthrough else gains
    a = np.eye(order, k=1)
    a[:, 0] = f
    scaled_constant = data.scale.output_scale * model.theta[0]
    denominator_sum = f.sum()
    offset = scaled_constant / (1.0 - denominator_sum)
    moved_equilibrium = data.scale.output_equilibrium + offset
    scale = replace(data.scale, output_equilibrium=moved_equilibrium)
    b = by_lag + f[:, None] * d
    first_state = np.eye(1, order)
    system = StateSpace(a=a, b=b, c=first_state, d=d)
    if not data.disturbances:
        return SSM.from_linear(system, data.step_s, scale)
    gain_count = gains.shape[1]
    identity_in = LinearScaffold.identity(gain_count)
    identity_out = LinearScaffold.identity(1)
    disturbance_start = gains.shape[1]
    return SSM(
        linear=system,
        scaffold_in=identity_in,
        scaffold_out=identity_out,
        scale=scale,
        step_s=data.step_s,
        b_d=both[:, disturbance_start:],
    )


def delay_disturbances(data: DataSet) -> DataSet:
    """Copy of a data set in which the measured disturbances are delayed by one sample. An effect
    within the sample for the input is then one of the sample before for them."""
    delayed_records = (delay_disturbance(record) for record in data.training)
    late = tuple(delayed_records)
    return replace(data, training=late)


def delay_disturbance(record: Trajectory) -> Trajectory:
    """Copy of a record in which the measured disturbances are delayed by one sample."""
    if record.d is None:
        return record
    first_value = record.d[:1]
    earlier_values = record.d[:-1]
    late = np.vstack([first_value, earlier_values])
    return replace(record, d=late)
