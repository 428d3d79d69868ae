"""Least-squares problem of the simulation error of a structured model, and its minimisation."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, cho_factor, cho_solve

from ssm_study.models.contracting import (
    FreeParameters,
    differentiate_matrices,
    matrices_from_parameters,
)
from ssm_study.models.structured import activation_codes
from ssm_study.models.structured_kernel import (
    KernelMatrices,
    simulate_compiled,
    simulate_with_sensitivities,
    split_blocks,
)
from ssm_study.models.structured_spec import TrainablePiecewiseMap
from ssm_study.training.gain_sign import MOST_NEURONS, gain_shortfall, jacobian_by_differences
from ssm_study.training.levenberg import DAMPING_RANGE, WRITTEN_OUT, levenberg_marquardt_step
from ssm_study.training.record_batch import RecordBatch

# Parameters by block: a, e, f (or x_e, x_g, log_d), b, g, bias, c, d, h, scaffold_in, scaffold_out,
# x0.
Theta = dict[str, Float[np.ndarray, "..."]]
FREE_CORE = ("x_e", "x_g", "log_d")
CORE = ("a", "e", "f")
UNWEIGHTED = ("x0", "x_e", "x_g", "a")  # what the ridge leaves alone: coordinates, and starts
GAIN_BLOCKS = (*CORE, *FREE_CORE, "b", "c")  # what moves the gain
SETTLED = 1e-4  # relative gain of a step below which a descent has ended


@dataclass(frozen=True, kw_only=True)
class SimulationProblem:
    """Least-squares problem of fitting the simulation of a structured model to the training
    records. `r = weight (y_hat - y)`, all records from their own x0.

    With `rate` the core (A, E, F) is that of `models.contracting`, without it free. With
    `integrating_output` the output is the running sum of the model's, started at `x0`'s last entry.
    `ridge` weighs the squared parameters that are moved. `gain_share`: see `training.gain_sign`.
    """

    records: RecordBatch
    neurons: tuple[str, ...]
    lift: TrainablePiecewiseMap
    read: TrainablePiecewiseMap
    rate: float | None = None
    integrating_output: bool = False
    ridge: float = 0.0
    gain_share: float = 0.0

    def ridge_weight(self, block: str) -> float:
        """Weight of the ridge penalty on one block of parameters."""
        return 0.0 if block in UNWEIGHTED else self.ridge

    def kernel_matrices(self, theta: Theta) -> KernelMatrices:
        """Matrices of the recurrence in the layout for compiled code, from the trainable
        parameters."""
        if self.rate is not None:
            free = free_parameters(theta)
            core = matrices_from_parameters(free, self.rate)
            theta = theta | core._asdict()
        codes = activation_codes(self.neurons)
        return KernelMatrices.from_parts(theta, codes)

    def initial_conditions(
        self, theta: Theta
    ) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N p"]]:
        """Initial states of all records, and initial outputs where the model has an integrator."""
        n = len(theta["b"])
        model_states = theta["x0"][:, :n]
        sums = theta["x0"][:, n:]
        return np.ascontiguousarray(model_states), sums

    def simulate_internal_signals(self, theta: Theta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate all records, and return the inputs after the input map, the outputs before the
        output map, and the states. `(N, T + 1, n)`."""
        mapped = self.lift.evaluate(theta["scaffold_in"], self.records.u)
        v = np.ascontiguousarray(mapped)
        x0, _ = self.initial_conditions(theta)
        matrices = self.kernel_matrices(theta)
        ybar, states = simulate_compiled(matrices, v, x0)
        return v, ybar, states

    def simulate_output(self, theta: Theta) -> Float[np.ndarray, "N T p"]:
        """Simulate the scaled outputs of all records."""
        _, ybar, _ = self.simulate_internal_signals(theta)
        if self.integrating_output:
            _, begun = self.initial_conditions(theta)
            sums = running_sum(ybar)
            return begun[:, None, :] + sums
        output_map = self.read.to_numpy(theta["scaffold_out"])
        return output_map(ybar)

    def weighted_error(self, theta: Theta) -> Float[np.ndarray, "R"]:
        """Weighted simulation errors of all records as one vector."""
        # A trial step may be unstable: its loss is infinite, and it is refused.
        with np.errstate(all="ignore"):
            simulated = self.simulate_output(theta)
            error = simulated - self.records.y
            weighted_error = self.records.weight * error
            return weighted_error.ravel()

    def gain_sign_residuals(self, theta: Theta) -> Float[np.ndarray, "V"]:
        """Residuals of the penalty on sign changes of the steady-state gain; empty without this
        penalty."""
        inputs = self.lift.channels + self.lift.passed
        is_asked = self.gain_share > 0.0 and 0 < len(self.neurons) <= MOST_NEURONS
        if not is_asked or (inputs, self.read.channels) != (1, 1):
            return np.zeros(0)
        matrices = self.kernel_matrices(theta)
        return gain_shortfall(matrices, self.gain_share)

    def gain_sign_residuals_and_jacobian(
        self, theta: Theta, free: tuple[str, ...]
    ) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V P"]]:
        """Residuals of the penalty on sign changes of the steady-state gain, and their Jacobian by
        finite differences."""
        missing = self.gain_sign_residuals(theta)
        flat = pack_parameters(theta, free)
        moves_gain = [np.full(theta[name].size, name in GAIN_BLOCKS) for name in free]
        moves = np.concatenate(moves_gain)
        moving = np.flatnonzero(moves)
        moving = moving if missing.any() else moving[:0]

        def residuals_at(moved: Float[np.ndarray, "P"]) -> Float[np.ndarray, "V"]:
            """Residuals of the penalty on the sign of the model's gain, for given free
            parameters."""
            moved_blocks = unpack_parameters(moved, theta, free)
            return self.gain_sign_residuals(theta | moved_blocks)

        jacobian = jacobian_by_differences(residuals_at, flat, missing, moving)
        return missing, jacobian

    def residual_and_jacobian(
        self, theta: Theta, free: tuple[str, ...]
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R K"], Float[np.ndarray, "K P"]]:
        """Weighted simulation errors, and their Jacobian with respect to some blocks of parameters
        in factored form.

        `turn` is the chain rule through `contracting.matrices_from_parameters`: cheap behind `J'J`,
        not on every sample.
        """
        _, target, weight = self.records
        y, columns = self._output_and_derivatives(theta)
        if "x0" in free:
            columns["x0"] = self._derivatives_by_initial_states(columns["x0"])
        blocks = [name for name in free if name not in FREE_CORE]
        widths = (columns[name].shape[-1] for name in blocks)
        turn = np.eye(sum(widths))
        if len(blocks) < len(free):
            blocks = [*CORE, *blocks]
            by_free = self._derivatives_by_free_parameters(theta)
            turn = block_diag(by_free, turn)
        blocks_in_order = [columns[name] for name in blocks]
        jacobian = np.concatenate(blocks_in_order, axis=-1)
        jacobian *= weight[..., None]  # in place: it is the largest array of a training
        weighted_residual = weight * (y - target)
        residual = weighted_residual.ravel()
        flat_jacobian = jacobian.reshape(target.size, -1)
        return residual, flat_jacobian, turn

    def _output_and_derivatives(
        self, theta: Theta
    ) -> tuple[Float[np.ndarray, "N T p"], dict[str, Float[np.ndarray, "N T p _"]]]:
        """Simulated outputs of all records, and their derivatives with respect to each block of
        parameters."""
        u, target, _ = self.records
        v, _, by_input_map = self.lift.evaluate_with_derivatives(theta["scaffold_in"], u)
        x0, begun = self.initial_conditions(theta)
        matrices = self.kernel_matrices(theta)
        channels = self.lift.parameter_channels
        y, columns = simulate_with_sensitivities(matrices, v, x0, by_input_map, channels)
        self._zero_disturbance_feedthrough(columns)
        columns["scaffold_out"] = np.zeros((*target.shape, 0))
        if self.integrating_output:
            sums = running_sum(y)
            y = begun[:, None, :] + sums
            summed_columns = {name: running_sum(part) for name, part in columns.items()}
            return y, summed_columns
        if not self.read.knots:
            return y, columns
        y, slope, by_output_map = self.read.evaluate_with_derivatives(theta["scaffold_out"], y)
        columns = {name: slope[..., None] * part for name, part in columns.items()}
        output_count = target.shape[-1]
        output_numbers = np.arange(output_count)
        outputs = output_numbers[:, None]
        is_own = self.read.parameter_channels == outputs
        columns["scaffold_out"] = by_output_map[..., None, :] * is_own
        return y, columns

    def _zero_disturbance_feedthrough(
        self, columns: dict[str, Float[np.ndarray, "N T p _"]]
    ) -> None:
        """Set to zero the derivatives with respect to direct effects of measured disturbances on
        the output. These entries stay zero."""
        inputs = self.lift.channels + self.lift.passed
        for name in ("d", "g"):
            column = columns[name]
            if not self.lift.passed or not column.size:
                continue
            entries = column.reshape(*column.shape[:-1], -1, inputs)
            entries[..., self.lift.channels :] = 0.0

    def _derivatives_by_free_parameters(self, theta: Theta) -> Float[np.ndarray, "K F"]:
        """Derivatives of the recurrence's matrices with respect to the unconstrained parameters."""
        packed = pack_parameters(theta, FREE_CORE)
        units = np.eye(packed.size)
        unit_blocks = unpack_parameters(units, theta, FREE_CORE)
        directions = FreeParameters(**unit_blocks)
        free = free_parameters(theta)
        contraction_factor = self.rate or 1.0
        changes = differentiate_matrices(free, directions, contraction_factor)
        flat = [part.reshape(len(part), part[0].size) for part in changes]
        all_changes = np.concatenate(flat, axis=1)
        return all_changes.T

    def _derivatives_by_initial_states(
        self, record_derivatives: Float[np.ndarray, "N T p n"]
    ) -> Float[np.ndarray, "N T p _"]:
        """Derivatives of the simulated outputs with respect to the initial states of all records.
        Each affects its own record; with `integrating_output` the initial sum does, too."""
        count, samples, p, n = record_derivatives.shape
        width = n + p * self.integrating_output
        whole = np.zeros((count, samples, p, count, width))
        for record in range(count):
            whole[record, :, :, record, :n] = record_derivatives[record]
            if self.integrating_output:
                whole[record, :, :, record, n:] = np.eye(p)
        return whole.reshape(count, samples, p, -1)


def free_parameters(theta: Theta) -> FreeParameters:
    """Unconstrained parameters of a contracting recurrence, taken from the trainable parameter
    blocks."""
    blocks = (theta[name] for name in FREE_CORE)
    return FreeParameters(*blocks)


def running_sum(y: Float[np.ndarray, "N T *rest"]) -> Float[np.ndarray, "N T *rest"]:
    """Sum of a signal over all earlier samples, as an integrator computes."""
    total = np.cumsum(y, axis=1)
    first = total[:, :1]
    earlier = total[:, :-1]
    return np.concatenate([np.zeros_like(first), earlier], axis=1)


@dataclass(frozen=True, kw_only=True)
class DescentState:
    """State of a Levenberg-Marquardt minimisation: parameters, loss and damping for the next step.
    The loss is `|r|^2 + penalty`."""

    theta: Theta
    loss: float
    damping: float = 1e-2


def regularised_loss(
    problem: SimulationProblem, theta: Theta, block_names: tuple[str, ...]
) -> float:
    """Squared simulation error plus a ridge penalty on some blocks of parameters. `|r|^2 + ridge
    sum |block|^2` over the blocks `block_names`, infinite if the simulation is not finite."""
    residual = problem.weighted_error(theta)
    with np.errstate(all="ignore"):
        penalties = [
            problem.ridge_weight(name) * float(np.sum(theta[name] ** 2)) for name in block_names
        ]
        squared_error = float(residual @ residual)
        ridge_penalty = sum(penalties)
        value = squared_error + ridge_penalty
    if np.isfinite(value):
        missing = problem.gain_sign_residuals(theta)
        value += float(missing @ missing)
    is_finite = np.isfinite(value)
    return value if is_finite else np.inf


def take_step(
    problem: SimulationProblem, state: DescentState, block_names: tuple[str, ...]
) -> DescentState:
    """Take one accepted Levenberg-Marquardt step in some blocks of parameters."""
    gradient, normal = loss_gradient_and_gauss_newton_matrix(problem, state.theta, block_names)
    flat = pack_parameters(state.theta, block_names)
    if not np.isfinite(normal).all():
        return replace(state, damping=np.inf)
    diagonal = np.diagonal(normal)
    largest = diagonal.max()
    weakest = WRITTEN_OUT.weakest * largest
    scale = np.maximum(diagonal, weakest)

    def parameters_after(by: Float[np.ndarray, "P"]) -> Theta:
        """Parameter blocks after a given step from the current ones."""
        moved_blocks = unpack_parameters(flat + by, state.theta, block_names)
        return state.theta | moved_blocks

    def solve_damped(damping: float) -> Float[np.ndarray, "P"] | None:
        """Solve the damped normal equations for a Levenberg-Marquardt step."""
        damping_matrix = np.diag(damping * scale)
        return solve_damped_equations(normal + damping_matrix, gradient)

    def loss_at(by: Float[np.ndarray, "P"]) -> float:
        """Regularised loss after a given step from the current parameters."""
        return regularised_loss(problem, parameters_after(by), block_names)

    with np.errstate(over="ignore"):  # a damped matrix that overflows is a step that failed
        by, value, damping = levenberg_marquardt_step(
            WRITTEN_OUT, state.loss, gradient, normal, state.damping, solve_damped, loss_at
        )
    theta = state.theta if by is None else parameters_after(by)
    return DescentState(theta=theta, loss=value, damping=damping)


def loss_gradient_and_gauss_newton_matrix(
    problem: SimulationProblem, theta: Theta, block_names: tuple[str, ...]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P P"]]:
    """Gradient of the regularised simulation loss (halved), and its Gauss-Newton matrix. `J'J + R`,
    with the penalty on the gain's sign; second derivatives of the residual are left out."""
    residual, j, turn = problem.residual_and_jacobian(theta, block_names)
    ridges = [np.full(theta[name].size, problem.ridge_weight(name)) for name in block_names]
    weights = np.concatenate(ridges)  # R, its diagonal
    with np.errstate(all="ignore"):
        gram = j.T @ j
        turned_gram = turn.T @ gram
        normal = turned_gram @ turn
        error_gradient = j.T @ residual
        turned_gradient = turn.T @ error_gradient
        parameters = pack_parameters(theta, block_names)
        gradient = turned_gradient + weights * parameters
    normal[np.diag_indices_from(normal)] += weights
    missing, slopes = problem.gain_sign_residuals_and_jacobian(theta, block_names)
    normal += slopes.T @ slopes
    gradient += slopes.T @ missing
    return gradient, normal


def minimise_simulation_error(
    problem: SimulationProblem, theta: Theta, block_names: tuple[str, ...], max_steps: int
) -> DescentState:
    """Minimise the simulation error over some blocks of parameters by the Levenberg-Marquardt
    method. It takes a limited number of steps, until `has_converged`."""
    loss = regularised_loss(problem, theta, block_names)
    at = DescentState(theta=theta, loss=loss)
    for _ in range(max_steps):
        before = at.loss
        at = take_step(problem, at, block_names)
        if has_converged(before, at.loss, at.damping):
            break
    return at


def has_converged(loss_before: float, loss_after: float, damping: float) -> bool:
    """Whether a Levenberg-Marquardt minimisation has converged, from the decrease of the loss and
    the damping. An accepted step gained less than `SETTLED`; after a refused one, damped more, a
    shorter step may still gain."""
    refused = loss_after == loss_before and damping < DAMPING_RANGE[1]
    return not refused and not loss_after < loss_before * (1.0 - SETTLED)


def solve_damped_equations(
    damped_normal: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P"] | None:
    """Solve the damped normal equations of a least-squares step; None if they have no solution."""
    try:
        return -cho_solve(cho_factor(damped_normal), gradient)
    except (np.linalg.LinAlgError, ValueError):  # not positive definite; not finite
        return None


def pack_parameters(theta: Theta, names: tuple[str, ...]) -> Float[np.ndarray, "P"]:
    """Join named blocks of parameters to one flat vector."""
    flat_blocks = [theta[name].ravel() for name in names]
    return np.concatenate(flat_blocks)


def unpack_parameters(
    flat: Float[np.ndarray, "*batch P"], template: Theta, names: tuple[str, ...]
) -> Theta:
    """Split a flat vector into named blocks of parameters with given shapes."""
    shapes_of = {name: template[name].shape for name in names}
    batch = flat.shape[:-1]
    parts = split_blocks(shapes_of, flat)
    return {name: part.reshape(*batch, *shapes_of[name]) for name, part in parts.items()}
