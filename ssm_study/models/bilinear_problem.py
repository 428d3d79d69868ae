"""Least-squares problem of fitting the free run of a bilinear model to the records.

The parameters in a row are a free matrix for each node, `b_i`, `c`, an offset of the output and an
initial state for each record. With a rate, `A_i = rate con(X_i)` (`models.contracting`): all have a
norm below it, so that for every input sequence the difference of two motions shrinks by it each
sample. Without one, `A_i = X_i`.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.models.bilinear import Bilinear, Hats, Nodes, hat_functions
from ssm_study.models.bilinear_kernel import simulate_state_derivatives, simulate_states
from ssm_study.models.contracting import (
    FreeParameters,
    RecurrenceMatrices,
    differentiate_matrices,
    matrices_from_parameters,
    parameters_from_matrices,
)
from ssm_study.models.initial_system import (
    Pairs,
    arx_impulse_response,
    fit_arx_matrices,
    realise_impulse_response,
)
from ssm_study.signals import Scale

ARX_LAGS = 10
START_RADIUS = 0.97  # share of the rate within which the initial matrices are pulled
WEAKEST = 1e-8  # curvatures below it, relative to the largest, are damped as if they had it
LARGEST_DAMPING = 1e8
SETTLED = 1e-5  # relative gain of a step below which the minimisation has ended
Vector = Float[np.ndarray, "P"]


class FitParameters(NamedTuple):
    """Parameters of a bilinear model during its fit, one field for each kind of parameter."""

    x: Float[np.ndarray, "q n n"]
    b: Float[np.ndarray, "q n"]
    c: Float[np.ndarray, "p n"]
    offset: Float[np.ndarray, "p"]
    x0: Float[np.ndarray, "r n"]

    def flatten(self) -> Vector:
        """Join all parameters of a bilinear fit to one vector."""
        flat_parts = [part.ravel() for part in self]
        return np.concatenate(flat_parts)

    def with_values(self, values: Vector) -> "FitParameters":
        """Copy of the parameters of a bilinear fit, with values taken from one vector."""
        sizes = [part.size for part in self]
        ends = np.cumsum(sizes)[:-1]
        pieces = np.split(values, ends)
        pieces_and_parts = zip(pieces, self, strict=True)
        shaped = [piece.reshape(part.shape) for piece, part in pieces_and_parts]
        return FitParameters(*shaped)


@dataclass(frozen=True, kw_only=True)
class BilinearProblem:
    """Least-squares problem of fitting a bilinear model to the free-run outputs of all training
    records."""

    order: int
    rate: float | None
    nodes: Nodes
    records: Pairs
    hats: tuple[Hats, ...]
    deviation: float

    @classmethod
    def from_records(
        cls, records: Pairs, order: int, nodes: int, rate: float | None
    ) -> "BilinearProblem":
        """Set up the fit of a bilinear model whose input levels (nodes) cover the range of the
        recorded inputs."""
        recorded_inputs = [u[:, 0] for u, _ in records]
        inputs = np.concatenate(recorded_inputs)
        recorded_outputs = [y for _, y in records]
        outputs = np.concatenate(recorded_outputs)
        lowest = inputs.min()
        highest = inputs.max()
        places = equally_spaced_nodes(float(lowest), float(highest), nodes)
        hats_of_records = (hat_functions(places, u[:, 0]) for u, _ in records)
        deviation = outputs - outputs.mean(axis=0)
        return cls(
            order=order,
            rate=rate,
            nodes=places,
            records=records,
            hats=tuple(hats_of_records),
            deviation=float(np.linalg.norm(deviation)),
        )

    def initial_parameters(self, rng: np.random.Generator, spread: float) -> FitParameters:
        """Initial parameters of a bilinear fit: one linear ARX model at every input level (node),
        randomly perturbed."""
        n = self.order
        lengths = (len(u) for u, _ in self.records)
        longest = max(lengths)
        lags = min(ARX_LAGS, longest // 4)
        arx_matrices = fit_arx_matrices(self.records, lags, False)
        response = arx_impulse_response(*arx_matrices)
        system = realise_impulse_response(response, n, rng)
        limit = START_RADIUS * (self.rate or 1.0)
        eigenvalues = np.linalg.eigvals(system.a)
        moduli = np.abs(eigenvalues)
        radius = max(float(moduli.max()), 1e-9)
        shrinkage = START_RADIUS * limit / radius
        a = system.a * min(1.0, shrinkage)
        turn = _contraction_coordinates(a / limit)
        back = np.linalg.inv(turn)
        a = turn @ a @ back
        free = []
        for _ in self.nodes:
            random_matrix = rng.standard_normal((n, n))
            random_part = spread * random_matrix
            drawn = a + random_part / np.sqrt(n)
            norm = np.linalg.norm(drawn, 2)
            size = norm / limit
            excess = max(1.0, size)
            free_matrix = self._unconstrained_state_matrix(drawn / excess)
            free.append(free_matrix)
        node_column = self.nodes[:, None]
        input_column = (turn @ system.b)[:, 0]
        b = node_column * input_column
        c = system.c @ back
        start_shape = (len(self.records), n)
        x0 = np.zeros(start_shape)
        free_matrices = np.stack(free)
        zero_offset = np.zeros(len(c))
        return FitParameters(x=free_matrices, b=b, c=c, offset=zero_offset, x0=x0)

    def _unconstrained_state_matrix(self, a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        """Unconstrained matrix from which the contracting state matrix of a bilinear model is
        computed."""
        if self.rate is None:
            return a
        n = len(a)
        no_neurons = np.zeros((n, 0))
        no_outputs = np.zeros((0, n))
        core = RecurrenceMatrices(a=a, e=no_neurons, f=no_outputs)
        return parameters_from_matrices(core, self.rate).x_g

    def state_matrices(self, parts: FitParameters) -> Float[np.ndarray, "q n n"]:
        """State matrices `A_i` of a bilinear model at all input levels (nodes)."""
        if self.rate is None:
            return parts.x
        matrices = [
            matrices_from_parameters(_parameters_without_neurons(x), self.rate).a for x in parts.x
        ]
        return np.stack(matrices)

    @property
    def equilibrium_projection(self) -> Float[np.ndarray, "q q"]:
        """Matrix that subtracts a bilinear model's input vector at level zero from those at all
        levels, so that its equilibrium is at zero."""
        is_zero_node = self.nodes == 0.0
        at_zero = np.where(is_zero_node, 1.0, 0.0)
        node_count = len(self.nodes)
        zero_rows = np.tile(at_zero, (len(self.nodes), 1))
        return np.eye(node_count) - zero_rows

    def build_model(self, parts: FitParameters, scale: Scale, step_s: float) -> Bilinear:
        """Build the bilinear model in physical units from the parameters of the fit. The offset of
        the output moves its equilibrium."""
        moved_by = scale.output_scale * parts.offset
        moved = scale.output_equilibrium + moved_by
        state_matrices = self.state_matrices(parts)
        projected_b = self.equilibrium_projection @ parts.b
        moved_scale = replace(scale, output_equilibrium=moved)
        return Bilinear(
            nodes=self.nodes,
            a=state_matrices,
            b=projected_b,
            c=parts.c,
            scale=moved_scale,
            step_s=step_s,
        )

    def residual(self, parts: FitParameters) -> Float[np.ndarray, "R"]:
        """Free-run errors of a bilinear model on all records as one vector, relative to the norm of
        the outputs."""
        a = self.state_matrices(parts)
        b = self.equilibrium_projection @ parts.b
        errors = []
        for hats, (_, y), x0 in zip(self.hats, self.records, parts.x0, strict=True):
            states = simulate_states(hats, a, b, x0)
            error = states @ parts.c.T + parts.offset - y
            errors.append(error.ravel())
        return np.concatenate(errors) / self.deviation

    def loss(self, parts: FitParameters) -> float:
        """Sum of a bilinear model's squared free-run errors relative to the norm of the outputs;
        infinite if the run diverges."""
        with np.errstate(all="ignore"):
            residual = self.residual(parts)
            value = float(residual @ residual)
        is_finite = np.isfinite(value)
        return value if is_finite else np.inf

    def residual_and_jacobian(
        self, parts: FitParameters
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R P"]]:
        """Free-run errors of a bilinear model on all records, and their Jacobian with respect to
        all parameters."""
        a = self.state_matrices(parts)
        b = self.equilibrium_projection @ parts.b
        slopes = self._derivatives_by_free_matrices(parts)
        residuals = []
        jacobians = []
        records = zip(self.hats, self.records, strict=True)
        for index, (hats, (_, y)) in enumerate(records):
            start = parts.x0[index]
            states, by_all = simulate_state_derivatives(hats, a, b, start, False)
            error = states @ parts.c.T + parts.offset - y
            residuals.append(error.ravel())
            record_jacobian = self._jacobian_of_record(parts, states, by_all, slopes, index)
            jacobians.append(record_jacobian)
        deviation = self.deviation
        all_residuals = np.concatenate(residuals)
        all_jacobians = np.concatenate(jacobians)
        return all_residuals / deviation, all_jacobians / deviation

    def _jacobian_of_record(
        self,
        parts: FitParameters,
        states: Float[np.ndarray, "T n"],
        by_all: Float[np.ndarray, "T n S"],
        slopes: Float[np.ndarray, "q nn nn"],
        index: int,
    ) -> Float[np.ndarray, "R P"]:
        """Jacobian of a bilinear model's outputs on one record with respect to all parameters."""
        q, n, _ = parts.x.shape
        p = len(parts.c)
        samples = len(states)
        by_states = np.einsum("pi,kij->kpj", parts.c, by_all)
        entries_of_a = q * n * n
        by_a = by_states[..., :entries_of_a].reshape(samples, p, q, n * n)
        by_b = by_states[..., q * n * n : -n].reshape(samples, p, q, n)
        start_shape = (samples, p, *parts.x0.shape)
        by_x0 = np.zeros(start_shape)
        by_x0[:, :, index] = by_states[..., -n:]
        identity = np.eye(p)
        by_free_matrices = np.einsum("kpqi,qij->kpqj", by_a, slopes)
        by_projected_b = np.einsum("kpqn,qs->kpsn", by_b, self.equilibrium_projection)
        by_output_map = np.einsum("po,kn->kpon", identity, states)
        by_offset = np.broadcast_to(identity, (samples, p, p))
        blocks = [by_free_matrices, by_projected_b, by_output_map, by_offset, by_x0]
        rows = [block.reshape(samples * p, -1) for block in blocks]
        return np.concatenate(rows, axis=1)

    def _derivatives_by_free_matrices(self, parts: FitParameters) -> Float[np.ndarray, "q nn nn"]:
        """Derivative of each state matrix of a bilinear model with respect to its unconstrained
        parameter matrix."""
        q, n, _ = parts.x.shape
        units = np.eye(n * n)
        if self.rate is None:
            identity_shape = (q, n * n, n * n)
            return np.broadcast_to(units, identity_shape)
        empty_shape = (n * n, n, 0)
        none = np.zeros(empty_shape)
        unit_matrices = units.reshape(-1, n, n)
        no_scales = np.zeros((n * n, 0))
        change = FreeParameters(x_e=none, x_g=unit_matrices, log_d=no_scales)
        derivatives = []
        for x in parts.x:
            free = _parameters_without_neurons(x)
            moved = differentiate_matrices(free, change, self.rate)
            flat_change = moved.a.reshape(n * n, -1)
            derivatives.append(flat_change.T)
        return np.stack(derivatives)

    def minimise(self, parts: FitParameters, steps: int) -> FitParameters:
        """Minimise the squared free-run error of a bilinear model by a limited number of
        Levenberg-Marquardt steps."""
        damping = 1e-2
        for _ in range(steps):
            residual, jacobian = self.residual_and_jacobian(parts)
            loss = float(residual @ residual)
            normal = jacobian.T @ jacobian
            diagonal = np.diagonal(normal)
            largest = diagonal.max()
            least = WEAKEST * largest
            scale = np.maximum(diagonal, least)
            gradient = jacobian.T @ residual
            values = parts.flatten()
            trial = parts
            value = np.inf
            while not value < loss and damping < LARGEST_DAMPING:
                damped_diagonal = np.diag(damping * scale)
                step = np.linalg.solve(normal + damped_diagonal, -gradient)
                trial = parts.with_values(values + step)
                value = self.loss(trial)
                damping *= 0.3 if value < loss else 4.0
            if not value < loss:
                break
            parts = trial
            if value > loss * (1.0 - SETTLED):
                break
        return parts


def equally_spaced_nodes(lowest: float, highest: float, count: int) -> Nodes:
    """Input levels (nodes) of a bilinear model, equally spaced on each side of zero up to the
    extreme inputs."""
    lowest = min(lowest, 0.0)
    highest = max(highest, 0.0)
    share = -lowest / (highest - lowest) if highest > lowest else 0.5
    nodes_below = share * (count - 1)
    most_below = count - 1 - (highest > 0.0)
    below = int(np.clip(round(nodes_below), lowest < 0.0, most_below))
    down = np.linspace(lowest, 0.0, below + 1)
    up = np.linspace(0.0, highest, count - below)
    negative_nodes = down[:-1]
    return np.concatenate([negative_nodes, up])


def _contraction_coordinates(a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Coordinate transformation in which a stable matrix has spectral norm below one."""
    identity = np.eye(len(a))
    p = scipy.linalg.solve_discrete_lyapunov(a.T, identity)
    factor = np.linalg.cholesky(p)
    return np.asarray(factor.T)


def _parameters_without_neurons(x: Float[np.ndarray, "n n"]) -> FreeParameters:
    """Free parameters of a contracting linear recurrence without neurons, from its unconstrained
    state matrix."""
    no_neurons = (len(x), 0)
    no_scales = np.zeros(0)
    return FreeParameters(x_e=np.zeros(no_neurons), x_g=x, log_d=no_scales)
