"""Linear model predictive control on the recurrence, the input nonlinearity inverted: a peer that knows its limits."""

# ruff: noqa: ARG002 - every law is shown everything; some need less
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse
from jaxtyping import Float

from ssm_study.loop.controller import Controller, observe
from ssm_study.loop.lqg import LQGWeights, lqg
from ssm_study.loop.pi import mean_slope
from ssm_study.loop.trajectory import inverse, set_points
from ssm_study.models.identified import SSM

HORIZON = 20
"""Samples; the Riccati terminal cost stands for all later ones."""
SOLVER_TOLERANCE = 1e-5
"""Of OSQP, in scaled input: far below what the noise moves."""


@dataclass(frozen=True, kw_only=True)
class MPC(Controller):
    """`min sum |C x|^2 + R |v|^2 + x_N^T S x_N` over `v[0..HORIZON-1]` within limits, `v = S_u(u)`; `v[0]` is applied.

    `x` is measured from the set point; the state comes from the Kalman predictor `l` of `lqg`. One quadratic program
    per case and sample, by OSQP, warm-started. `input_lower, input_upper (m,)` are physical; scalar-input models only
    need increasing S_u.
    """

    model: SSM
    l: Float[np.ndarray, "n p"]  # noqa: E741 - the paper's letter
    weights: LQGWeights
    input_lower: Float[np.ndarray, "m"]
    input_upper: Float[np.ndarray, "m"]

    @property
    def step_s(self) -> float:
        return self.model.step_s

    @property
    def dimensions(self) -> tuple[int, int]:
        return len(self.model.input_scale), len(self.model.output_scale)

    def start(self, cases: int) -> Float[np.ndarray, "N n"]:
        return np.zeros((cases, self.model.order))

    def targets(self, reference: Float[np.ndarray, "T p"]) -> Float[np.ndarray, "T t"]:
        return set_points(self.model, reference)

    def input(
        self, memory: Float[np.ndarray, "N n"], y: Float[np.ndarray, "N p"], target: Float[np.ndarray, "t"]
    ) -> Float[np.ndarray, "N m"]:
        n = self.model.order
        rest = self.model.scaffold_in(target[n:])
        v = np.stack([self._solve(x - target[:n], rest) for x in memory]) + rest
        return self.model.input_equilibrium + self.model.input_scale * inverse(self.model.scaffold_in, v)

    def advance(
        self,
        memory: Float[np.ndarray, "N n"],
        u: Float[np.ndarray, "N m"],
        y: Float[np.ndarray, "N p"],
        target: Float[np.ndarray, "t"],
    ) -> Float[np.ndarray, "N n"]:
        return observe(self.model, self.l, memory, u, y)

    def estimate(self, memory: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        return memory

    def _solve(self, x: Float[np.ndarray, "n"], rest: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        program, linear, lower, upper = self._program
        program.update(q=linear @ x, l=np.tile(lower - rest, HORIZON), u=np.tile(upper - rest, HORIZON))
        found = program.solve(raise_error=False).x[: len(rest)]
        return np.clip(found, lower - rest, upper - rest)

    @cached_property
    def _program(
        self,
    ) -> tuple["osqp.OSQP", Float[np.ndarray, "Hk n"], Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
        """Condensed: `x_i = A^i x + sum_j A^(i-1-j) B v_j`, so the cost is `v^T H v / 2 + (F x)^T v`."""
        a, b, c = self.model.linear.a, self.model.linear.b, self.model.linear.c
        (n, k), slope = b.shape, np.linalg.norm(mean_slope(self.model), 2)
        r = self.weights.input_weight / slope**2 * np.eye(k)
        q = c.T @ c + self.weights.state_weight * np.eye(n)
        terminal = scipy.linalg.solve_discrete_are(a, b, q, r)
        powers = [np.linalg.matrix_power(a, i) for i in range(HORIZON + 1)]
        free = np.vstack(powers[1:])
        forced = np.block(
            [[powers[i - j] @ b if j <= i else np.zeros((n, k)) for j in range(HORIZON)] for i in range(HORIZON)]
        )
        cost = scipy.linalg.block_diag(*[q] * (HORIZON - 1), terminal)
        hessian = forced.T @ cost @ forced + np.kron(np.eye(HORIZON), r)
        program = osqp.OSQP()
        identity = scipy.sparse.eye(HORIZON * k, format="csc")
        lower, upper = self._limits()
        program.setup(
            scipy.sparse.csc_matrix(np.triu(hessian)),
            np.zeros(HORIZON * k),
            identity,
            np.tile(lower, HORIZON),
            np.tile(upper, HORIZON),
            verbose=False,
            eps_abs=SOLVER_TOLERANCE,
            eps_rel=SOLVER_TOLERANCE,
        )
        return program, forced.T @ cost @ free, lower, upper

    def _limits(self) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
        ends = np.stack([self.model.lift(self.input_lower), self.model.lift(self.input_upper)])
        return ends.min(axis=0), ends.max(axis=0)


def mpc(
    model: SSM, weights: LQGWeights, input_lower: Float[np.ndarray, "m"], input_upper: Float[np.ndarray, "m"]
) -> MPC:
    """The peer as compared: LQG's weights and Kalman gain, and the given limits."""
    return MPC(model=model, l=lqg(model, weights).l, weights=weights, input_lower=input_lower, input_upper=input_upper)
