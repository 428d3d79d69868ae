"""Linear output-error models: the error of a free run is minimised.

Each record has an initial state of its own, so a mode whose time constant is about as long as the
records can follow a slow drift of the output that the input has not caused. Its effect on other
records is then chance. A largest time constant prevents that (docs/models.md, "What the log
decides").
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.baselines.regression import CONSTANT, NarxModel, fit_arx, regressor_codes
from ssm_study.models.initial_system import (
    Pairs,
    arx_impulse_response,
    fit_arx_matrices,
    realise_impulse_response,
)
from ssm_study.models.spec import scale_records
from ssm_study.signals import DataSet

OUTPUT_ERROR_STEPS = 30
LONG_LAGS = 40  # of an ARX model that is cut down to start an output-error model
STABLE = 0.9999  # the roots of F stay within this radius


def fit_output_error(
    data: DataSet, order: int, delay: int, largest_time_constant: int | None = None
) -> NarxModel:
    """Fit a linear output-error model to the training records by least squares on the free-run
    error. Each record has its own initial state.

    `y = (sum_j B_j u_j + decay) / F + offset`; Levenberg-Marquardt from ARX of as many lags, and
    from an ARX of many lags reduced to the order, which noise disturbs less. Source: Ljung (1999),
    System Identification, section 4.2. With a largest time constant, in samples, the roots of F
    stay within `exp(-1 / largest_time_constant)`, and the better of the two starts is fitted.
    """
    scaled_records = scale_records(data)
    denominators = _initial_denominators(data, order, delay)
    if largest_time_constant is None:
        problem = _OutputErrorProblem(scaled_records, order, delay)
        starts = [problem.initial_parameters(f) for f in denominators]
    else:
        radius = float(np.exp(-1.0 / largest_time_constant))
        problem = _BoundedOutputErrorProblem(scaled_records, order, delay, radius)
        bounded = [shrink_roots(f, radius) for f in denominators]
        all_starts = [problem.initial_parameters(f) for f in bounded]
        starts = [min(all_starts, key=problem.squared_error)]
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


def shrink_roots(f: Float[np.ndarray, "n"], radius: float) -> Float[np.ndarray, "n"]:
    """Move the roots of a polynomial that lie outside the circle of a radius onto it."""
    roots = np.roots([1.0, *f])
    moduli = np.abs(roots)
    if moduli.max() <= radius:
        return f
    largest = np.maximum(moduli, radius)
    shrunk_polynomial = np.poly(roots * (radius / largest))
    return shrunk_polynomial.real[1:]


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

    def minimise(self, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
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
            trial = self.allowed_parameters(parameters + step)
            if trial is not None:
                new_residual, new_jacobian = self.residual_and_jacobian(trial)
            if trial is not None and new_residual @ new_residual < residual @ residual:
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

    def allowed_parameters(self, trial: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"] | None:
        """Parameters after a step; None if F is no longer stable."""
        denominator = trial[: self.order]
        roots = np.roots([1.0, *denominator])
        moduli = np.abs(roots)
        return trial if moduli.max() < STABLE else None


@dataclass(frozen=True)
class _BoundedOutputErrorProblem(_OutputErrorProblem):
    """Output-error problem in which no root of F may lie outside the circle of a radius."""

    radius: float

    def allowed_parameters(self, trial: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        """Parameters after a step. Roots of F outside the circle are moved onto it, and all other
        parameters are solved for anew."""
        denominator = trial[: self.order]
        shrunk = shrink_roots(denominator, self.radius)
        return trial if shrunk is denominator else self.initial_parameters(shrunk)


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
        columns[lag:, column] = signal[: len(signal) - lag]
    return columns
