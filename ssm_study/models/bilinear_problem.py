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
from ssm_study.models.spec import (
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
    """Parameters of a bilinear model during its fit, by name."""

    x: Float[np.ndarray, "q n n"]
    b: Float[np.ndarray, "q n"]
    c: Float[np.ndarray, "p n"]
    offset: Float[np.ndarray, "p"]
    x0: Float[np.ndarray, "r n"]

    def flatten(self) -> Vector:
        """All parameters of the fit as one vector."""
        return np.concatenate([part.ravel() for part in self])

    def with_values(self, values: Vector) -> "FitParameters":
        """Parameters of the same shapes with the entries of a vector as values."""
        ends = np.cumsum([part.size for part in self])[:-1]
        pieces = np.split(values, ends)
        shaped = [piece.reshape(part.shape) for piece, part in zip(pieces, self, strict=True)]
        return FitParameters(*shaped)


@dataclass(frozen=True, kw_only=True)
class BilinearProblem:
    """Simulation errors of a bilinear model over all training records, and their Jacobian."""

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
        """Fitting problem of a bilinear model whose input levels (nodes) cover the range of the
        recorded inputs."""
        inputs = np.concatenate([u[:, 0] for u, _ in records])
        outputs = np.concatenate([y for _, y in records])
        places = spread_nodes(float(inputs.min()), float(inputs.max()), nodes)
        return cls(
            order=order,
            rate=rate,
            nodes=places,
            records=records,
            hats=tuple(hat_functions(places, u[:, 0]) for u, _ in records),
            deviation=float(np.linalg.norm(outputs - outputs.mean(axis=0))),
        )

    def initial_parameters(self, rng: np.random.Generator, spread: float) -> FitParameters:
        """Initial parameters of the fit: a linear ARX model at every node, plus a random part."""
        n = self.order
        longest = max(len(u) for u, _ in self.records)
        lags = min(ARX_LAGS, longest // 4)
        response = arx_impulse_response(*fit_arx_matrices(self.records, lags, False))
        system = realise_impulse_response(response, n, rng)
        limit = START_RADIUS * (self.rate or 1.0)
        radius = max(float(np.abs(np.linalg.eigvals(system.a)).max()), 1e-9)
        a = system.a * min(1.0, START_RADIUS * limit / radius)
        turn = _contraction_coordinates(a / limit)
        back = np.linalg.inv(turn)
        a = turn @ a @ back
        free = []
        for _ in self.nodes:
            drawn = a + spread * rng.standard_normal((n, n)) / np.sqrt(n)
            size = np.linalg.norm(drawn, 2) / limit
            free.append(self._free_matrix(drawn / max(1.0, size)))
        b = self.nodes[:, None] * (turn @ system.b)[:, 0]
        c = system.c @ back
        x0 = np.zeros((len(self.records), n))
        return FitParameters(x=np.stack(free), b=b, c=c, offset=np.zeros(len(c)), x0=x0)

    def _free_matrix(self, a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        """Unconstrained matrix from which the contracting state matrix of a node is computed."""
        if self.rate is None:
            return a
        n = len(a)
        core = RecurrenceMatrices(a=a, e=np.zeros((n, 0)), f=np.zeros((0, n)))
        return parameters_from_matrices(core, self.rate).x_g

    def state_matrices(self, parts: FitParameters) -> Float[np.ndarray, "q n n"]:
        """State matrices `A_i` of all nodes."""
        if self.rate is None:
            return parts.x
        return np.stack(
            [matrices_from_parameters(_without_neurons(x), self.rate).a for x in parts.x]
        )

    @property
    def equilibrium_projection(self) -> Float[np.ndarray, "q q"]:
        """Matrix that subtracts the vector `b` of the node zero from all others, so that the
        equilibrium is kept."""
        at_zero = np.where(self.nodes == 0.0, 1.0, 0.0)
        return np.eye(len(self.nodes)) - np.tile(at_zero, (len(self.nodes), 1))

    def model(self, parts: FitParameters, scale: Scale, step_s: float) -> Bilinear:
        """Bilinear model from the parameters of the fit. The offset of the output moves its
        equilibrium."""
        moved = scale.output_equilibrium + scale.output_scale * parts.offset
        return Bilinear(
            nodes=self.nodes,
            a=self.state_matrices(parts),
            b=self.equilibrium_projection @ parts.b,
            c=parts.c,
            scale=replace(scale, output_equilibrium=moved),
            step_s=step_s,
        )

    def residual(self, parts: FitParameters) -> Float[np.ndarray, "R"]:
        """Free-run errors of all records in one vector, relative to the norm of the outputs."""
        a = self.state_matrices(parts)
        b = self.equilibrium_projection @ parts.b
        errors = []
        for hats, (_, y), x0 in zip(self.hats, self.records, parts.x0, strict=True):
            states = simulate_states(hats, a, b, x0)
            errors.append((states @ parts.c.T + parts.offset - y).ravel())
        return np.concatenate(errors) / self.deviation

    def loss(self, parts: FitParameters) -> float:
        """Sum of the squared residuals; infinite where the free run diverges."""
        with np.errstate(all="ignore"):
            residual = self.residual(parts)
            value = float(residual @ residual)
        return value if np.isfinite(value) else np.inf

    def residual_and_jacobian(
        self, parts: FitParameters
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R P"]]:
        """Free-run errors of all records, and their Jacobian with respect to all parameters."""
        a = self.state_matrices(parts)
        b = self.equilibrium_projection @ parts.b
        slopes = self._derivatives_by_free_matrices(parts)
        residuals = []
        jacobians = []
        for index, (hats, (_, y)) in enumerate(zip(self.hats, self.records, strict=True)):
            states, by_all = simulate_state_derivatives(hats, a, b, parts.x0[index], False)
            residuals.append((states @ parts.c.T + parts.offset - y).ravel())
            jacobians.append(self._jacobian_of_record(parts, states, by_all, slopes, index))
        deviation = self.deviation
        return np.concatenate(residuals) / deviation, np.concatenate(jacobians) / deviation

    def _jacobian_of_record(
        self,
        parts: FitParameters,
        states: Float[np.ndarray, "T n"],
        by_all: Float[np.ndarray, "T n S"],
        slopes: Float[np.ndarray, "q nn nn"],
        index: int,
    ) -> Float[np.ndarray, "R P"]:
        """Jacobian of the outputs of one record with respect to all parameters."""
        q, n, _ = parts.x.shape
        p = len(parts.c)
        samples = len(states)
        by_states = np.einsum("pi,kij->kpj", parts.c, by_all)
        by_a = by_states[..., : q * n * n].reshape(samples, p, q, n * n)
        by_b = by_states[..., q * n * n : -n].reshape(samples, p, q, n)
        by_x0 = np.zeros((samples, p, *parts.x0.shape))
        by_x0[:, :, index] = by_states[..., -n:]
        identity = np.eye(p)
        blocks = [
            np.einsum("kpqi,qij->kpqj", by_a, slopes),
            np.einsum("kpqn,qs->kpsn", by_b, self.equilibrium_projection),
            np.einsum("po,kn->kpon", identity, states),
            np.broadcast_to(identity, (samples, p, p)),
            by_x0,
        ]
        rows = [block.reshape(samples * p, -1) for block in blocks]
        return np.concatenate(rows, axis=1)

    def _derivatives_by_free_matrices(self, parts: FitParameters) -> Float[np.ndarray, "q nn nn"]:
        """Derivative of each state matrix `A_i` with respect to its unconstrained matrix."""
        q, n, _ = parts.x.shape
        units = np.eye(n * n)
        if self.rate is None:
            return np.broadcast_to(units, (q, n * n, n * n))
        none = np.zeros((n * n, n, 0))
        change = FreeParameters(x_e=none, x_g=units.reshape(-1, n, n), log_d=np.zeros((n * n, 0)))
        derivatives = []
        for x in parts.x:
            moved = differentiate_matrices(_without_neurons(x), change, self.rate)
            derivatives.append(moved.a.reshape(n * n, -1).T)
        return np.stack(derivatives)

    def minimise(self, parts: FitParameters, steps: int) -> FitParameters:
        """Minimise the squared free-run error by a limited number of Levenberg-Marquardt steps."""
        damping = 1e-2
        for _ in range(steps):
            residual, jacobian = self.residual_and_jacobian(parts)
            loss = float(residual @ residual)
            normal = jacobian.T @ jacobian
            diagonal = np.diagonal(normal)
            scale = np.maximum(diagonal, WEAKEST * diagonal.max())
            gradient = jacobian.T @ residual
            values = parts.flatten()
            trial = parts
            value = np.inf
            while not value < loss and damping < LARGEST_DAMPING:
                step = np.linalg.solve(normal + np.diag(damping * scale), -gradient)
                trial = parts.with_values(values + step)
                value = self.loss(trial)
                damping *= 0.3 if value < loss else 4.0
            if not value < loss:
                break
            parts = trial
            if value > loss * (1.0 - SETTLED):
                break
        return parts


def spread_nodes(lowest: float, highest: float, count: int) -> Nodes:
    """Input levels (nodes) from the lowest to the highest input, equally spaced on each side of
    zero."""
    lowest = min(lowest, 0.0)
    highest = max(highest, 0.0)
    share = -lowest / (highest - lowest) if highest > lowest else 0.5
    below = int(np.clip(round(share * (count - 1)), lowest < 0.0, count - 1 - (highest > 0.0)))
    down = np.linspace(lowest, 0.0, below + 1)
    up = np.linspace(0.0, highest, count - below)
    return np.concatenate([down[:-1], up])


def _contraction_coordinates(a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Coordinates T in which a stable matrix has a norm below one, `|T a T^{-1}| < 1`."""
    p = scipy.linalg.solve_discrete_lyapunov(a.T, np.eye(len(a)))
    return np.asarray(np.linalg.cholesky(p).T)


def _without_neurons(x: Float[np.ndarray, "n n"]) -> FreeParameters:
    """Free parameters of a contracting recurrence without neurons, from its free state matrix."""
    return FreeParameters(x_e=np.zeros((len(x), 0)), x_g=x, log_d=np.zeros(0))
