"""Linear model predictive control on the recurrence, the input nonlinearity inverted: a peer that
knows its limits."""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import osqp
import scipy
from jaxtyping import Float

from ssm_study.loop.controller import EstimateFeedback, Inputs, Memory, Outputs, Target
from ssm_study.loop.peers.lqg import LINEAR, lqg, weights_of
from ssm_study.loop.peers.peer import Identified, Peer
from ssm_study.loop.peers.pi import mean_slope
from ssm_study.loop.trajectory import inverse
from ssm_study.models.identified import SSM
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.design import Synthesis

HORIZON = 20  # samples; the Riccati terminal cost stands for all later ones
SOLVER_TOLERANCE = 1e-5  # of OSQP, in scaled input: far below what the noise moves


@dataclass(frozen=True, kw_only=True)
class MPC(EstimateFeedback):
    """`min sum |C x|^2 + R |v|^2 + x_N^T S x_N` over `v[0..HORIZON-1]` within limits, `v = S_u(u)`;
    `v[0]` is applied.

    `x` is measured from the set point; the state comes from the Kalman predictor of `lqg`. One
    quadratic program per
    case and sample, by OSQP, warm-started. `input_lower, input_upper (m,)` are physical;
    scalar-input models only need
    increasing S_u.
    """

    model: SSM
    weights: Synthesis
    input_lower: Float[np.ndarray, "m"]
    input_upper: Float[np.ndarray, "m"]

    def input(self, memory: Memory, y: Outputs, target: Target) -> Inputs:
        n = self.model.order
        rest = self.model.scaffold_in(target[n:])
        v = np.stack([self._solve(x - target[:n], rest) for x in memory]) + rest
        return self.model.scale.physical_input(inverse(self.model.scaffold_in, v))

    def _solve(
        self, x: Float[np.ndarray, "n"], rest: Float[np.ndarray, "k"]
    ) -> Float[np.ndarray, "k"]:
        program, linear = self._program
        lower, upper = (limit - rest for limit in self._limits)
        program.update(q=linear @ x, l=np.tile(lower, HORIZON), u=np.tile(upper, HORIZON))
        return np.clip(program.solve(raise_error=False).x[: len(rest)], lower, upper)

    @cached_property
    def _limits(self) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
        ends = np.stack([self.model.lift(self.input_lower), self.model.lift(self.input_upper)])
        return ends.min(axis=0), ends.max(axis=0)

    @cached_property
    def _program(self) -> tuple["osqp.OSQP", Float[np.ndarray, "Hk n"]]:
        """Condensed: `x_i = A^i x + sum_j A^(i-1-j) B v_j`, so the cost is `v^T H v / 2 + (F x)^T
        v`."""
        a, b, q = (
            self.model.linear.a,
            self.model.linear.b,
            self.weights.problem(self.model.linear, LINEAR).state_weight,
        )
        (n, k), slope = b.shape, np.linalg.norm(mean_slope(self.model), 2)
        r = self.weights.input_weight / slope**2 * np.eye(k)
        powers, steps = [np.linalg.matrix_power(a, i) for i in range(HORIZON + 1)], range(HORIZON)
        forced = np.block(
            [[powers[i - j] @ b if j <= i else np.zeros((n, k)) for j in steps] for i in steps]
        )
        cost = scipy.linalg.block_diag(
            *[q] * (HORIZON - 1), scipy.linalg.solve_discrete_are(a, b, q, r)
        )
        hessian = scipy.sparse.csc_matrix(
            np.triu(forced.T @ cost @ forced + np.kron(np.eye(HORIZON), r))
        )
        program, identity = osqp.OSQP(), scipy.sparse.eye(HORIZON * k, format="csc")
        lower, upper = (np.tile(limit, HORIZON) for limit in self._limits)
        settings = {"verbose": False, "eps_abs": SOLVER_TOLERANCE, "eps_rel": SOLVER_TOLERANCE}
        program.setup(hessian, np.zeros(HORIZON * k), identity, lower, upper, **settings)
        return program, forced.T @ cost @ np.vstack(powers[1:])


class MpcPeer(Peer, names=("mpc",)):
    """LQG's weights and Kalman gain, horizon 20, S_u inverted, within the inputs of the validation
    record."""

    def build(self, plant: Plant, known: Identified, rate: float) -> MPC:
        weights = weights_of(plant, known, rate)
        moved, gains = (
            np.concatenate([record.u for record in known.validation]),
            lqg(known.without_neurons, weights).gains,
        )
        limits = {"input_lower": moved.min(axis=0), "input_upper": moved.max(axis=0)}
        return MPC(model=known.without_neurons, gains=gains, weights=weights, **limits)
