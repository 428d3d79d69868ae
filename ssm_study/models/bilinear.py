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
    """Values of the hat functions that interpolate linearly between input levels (nodes), at given
    inputs. They are linear between the nodes and constant beyond the ends, so that each row adds up
    to one."""
    units = np.eye(len(nodes))
    unit_responses = [np.interp(v, nodes, unit) for unit in units]
    return np.stack(unit_responses, axis=1)


@dataclass(frozen=True, kw_only=True)
class Bilinear(Simulator, names=("bilinear",)):
    """Identified bilinear model with one input, whose matrices are interpolated between input
    levels (nodes). `x+ = sum_i theta_i(v) (a_i x + b_i), w = c x`, v and w the scaled input and
    output.

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
        shape_of_a = self.a.shape
        shape_of_b = self.b.shape
        shapes = (shape_of_a, shape_of_b)
        problem = f"the shapes of a and b must be {(q, n, n)} and {(q, n)}"
        needed_a = (q, n, n)
        needed_b = (q, n)
        require(shapes == (needed_a, needed_b), "a, b", shapes, problem, AGAIN)
        input_count = self.scale.inputs
        output_count = self.scale.outputs
        channels = (input_count, output_count)
        problem = f"the model has one input and {len(self.c)} outputs"
        needed_channels = (1, len(self.c))
        require(channels == needed_channels, "scale", channels, problem, AGAIN)
        ascending = q > 1 and bool((np.diff(self.nodes) > 0).all())
        problem = "the nodes must ascend, and one of them must be zero"
        has_zero = ascending and 0.0 in self.nodes
        node_list = self.nodes.tolist()
        require(has_zero, "nodes", node_list, problem, AGAIN)
        is_zero_node = self.nodes == 0.0
        drift = self.b[is_zero_node].ravel()
        problem = "b must be zero at the node zero, or the model does not rest there"
        has_drift = drift.any()
        drift_list = drift.tolist()
        require(not has_drift, "b", drift_list, problem, AGAIN)
        require_positive("step_s", self.step_s, "give it in seconds")

    @property
    def order(self) -> int:
        """Number of states of a bilinear model."""
        return self.c.shape[1]

    def hat_values(self, u: Float[np.ndarray, "T 1"]) -> Hats:
        """Values of a bilinear model's hat functions along an input signal in physical units."""
        first_input = self.scale.scaled_input(u)[:, 0]
        return hat_functions(self.nodes, first_input)

    def simulate(self, u: Inputs, x0: Float[np.ndarray, "*batch n"] | None = None) -> Outputs:
        """Simulate a bilinear model in free run from a given state or from the equilibrium. Inputs
        and outputs are in physical units."""
        starts = np.zeros((*u.shape[:-2], self.order)) if x0 is None else x0
        if u.ndim > 2:
            pairs = zip(u, starts, strict=True)
            runs = [self.simulate(*pair) for pair in pairs]
            return np.stack(runs)
        from ssm_study.models.bilinear_kernel import simulate_states  # loads numba

        x0 = np.asarray(starts, dtype=np.float64)
        hats = self.hat_values(u)
        states = simulate_states(hats, self.a, self.b, x0)
        scaled_output = states @ self.c.T
        return self.scale.physical_output(scaled_output)

    def simulate_from_outputs(self, u: Inputs, y_start: Measured) -> Outputs:
        """Simulate a bilinear model in free run, continuing a given stretch of measured outputs."""
        if u.ndim > 2:
            pairs = zip(u, y_start, strict=True)
            runs = [self.simulate_from_outputs(*pair) for pair in pairs]
            return np.stack(runs)
        x0 = self.estimate_initial_state(u, y_start) if y_start.shape[-2] else None
        return self.simulate(u, x0)

    def estimate_initial_state(
        self, u: Float[np.ndarray, "T 1"], y_start: Float[np.ndarray, "S p"]
    ) -> Float[np.ndarray, "n"]:
        """Estimate the initial state of a bilinear model from the first outputs by regularised
        least squares. `argmin |w - w_hat(x0)|^2 / noise + x0' W^{-1} x0`, W the second moment of
        the states that the input reaches from rest."""
        from ssm_study.models.bilinear_kernel import simulate_state_derivatives, simulate_states

        samples = len(y_start)
        hats = self.hat_values(u)
        rest = np.zeros(self.order)
        reached = simulate_states(hats, self.a, self.b, rest)
        prior = reached.T @ reached / len(reached)
        first_hats = hats[:samples]
        states, by_start = simulate_state_derivatives(first_hats, self.a, self.b, rest, True)
        output_slopes = self.c @ by_start
        regressors = output_slopes.reshape(-1, self.order)
        measured = self.scale.scaled_output(y_start)
        simulated = states @ self.c.T
        missing = measured - simulated
        output_covariance = regressors @ prior @ regressors.T
        noise_covariance = START_UP_NOISE * np.eye(len(regressors))
        covariance = output_covariance + noise_covariance
        if not np.isfinite(covariance).all():  # the model is unstable, and its numbers overflow
            return rest
        gain = prior @ regressors.T
        weighted_errors = np.linalg.solve(covariance, missing.ravel())
        return np.asarray(gain @ weighted_errors)
