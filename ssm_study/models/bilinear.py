"""Bilinear model: a recurrence whose matrices depend on the input, so that input and state are
multiplied. No torch here.

    x+ = sum_i theta_i(v) (A_i x + b_i),    w = C x,    b_i = 0 at the node zero

v and w are scaled input and output. `theta_i` are hat functions on nodes `v_1 < ... < v_q`:
piecewise linear, not negative, of sum one, constant beyond the ends. One node is zero, so that the
model rests at zero exactly. Three nodes include the bilinear system. Source: docs/models.md,
"Products of input and state".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.identified import Inputs, Measured, Outputs, Simulator
from ssm_study.models.metrics import START_UP_NOISE
from ssm_study.refusal import require, require_positive
from ssm_study.signals import Scale

Nodes = Float[np.ndarray, "q"]
Hats = Float[np.ndarray, "_ q"]
AGAIN = "write model.json again"


def hat_functions(nodes: Nodes, v: Float[np.ndarray, "T"]) -> Hats:
    """Values of the hat functions, which interpolate linearly between the nodes, at several inputs.
    They are linear between the nodes and constant beyond the ends, so that each row adds up to
    one."""
    units = np.eye(len(nodes))
    return np.stack([np.interp(v, nodes, unit) for unit in units], axis=1)


@dataclass(frozen=True, kw_only=True)
class Bilinear(Simulator, names=("bilinear",)):
    """Identified bilinear model of one input, with matrices at several input levels (nodes). `x+ =
    sum_i theta_i(v) (a_i x + b_i), w = c x`, v and w the scaled input and output.

    Shapes: `nodes (q,)`, ascending, one of them zero, `a (q, n, n)`, `b (q, n)`, zero at that node,
    `c (p, n)`.
    """

    nodes: Float[np.ndarray, "q"]
    a: Float[np.ndarray, "_ _ _"]
    b: Float[np.ndarray, "_ _"]
    c: Float[np.ndarray, "p n"]
    scale: Scale
    step_s: float

    def __post_init__(self) -> None:
        q = len(self.nodes)
        n = self.c.shape[1]
        shapes = (self.a.shape, self.b.shape)
        problem = f"the shapes of a and b must be {(q, n, n)} and {(q, n)}"
        require(shapes == ((q, n, n), (q, n)), "a, b", shapes, problem, AGAIN)
        channels = (self.scale.inputs, self.scale.outputs)
        problem = f"the model has one input and {len(self.c)} outputs"
        require(channels == (1, len(self.c)), "scale", channels, problem, AGAIN)
        ascending = q > 1 and bool((np.diff(self.nodes) > 0).all())
        problem = "the nodes must ascend, and one of them must be zero"
        has_zero = ascending and 0.0 in self.nodes
        require(has_zero, "nodes", self.nodes.tolist(), problem, AGAIN)
        drift = self.b[self.nodes == 0.0].ravel()
        problem = "b must be zero at the node zero, or the model does not rest there"
        require(not drift.any(), "b", drift.tolist(), problem, AGAIN)
        require_positive("step_s", self.step_s, "give it in seconds")

    @property
    def order(self) -> int:
        """Model order, the number of states."""
        return self.c.shape[1]

    def hats(self, u: Float[np.ndarray, "T 1"]) -> Hats:
        """Values of the model's hat functions along a physical input."""
        return hat_functions(self.nodes, self.scale.scaled_input(u)[:, 0])

    def simulate(self, u: Inputs, x0: Float[np.ndarray, "*batch n"] | None = None) -> Outputs:
        """Simulate the model in free run from a given state or from the equilibrium. Inputs and
        outputs are in physical units."""
        starts = np.zeros((*u.shape[:-2], self.order)) if x0 is None else x0
        if u.ndim > 2:
            pairs = zip(u, starts, strict=True)
            return np.stack([self.simulate(*pair) for pair in pairs])
        from ssm_study.models.bilinear_kernel import simulate_states  # loads numba

        x0 = np.asarray(starts, dtype=np.float64)
        states = simulate_states(self.hats(u), self.a, self.b, x0)
        return self.scale.physical_output(states @ self.c.T)

    def simulate_from_outputs(self, u: Inputs, y_start: Measured) -> Outputs:
        """Simulate the model in free run after some measured outputs."""
        if u.ndim > 2:
            pairs = zip(u, y_start, strict=True)
            return np.stack([self.simulate_from_outputs(*pair) for pair in pairs])
        x0 = self.estimate_initial_state(u, y_start) if y_start.shape[-2] else None
        return self.simulate(u, x0)

    def estimate_initial_state(
        self, u: Float[np.ndarray, "T 1"], y_start: Float[np.ndarray, "S p"]
    ) -> Float[np.ndarray, "n"]:
        """Estimate the initial state from the first outputs by regularised least squares. `argmin
        |w - w_hat(x0)|^2 / noise + x0' W^{-1} x0`, W the second moment of the states that the input
        reaches from rest."""
        from ssm_study.models.bilinear_kernel import simulate_state_derivatives, simulate_states

        samples = len(y_start)
        hats = self.hats(u)
        rest = np.zeros(self.order)
        reached = simulate_states(hats, self.a, self.b, rest)
        prior = reached.T @ reached / len(reached)
        states, by_start = simulate_state_derivatives(hats[:samples], self.a, self.b, rest, True)
        regressors = (self.c @ by_start).reshape(-1, self.order)
        missing = self.scale.scaled_output(y_start) - states @ self.c.T
        covariance = regressors @ prior @ regressors.T + START_UP_NOISE * np.eye(len(regressors))
        if not np.isfinite(covariance).all():  # the model is unstable, and its numbers overflow
            return rest
        return np.asarray(prior @ regressors.T @ np.linalg.solve(covariance, missing.ravel()))
