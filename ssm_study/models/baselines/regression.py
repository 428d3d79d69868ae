"""Baseline models fitted by least squares: ARX, output error and polynomial NARX.

All three are the same stored model, a recursion whose terms are products of past inputs and
outputs. `models.best_baseline` takes the one that simulates the validation records best.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import Inputs, Measured, Outputs, Simulator
from ssm_study.models.initial_system import (
    Pairs,
    arx_impulse_response,
    fit_arx_matrices,
    realise_impulse_response,
)
from ssm_study.models.spec import scale_records
from ssm_study.signals import DataSet, Scale

OVERFLOW = 1e3  # scaled units: a free run beyond this has diverged and is held there
CONSTANT = 0  # the code of the term that is one
OUTPUT = 1000  # 1000 + l is y[k-l]
INPUT = 2000  # 2000 + l is u[k-l]; a thousand more for each further input
DEPENDENT = 1e-10  # of a column's power: what is left of it depends on the columns chosen before
ROWS = 20_000  # of a regression that chooses terms; longer records are thinned

OUTPUT_ERROR_STEPS = 30
LONG_LAGS = 40  # of an ARX model that is cut down to start an output-error model

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
            product[..., lag:, term] *= v[..., : max(v.shape[-2] - lag, 0), channel]
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


def fit_output_error(data: DataSet, order: int, delay: int) -> NarxModel:
    """Fit a linear output-error model to the training records by least squares on the free-run
    error. Each record has its own initial state.

    `y = (sum_j B_j u_j + decay) / F + offset`; Levenberg-Marquardt from ARX of as many lags, and
    from an ARX of many lags reduced to the order, which noise disturbs less. Source: Ljung (1999),
    System Identification, section 4.2.
    """
    scaled_records = scale_records(data)
    problem = _OutputErrorProblem(scaled_records, order, delay)
    denominators = _initial_denominators(data, order, delay)
    starts = [problem.initial_parameters(f) for f in denominators]
    fitted = [problem.minimise(start) for start in starts]
    parameters = min(fitted, key=problem.squared_error)
    f = parameters[:order]
    offset = parameters[-problem.free_response_parameter_count] * (1.0 + f.sum())
    b = parameters[order : -problem.free_response_parameter_count]
    input_count = data.scale.inputs
    regressors = regressor_codes(order, delay, input_count)
    codes = [CONSTANT, *regressors]
    theta = np.concatenate([[offset], -f, b])
    code_array = np.array(codes)
    return NarxModel(codes=code_array[:, None], theta=theta, scale=data.scale)


def _initial_denominators(data: DataSet, order: int, delay: int) -> list[Float[np.ndarray, "n"]]:
    """Stable denominator polynomials from which the fit of an output-error model is started. One is
    of ARX, one of a long ARX reduced by a balanced realisation of its impulse response."""
    short = fit_arx(data, order, delay)
    short_denominator = short.theta[1 : order + 1]
    starts = [_stabilise_polynomial(-short_denominator)]
    records = scale_records(data)
    lengths = (len(u) for u, _ in records)
    shortest = min(lengths)
    lags = min(LONG_LAGS, shortest // 4)
    if lags > order:
        matrices = fit_arx_matrices(records, lags, delay == 0)
        response = arx_impulse_response(*matrices)
        system = realise_impulse_response(response, order, np.random.default_rng(0))
        poles = np.linalg.eigvals(system.a)
        characteristic = np.poly(poles)
        denominator = characteristic.real[1:]
        starts.append(_stabilise_polynomial(denominator))
    return starts


def _stabilise_polynomial(f: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Move the roots of a polynomial inside the circle of radius 0.998."""
    roots = np.roots([1.0, *f])
    moduli = np.abs(roots)
    radius = np.maximum(moduli, 1e-12)
    shrinkage = np.minimum(1.0 / radius, 0.998)
    moved = roots / radius * shrinkage
    inside = np.where(radius > 0.998, moved, roots)
    stable_polynomial = np.poly(inside)
    return stable_polynomial.real[1:]


@dataclass(frozen=True)
class _OutputErrorProblem:
    """Nonlinear least-squares problem of fitting a linear output-error model."""

    records: Pairs
    order: int
    delay: int

    @property
    def free_response_parameter_count(self) -> int:
        """Number of parameters for the output offset and each record's free response."""
        return 1 + self.order * len(self.records)

    def initial_parameters(self, f: Float[np.ndarray, "n"]) -> Float[np.ndarray, "P"]:
        """Initial parameters of an output-error fit for a given denominator polynomial."""
        parameter_count = self.free_response_parameter_count + self._input_coefficient_count
        other_parameters = np.zeros(parameter_count)
        parameters = np.concatenate([f, other_parameters])
        residual, jacobian = self.residual_and_jacobian(parameters)
        linear_columns = jacobian[:, self.order :]
        other_parameters = np.linalg.lstsq(linear_columns, -residual, rcond=None)[0]
        return np.concatenate([f, other_parameters])

    @property
    def _input_coefficient_count(self) -> int:
        """Number of coefficients in the numerator polynomials of an output-error model."""
        first_inputs = self.records[0][0]
        return self.order * first_inputs.shape[1]

    def squared_error(self, parameters: Float[np.ndarray, "P"]) -> float:
        """Sum of squared free-run errors on all records; infinite if a run diverges."""
        residual, _ = self.residual_and_jacobian(parameters)
        value = float(residual @ residual)
        is_finite = np.isfinite(value)
        return value if is_finite else np.inf

    def residual_and_jacobian(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Free-run errors on all records, and their Jacobian with respect to the parameters."""
        residuals = []
        jacobians = []
        for index, (u, y) in enumerate(self.records):
            jacobian = self._output_jacobian(index, u, parameters)
            linear_columns = jacobian[:, self.order :]
            linear_parameters = parameters[self.order :]
            linear = linear_columns @ linear_parameters
            free_run = linear - parameters[-self.free_response_parameter_count]
            denominator = parameters[: self.order]
            filtered = _filter_recursively(denominator, -free_run)
            jacobian[:, : self.order] = _delayed_copies(filtered, 1, self.order)
            measured = y[:, 0]
            residuals.append(linear - measured)
            jacobians.append(jacobian)
        all_residuals = np.concatenate(residuals)
        all_jacobians = np.concatenate(jacobians)
        return all_residuals, all_jacobians

    def _output_jacobian(self, index: int, u: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Jacobian of one record's simulated output with respect to the parameters in which it is
        linear. The columns of the denominator F stay zero."""
        f = parameters[: self.order]
        n = self.order
        samples = len(u)
        parameter_count = len(parameters)
        jacobian = np.zeros((samples, parameter_count))
        for channel in range(u.shape[1]):
            column = n * (1 + channel)
            input_channel = u[:, channel]
            filtered = _filter_recursively(f, input_channel)
            jacobian[:, column : column + n] = _delayed_copies(filtered, self.delay, n)
        jacobian[:, -self.free_response_parameter_count] = 1.0
        impulse = np.zeros(len(u))
        impulse[0] = 1.0
        column = len(parameters) - self.free_response_parameter_count + 1 + n * index
        decay = _filter_recursively(f, impulse)
        jacobian[:, column : column + n] = _delayed_copies(decay, 0, n)
        return jacobian

    def minimise(self, parameters: np.ndarray) -> np.ndarray:
        """Minimise the squared free-run error by the Levenberg-Marquardt method. At most
        `OUTPUT_ERROR_STEPS` steps; F stays stable."""
        residual, jacobian = self.residual_and_jacobian(parameters)
        damping = 1e-3
        for _ in range(OUTPUT_ERROR_STEPS):
            normal = jacobian.T @ jacobian
            diagonal = np.diag(normal)
            least_damping = 1e-9 * np.trace(normal) / len(normal)
            scale = diagonal + least_damping
            damped = normal + np.diag(damping * scale)
            descent = -jacobian.T
            step = np.linalg.solve(damped, descent @ residual)
            trial = parameters + step
            denominator = trial[: self.order]
            roots = np.roots([1.0, *denominator])
            moduli = np.abs(roots)
            stable = moduli.max() < 0.9999
            if stable:
                new_residual, new_jacobian = self.residual_and_jacobian(trial)
            if stable and new_residual @ new_residual < residual @ residual:
                error_ratio = (new_residual @ new_residual) / (residual @ residual)
                gain = 1.0 - error_ratio
                parameters = trial
                residual = new_residual
                jacobian = new_jacobian
                damping = max(damping * 0.3, 1e-9)
                if gain < 1e-5:
                    break
            else:
                damping *= 4.0
                if damping > 1e6:
                    break
        return parameters


def _filter_recursively(f: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Filter a signal by the all-pole filter `1 / (1 + f_1 z^-1 + ...)`."""
    from scipy.signal import lfilter  # SciPy loads this part at its first use, in half a second

    denominator = [1.0, *f]
    filtered = lfilter([1.0], denominator, signal)
    return np.asarray(filtered)


def _delayed_copies(signal: np.ndarray, first_delay: int, count: int) -> np.ndarray:
    """Matrix whose columns are copies of one signal with increasing delays."""
    samples = len(signal)
    columns = np.zeros((samples, count))
    for column in range(count):
        lag = first_delay + column
        columns[lag:, column] = signal[: max(len(signal) - lag, 0)]
    return columns
