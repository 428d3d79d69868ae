"""Least-squares problem of the simulation error of a structured model, and its minimisation."""

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, cho_factor, cho_solve

from ssm_study.models.contracting import (
    FreeParameters,
    differentiate_matrices,
    matrices_from_parameters,
)
from ssm_study.models.initial_system import Pairs
from ssm_study.models.structured import activation_codes
from ssm_study.models.structured_kernel import (
    KernelMatrices,
    simulate_compiled,
    simulate_with_sensitivities,
    split_blocks,
)
from ssm_study.models.structured_spec import TrainablePieces
from ssm_study.refusal import require
from ssm_study.training.gain_sign import MOST_NEURONS, gain_shortfall, jacobian_by_differences
from ssm_study.training.levenberg import DAMPING_RANGE, WRITTEN_OUT, levenberg_marquardt_step
from ssm_study.training.windows import pad_records

# Parameters by block: a, e, f (or x_e, x_g, log_d), b, g, bias, c, d, h, scaffold_in, scaffold_out,
# x0.
Theta = dict[str, Float[np.ndarray, "..."]]
FREE_CORE = ("x_e", "x_g", "log_d")
CORE = ("a", "e", "f")
UNWEIGHTED = ("x0", "x_e", "x_g", "a")  # what the ridge leaves alone: coordinates, and starts
STILL = 0.1  # of the records' deviation: where they move less, no start is made
GAIN_BLOCKS = (*CORE, *FREE_CORE, "b", "c")  # what moves the gain
SETTLED = 1e-4  # relative gain of a step below which a descent has ended


class RecordBatch(NamedTuple):
    """Scaled records of equal length, where shorter ones are padded. `weight` is 0 where padded,
    and such that `|r|^2 = (1 - fit / 100)^2`."""

    u: Float[np.ndarray, "N T m"]
    y: Float[np.ndarray, "N T p"]
    weight: Float[np.ndarray, "N T 1"]

    @classmethod
    def from_pairs(cls, pairs: Pairs) -> "RecordBatch":
        """Records as one batch, where shorter ones are padded at their ends."""
        u, y = pad_records(pairs)
        outputs = np.concatenate([output for _, output in pairs])
        deviation = np.linalg.norm(outputs - outputs.mean(axis=0))
        lengths = np.array([len(record) for record, _ in pairs])
        sample = np.arange(u.shape[1])
        is_recorded = sample[None, :, None] < lengths[:, None, None]
        return cls(u=u, y=y, weight=is_recorded / deviation)

    def take_whole_records(self, samples: int) -> "RecordBatch":
        """First whole records that have a given number of samples together. If the first is longer,
        its beginning is taken."""
        count = max(1, samples // self.u.shape[1])
        return RecordBatch(*(part[:count, :samples] for part in self))

    def find_moving_stretch(self, samples: int) -> "RecordBatch":
        """Part of the records, of given length, in which input and output move. It is
        `take_whole_records(samples)` if they move there, else the part of one record that moves
        most. Raises `BadRequest` if none moves."""
        beginning = self.take_whole_records(samples)
        if self._relative_movement(beginning) >= STILL:
            return beginning
        firsts = range(0, self.u.shape[1], max(1, samples // 2))
        places = product(range(len(self.u)), firsts)
        stretches = [self._cut_stretch(*place, samples) for place in places]
        moving = max(stretches, key=self._relative_movement)
        problem = "no stretch of the training records moves in input and output"
        remedy = "log an experiment in which the input moves the output"
        require(self._relative_movement(moving) > 0, "data.training", "at rest", problem, remedy)
        return moving

    def _cut_stretch(self, record: int, first: int, samples: int) -> "RecordBatch":
        """Cut a range of samples out of one record."""
        return RecordBatch(*(part[record : record + 1, first : first + samples] for part in self))

    def _relative_movement(self, stretch: "RecordBatch") -> float:
        """Standard deviation of a part of the records relative to that of all records, the smaller
        of input and output."""
        if not stretch.recorded_mask.any():
            return 0.0
        pairs = ((stretch.u, self.u), (stretch.y, self.y))
        shares = []
        for signal_inside, signal in pairs:
            inside = signal_inside[stretch.recorded_mask].std(axis=0)
            everywhere = signal[self.recorded_mask].std(axis=0)
            deviation = float(np.linalg.norm(everywhere))
            shares.append(float(np.linalg.norm(inside)) / max(deviation, 1e-300))
        return min(shares)

    @property
    def recorded_mask(self) -> np.ndarray:
        """For each sample, whether it was recorded rather than padded."""
        return self.weight[..., 0] > 0


@dataclass(frozen=True, kw_only=True)
class SimulationProblem:
    """Least-squares problem of the simulation errors of a structured model. `r = weight (y_hat -
    y)`, all records from their own x0.

    With `rate` the core (A, E, F) is that of `models.contracting`, without it free. With
    `integrating_output` the output is the running sum of the model's, started at `x0`'s last entry.
    `ridge` weighs the squared parameters that are moved. `gain_share`: see `training.gain_sign`.
    """

    records: RecordBatch
    neurons: tuple[str, ...]
    lift: TrainablePieces
    read: TrainablePieces
    rate: float | None = None
    integrating_output: bool = False
    ridge: float = 0.0
    gain_share: float = 0.0

    def ridge_weight(self, block: str) -> float:
        """Weight of a block's squared parameters in the training penalty."""
        return 0.0 if block in UNWEIGHTED else self.ridge

    def matrices(self, theta: Theta) -> KernelMatrices:
        """Matrices of the recurrence for compiled code."""
        if self.rate is not None:
            core = matrices_from_parameters(free_parameters(theta), self.rate)
            theta = theta | core._asdict()
        return KernelMatrices.from_parts(theta, activation_codes(self.neurons))

    def initial_conditions(
        self, theta: Theta
    ) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N p"]]:
        """Initial states of the records, and initial outputs where the output is a running sum."""
        n = len(theta["b"])
        return np.ascontiguousarray(theta["x0"][:, :n]), theta["x0"][:, n:]

    def simulate_signals(self, theta: Theta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulated mapped inputs, outputs before the output map, and states. `(N, T + 1, n)`."""
        v = np.ascontiguousarray(self.lift.values(theta["scaffold_in"], self.records.u))
        x0, _ = self.initial_conditions(theta)
        ybar, states = simulate_compiled(self.matrices(theta), v, x0)
        return v, ybar, states

    def simulate_output(self, theta: Theta) -> Float[np.ndarray, "N T p"]:
        """Simulated scaled output of all records."""
        _, ybar, _ = self.simulate_signals(theta)
        if self.integrating_output:
            _, begun = self.initial_conditions(theta)
            return begun[:, None, :] + running_sum(ybar)
        return self.read.freeze(theta["scaffold_out"])(ybar)

    def weighted_error(self, theta: Theta) -> Float[np.ndarray, "R"]:
        """Weighted simulation error of all records as one vector."""
        # A trial step may be unstable: its loss is infinite, and it is refused.
        with np.errstate(all="ignore"):
            error = self.simulate_output(theta) - self.records.y
            return (self.records.weight * error).ravel()

    def gain_sign_residuals(self, theta: Theta) -> Float[np.ndarray, "V"]:
        """Residuals of the penalty on sign changes of the steady-state gain; empty without this
        penalty."""
        inputs = self.lift.channels + self.lift.passed
        is_asked = self.gain_share > 0.0 and 0 < len(self.neurons) <= MOST_NEURONS
        if not is_asked or (inputs, self.read.channels) != (1, 1):
            return np.zeros(0)
        return gain_shortfall(self.matrices(theta), self.gain_share)

    def gain_sign_residuals_and_jacobian(
        self, theta: Theta, free: tuple[str, ...]
    ) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V P"]]:
        """Residuals of the penalty on sign changes of the steady-state gain, and their Jacobian by
        differences."""
        missing = self.gain_sign_residuals(theta)
        flat = pack_parameters(theta, free)
        moves_gain = [np.full(theta[name].size, name in GAIN_BLOCKS) for name in free]
        moving = np.flatnonzero(np.concatenate(moves_gain))
        moving = moving if missing.any() else moving[:0]

        def residuals_at(moved: Float[np.ndarray, "P"]) -> Float[np.ndarray, "V"]:
            return self.gain_sign_residuals(theta | unpack_parameters(moved, theta, free))

        return missing, jacobian_by_differences(residuals_at, flat, missing, moving)

    def residual_and_jacobian(
        self, theta: Theta, free: tuple[str, ...]
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R K"], Float[np.ndarray, "K P"]]:
        """Weighted simulation error, and its factored Jacobian with respect to some blocks of
        parameters.

        `turn` is the chain rule through `contracting.matrices_from_parameters`: cheap behind `J'J`,
        not on every sample.
        """
        _, target, weight = self.records
        y, columns = self._output_and_derivatives(theta)
        if "x0" in free:
            columns["x0"] = self._derivatives_by_initial_states(columns["x0"])
        blocks = [name for name in free if name not in FREE_CORE]
        turn = np.eye(sum(columns[name].shape[-1] for name in blocks))
        if len(blocks) < len(free):
            blocks = [*CORE, *blocks]
            turn = block_diag(self._derivatives_by_free_parameters(theta), turn)
        jacobian = np.concatenate([columns[name] for name in blocks], axis=-1)
        jacobian *= weight[..., None]  # in place: it is the largest array of a training
        residual = (weight * (y - target)).ravel()
        return residual, jacobian.reshape(target.size, -1), turn

    def _output_and_derivatives(
        self, theta: Theta
    ) -> tuple[Float[np.ndarray, "N T p"], dict[str, Float[np.ndarray, "N T p _"]]]:
        """Simulated output, and its derivatives with respect to the parameters of each block."""
        u, target, _ = self.records
        v, _, by_input_map = self.lift.values_and_derivatives(theta["scaffold_in"], u)
        x0, begun = self.initial_conditions(theta)
        y, columns = simulate_with_sensitivities(
            self.matrices(theta), v, x0, by_input_map, self.lift.parameter_channels
        )
        self._zero_disturbance_feedthrough(columns)
        columns["scaffold_out"] = np.zeros((*target.shape, 0))
        if self.integrating_output:
            y = begun[:, None, :] + running_sum(y)
            return y, {name: running_sum(part) for name, part in columns.items()}
        if not self.read.knots:
            return y, columns
        y, slope, by_output_map = self.read.values_and_derivatives(theta["scaffold_out"], y)
        columns = {name: slope[..., None] * part for name, part in columns.items()}
        outputs = np.arange(target.shape[-1])[:, None]
        is_own = self.read.parameter_channels == outputs
        columns["scaffold_out"] = by_output_map[..., None, :] * is_own
        return y, columns

    def _zero_disturbance_feedthrough(
        self, columns: dict[str, Float[np.ndarray, "N T p _"]]
    ) -> None:
        """Set to zero the derivatives by which measured disturbances would act directly on the
        output. These entries stay zero."""
        inputs = self.lift.channels + self.lift.passed
        for name in ("d", "g"):
            column = columns[name]
            if not self.lift.passed or not column.size:
                continue
            entries = column.reshape(*column.shape[:-1], -1, inputs)
            entries[..., self.lift.channels :] = 0.0

    def _derivatives_by_free_parameters(self, theta: Theta) -> Float[np.ndarray, "K F"]:
        """Derivatives of the recurrence's matrices with respect to its free parameters."""
        units = np.eye(pack_parameters(theta, FREE_CORE).size)
        directions = FreeParameters(**unpack_parameters(units, theta, FREE_CORE))
        changes = differentiate_matrices(free_parameters(theta), directions, self.rate or 1.0)
        flat = [part.reshape(len(part), part[0].size) for part in changes]
        return np.concatenate(flat, axis=1).T

    def _derivatives_by_initial_states(
        self, own: Float[np.ndarray, "N T p n"]
    ) -> Float[np.ndarray, "N T p _"]:
        """Derivatives of the output with respect to the initial states of all records. Each affects
        its own record; with `integrating_output` the initial sum does, too."""
        count, samples, p, n = own.shape
        width = n + p * self.integrating_output
        whole = np.zeros((count, samples, p, count, width))
        for record in range(count):
            whole[record, :, :, record, :n] = own[record]
            if self.integrating_output:
                whole[record, :, :, record, n:] = np.eye(p)
        return whole.reshape(count, samples, p, -1)


def free_parameters(theta: Theta) -> FreeParameters:
    """Free parameters of a contracting recurrence, from the parameter blocks."""
    return FreeParameters(*(theta[name] for name in FREE_CORE))


def running_sum(y: Float[np.ndarray, "N T *rest"]) -> Float[np.ndarray, "N T *rest"]:
    """Sum of a signal over all earlier samples, as an integrator gives it."""
    total = np.cumsum(y, axis=1)
    return np.concatenate([np.zeros_like(total[:, :1]), total[:, :-1]], axis=1)


@dataclass(frozen=True, kw_only=True)
class Descent:
    """State of the minimisation of the simulation error: parameters, loss and the next step's
    damping. The loss is `|r|^2 + penalty`."""

    theta: Theta
    loss: float
    damping: float = 1e-2


def regularised_loss(problem: SimulationProblem, theta: Theta, free: tuple[str, ...]) -> float:
    """Squared simulation error with a ridge penalty. `|r|^2 + ridge sum |block|^2` over the blocks
    `free`, infinite if the simulation is not finite."""
    residual = problem.weighted_error(theta)
    with np.errstate(all="ignore"):
        penalties = [problem.ridge_weight(name) * float(np.sum(theta[name] ** 2)) for name in free]
        value = float(residual @ residual) + sum(penalties)
    if np.isfinite(value):
        missing = problem.gain_sign_residuals(theta)
        value += float(missing @ missing)
    return value if np.isfinite(value) else np.inf


def take_step(problem: SimulationProblem, at: Descent, free: tuple[str, ...]) -> Descent:
    """Take one accepted Levenberg-Marquardt step in some blocks of parameters."""
    gradient, normal = linearise_loss(problem, at.theta, free)
    flat = pack_parameters(at.theta, free)
    if not np.isfinite(normal).all():
        return replace(at, damping=np.inf)
    diagonal = np.diagonal(normal)
    scale = np.maximum(diagonal, WRITTEN_OUT.weakest * diagonal.max())

    def parameters_after(by: Float[np.ndarray, "P"]) -> Theta:
        """Parameter blocks after a step."""
        return at.theta | unpack_parameters(flat + by, at.theta, free)

    def solve_damped(damping: float) -> Float[np.ndarray, "P"] | None:
        """Solve the damped normal equations for a step."""
        return solve_damped_equations(normal + np.diag(damping * scale), gradient)

    def loss_at(by: Float[np.ndarray, "P"]) -> float:
        """Loss after a step from the current parameters."""
        return regularised_loss(problem, parameters_after(by), free)

    with np.errstate(over="ignore"):  # a damped matrix that overflows is a step that failed
        by, value, damping = levenberg_marquardt_step(
            WRITTEN_OUT, at.loss, gradient, normal, at.damping, solve_damped, loss_at
        )
    theta = at.theta if by is None else parameters_after(by)
    return Descent(theta=theta, loss=value, damping=damping)


def linearise_loss(
    problem: SimulationProblem, theta: Theta, free: tuple[str, ...]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P P"]]:
    """Half the gradient of the regularised loss, and its Gauss-Newton matrix. `J'J + R`, with the
    penalty on the gain's sign; second derivatives of the residual are left out."""
    residual, j, turn = problem.residual_and_jacobian(theta, free)
    ridges = [np.full(theta[name].size, problem.ridge_weight(name)) for name in free]
    weights = np.concatenate(ridges)  # R, its diagonal
    with np.errstate(all="ignore"):
        normal = turn.T @ (j.T @ j) @ turn
        gradient = turn.T @ (j.T @ residual) + weights * pack_parameters(theta, free)
    normal[np.diag_indices_from(normal)] += weights
    missing, slopes = problem.gain_sign_residuals_and_jacobian(theta, free)
    normal += slopes.T @ slopes
    gradient += slopes.T @ missing
    return gradient, normal


def minimise_simulation_error(
    problem: SimulationProblem, theta: Theta, free: tuple[str, ...], most: int
) -> Descent:
    """Minimise the simulation error by the Levenberg-Marquardt method. It takes a limited number of
    steps, until `has_converged`."""
    at = Descent(theta=theta, loss=regularised_loss(problem, theta, free))
    for _ in range(most):
        before = at.loss
        at = take_step(problem, at, free)
        if has_converged(before, at.loss, at.damping):
            break
    return at


def has_converged(before: float, after: float, damping: float) -> bool:
    """Whether a minimisation has converged. An accepted step gained less than `SETTLED`; after a
    refused one, damped more, a shorter step may still gain."""
    refused = after == before and damping < DAMPING_RANGE[1]
    return not refused and not after < before * (1.0 - SETTLED)


def solve_damped_equations(
    damped_normal: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P"] | None:
    """Solve the damped normal equations for a step; None if they have no solution."""
    try:
        return -cho_solve(cho_factor(damped_normal), gradient)
    except (np.linalg.LinAlgError, ValueError):  # not positive definite; not finite
        return None


def pack_parameters(theta: Theta, names: tuple[str, ...]) -> Float[np.ndarray, "P"]:
    """Join named blocks of parameters to one vector."""
    return np.concatenate([theta[name].ravel() for name in names])


def unpack_parameters(
    flat: Float[np.ndarray, "*batch P"], like: Theta, names: tuple[str, ...]
) -> Theta:
    """Split a vector into blocks of parameters with the shapes of `like`."""
    shapes_of = {name: like[name].shape for name in names}
    batch = flat.shape[:-1]
    parts = split_blocks(shapes_of, flat)
    return {name: part.reshape(*batch, *shapes_of[name]) for name, part in parts.items()}
