"""Baseline models fitted by linear least squares: ARX and polynomial NARX.

These two and output error (`models.baselines.output_error`) are the same stored model, a recursion
whose terms are products of past inputs and outputs. `models.best_baseline` takes the one that
simulates the validation records best.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import Inputs, Measured, Outputs, Simulator
from ssm_study.models.initial_system import Pairs
from ssm_study.models.spec import scale_records
from ssm_study.signals import DataSet, Scale

OVERFLOW = 1e3  # scaled units: a free run beyond this has diverged and is held there
CONSTANT = 0  # the code of the term that is one
OUTPUT = 1000  # 1000 + l is y[k-l]
INPUT = 2000  # 2000 + l is u[k-l]; a thousand more for each further input
DEPENDENT = 1e-10  # of a column's power: what is left of it depends on the columns chosen before
ROWS = 20_000  # of a regression that chooses terms; longer records are thinned

Codes = Int[np.ndarray, "terms degree"]


@dataclass(frozen=True, kw_only=True)
class NarxModel(Simulator, names=("narx",)):
    """Identified polynomial NARX model with one output; linear ARX is the case of degree one.

    `y[k] = sum_i theta_i prod_j factor_ij`, the factors named by codes: 1000 + l is `y[k-l]`, 2000
    + l is `u[k-l]` (3000 + l of the second input), 0 is one.
    """

    codes: Codes
    theta: Float[np.ndarray, "terms"]
    scale: Scale

    def simulate(self, u: Inputs) -> Outputs:
        """Simulate a polynomial NARX model in free run from the equilibrium."""
        no_outputs = np.zeros((*u.shape[:-2], 0, 1))
        return self.simulate_from_outputs(u, no_outputs)

    def simulate_from_outputs(self, u: Inputs, y_start: Measured) -> Outputs:
        """Simulate a polynomial NARX model in free run, continuing a given stretch of measured
        outputs."""
        v = self.scale.scaled_input(u)
        scaled_start = self.scale.scaled_output(y_start)
        measured = scaled_start[..., 0]
        by_input = _input_factor_product(self.codes, v)
        is_not_constant = self.codes >= OUTPUT
        is_no_input = self.codes < INPUT
        is_output = is_not_constant & is_no_input
        output_lags = self.codes - OUTPUT
        lags = np.where(is_output, output_lags, 0)
        largest_lag = lags.max()
        longest = max(1, int(largest_lag))
        batch_shape = v.shape[:-2]
        past = np.zeros((*batch_shape, 1 + longest))
        past[..., 0] = 1.0  # what a factor that is no output multiplies with
        output_shape = v.shape[:-1]
        y = np.empty(output_shape)
        samples = v.shape[-2]
        for k in range(samples):
            if k < measured.shape[-1]:
                value = measured[..., k]
            else:
                output_factors = past[..., lags].prod(axis=-1)
                terms = by_input[..., k, :] * output_factors
                next_output = terms @ self.theta
                value = np.clip(next_output, -OVERFLOW, OVERFLOW)
            y[..., k] = value
            past[..., 2:] = past[..., 1:-1].copy()
            past[..., 1] = value
        output_column = y[..., None]
        return self.scale.physical_output(output_column)


def _input_factor_product(codes: Codes, v: Float[np.ndarray, "*batch T m"]) -> np.ndarray:
    """Product of the input factors in each term of a NARX model, at each sample."""
    run_shape = v.shape[:-1]
    product = np.ones((*run_shape, len(codes)))
    for term, row in enumerate(codes):
        for code in row[row >= INPUT]:
            channel, lag = divmod(int(code) - INPUT, 1000)
            product[..., :lag, term] = 0.0
            product[..., lag:, term] *= v[..., : v.shape[-2] - lag, channel]
    return product


def regressor_codes(lags: int, delay: int, inputs: int) -> list[int]:
    """Integer codes of the delayed outputs and inputs that a NARX model may use."""
    output_lags = range(1, lags + 1)
    outputs = [OUTPUT + lag for lag in output_lags]
    channels = range(inputs)
    starts = [INPUT + 1000 * channel + delay for channel in channels]
    delayed = (start + lag for start in starts for lag in range(lags))
    return [*outputs, *delayed]


def regression_arrays(
    records: Pairs, codes: Sequence[int]
) -> tuple[Float[np.ndarray, "N V"], Float[np.ndarray, "N"]]:
    """Regressor matrix and target outputs of several records for least squares. No row reaches
    across two records."""
    first = max(code % 1000 for code in codes)
    rows = []
    targets = []
    for u, y in records:
        if len(u) <= first:
            continue
        columns = [_delayed_signal(u, y, code, first) for code in codes]
        regressors = np.stack(columns, axis=1)
        rows.append(regressors)
        targets.append(y[first:, 0])
    all_rows = np.concatenate(rows)
    all_targets = np.concatenate(targets)
    return all_rows, all_targets


def _delayed_signal(u: np.ndarray, y: np.ndarray, code: int, start: int) -> Float[np.ndarray, "N"]:
    """Delayed output or input for which an integer code of a regressor stands."""
    if code == CONSTANT:
        return np.ones(len(u) - start)
    lag = code % 1000
    signal = y[:, 0] if code < INPUT else u[:, (code - INPUT) // 1000]
    samples = len(signal)
    return signal[start - lag : samples - lag]


def fit_arx(data: DataSet, lags: int, delay: int) -> NarxModel:
    """Fit a linear ARX model to the training records by least squares."""
    input_count = data.scale.inputs
    regressors = regressor_codes(lags, delay, input_count)
    codes = [CONSTANT, *regressors]
    scaled_records = scale_records(data)
    rows, target = regression_arrays(scaled_records, codes)
    solution = np.linalg.lstsq(rows, target, rcond=None)
    theta = solution[0]
    code_array = np.array(codes)
    return NarxModel(codes=code_array[:, None], theta=theta, scale=data.scale)


def fit_narx_models(
    data: DataSet, lags: int, degree: int, delay: int, counts: Sequence[int]
) -> Iterator[NarxModel]:
    """Fit polynomial NARX models with more and more terms by one forward regression.

    Source: Billings (2013), Nonlinear System Identification, chapter 3 (error reduction ratio).
    """
    input_count = data.scale.inputs
    regressors = regressor_codes(lags, delay, input_count)
    codes = [CONSTANT, *regressors]
    scaled_records = scale_records(data)
    values, target = regression_arrays(scaled_records, codes)
    further_rows = len(target) // ROWS
    thinned = slice(None, None, 1 + further_rows)
    values = values[thinned]
    target = target[thinned]
    factors = combinations_with_replacement(range(len(codes)), degree)
    products = np.array(list(factors))
    factor_columns = values[:, products]
    candidates = factor_columns.prod(axis=-1)
    order = select_regressors(candidates, target, max(counts))
    for count in counts:
        chosen = order[:count]
        chosen_columns = candidates[:, chosen]
        solution = np.linalg.lstsq(chosen_columns, target, rcond=None)
        theta = solution[0]
        yield NarxModel(codes=np.array(codes)[products[chosen]], theta=theta, scale=data.scale)


def select_regressors(
    candidates: Float[np.ndarray, "N M"], target: Float[np.ndarray, "N"], count: int
) -> list[int]:
    """Select regressors one by one, each time the one that explains most of the remaining
    residual."""
    left = candidates.copy()
    residual = target.copy()
    powers = (left**2).sum(axis=0)
    least_power = DEPENDENT * powers
    chosen: list[int] = []
    while len(chosen) < min(count, left.shape[1]):
        power = (left**2).sum(axis=0)
        smallest_float = np.finfo(float).tiny
        usable = power > np.maximum(least_power, smallest_float)
        usable[chosen] = False
        if not usable.any():
            break
        divisor = np.where(usable, power, 1.0)
        reduction = (left.T @ residual) ** 2 / divisor
        explained = np.where(usable, reduction, -1.0)
        best = int(np.argmax(explained))
        best_column = left[:, best]
        direction = best_column / np.sqrt(power[best])
        residual = residual - direction * (direction @ residual)
        left -= np.outer(direction, direction @ left)
        chosen.append(best)
    return chosen
