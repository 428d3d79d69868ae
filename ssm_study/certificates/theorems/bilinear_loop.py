"""Proof that a bilinear model in closed loop with controller and observer comes to rest from a set
of initial states.

Problem. `x+ = sum_i theta_i(v) (A_i x + b_i)`, `w = C x`, one input v, hat functions `theta_i` on
nodes `v_1 < ... < v_q`, `b_i = 0` at the node zero. `v = K xh`, `xh+ = sum_i theta_i(v) (A_i xh +
b_i + L_i (C xh - w))`: does the loop come to rest, and from where?

Hypotheses. The input acts as computed, and the plant is the model. Zero lies between two nodes;
that b is zero there is checked where the model is read.

Statement. With `D_k = v_{k+1} - v_k` and `B_k = (b_{k+1} - b_k) / D_k`, let for all i and k

    (A_i + B_k K)' P (A_i + B_k K) < r_c^2 P,   (A_i + L_i C)' M (A_i + L_i C) < r_o^2 M,
    (B_k K)' P (B_k K) < kappa^2 M,   K'K < g_x^2 P,   K'K < g_e^2 M

and `r > r_c`, `gamma (r - r_o) > kappa`, `rho max(g_x, g_e / gamma) < min(-v_1, v_q)`, `r < 1`.
Then `V = |x|_P + gamma |xh - x|_M` shrinks by r or more in each sample, from every start with `V <=
rho`, and v stays within the nodes. Proof: `b(v) = B(v) v` with B(v) a mean of the B_k, A(v) one of
the A_i, so `x+ = (A + B K) x + B K e` and `e+ = (A + L C) e`; `|v| <= g_x |x|_P + g_e |e|_M`. The
error of the observer shrinks by r_o for every input, from every start.

When not to use it. It compares each motion with rest, not two motions with each other: there are no
set points, and no bound for a disturbance that does not vanish. Where zero is an end of the inputs
use `bilinear_everywhere`. With one node at each end far away, the vertices ask for more than the
model does.

Reference. docs/theory.md, "Products of input and state"; Boyd, El Ghaoui, Feron,
Balakrishnan (1994), section 5.1 (polytopes of matrices).

Example. `x+ = (0.5 + 0.1 v) x + v` between -1 and 1, `K = -0.2`: at the nodes 0.2, 0.3 and 0.4
times x are left, so `r_c = 0.45` is proved and 0.35 is not.

>>> print(*(BilinearLoop.holds(**example_numbers(r_c)) for r_c in (0.45, 0.35)))
True False
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.theorem import Blocks, Theorem, VerificationContext
from ssm_study.systems import JacobianBall


@dataclass(frozen=True, kw_only=True)
class BilinearTheorem(Theorem, abstract=True):
    """Base class of certificates about a bilinear model, with the matrices of the model. `a_nodes`
    has the A_i below one another, `b_nodes` the b_i in its rows."""

    nodes: Float[np.ndarray, "q"]
    a_nodes: Float[np.ndarray, "qn n"]
    b_nodes: Float[np.ndarray, "q n"]
    k: Float[np.ndarray, "m n"]
    p: Float[np.ndarray, "n n"]
    factor_controller: float
    factor: float

    metric_matrix: ClassVar[str] = "p"

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of a certificate that are matrices of the bilinear model."""
        model = context.system
        stacked = model.a.reshape(-1, model.order)
        data = {"nodes": model.nodes, "a_nodes": stacked, "b_nodes": model.b}
        if hasattr(self, "c"):
            data["c"] = model.c
        return data

    @staticmethod
    def required_ball(context: VerificationContext) -> JacobianBall:  # noqa: ARG004
        """Ball of Jacobians of the identity map, because a bilinear model has no static maps."""
        return JacobianBall(alpha=1.0, beta=0.0)

    @classmethod
    def largest_provable_rate(cls, context: VerificationContext) -> float | None:  # noqa: ARG003
        """Return None, because no formula is known for the largest contraction rate of a bilinear
        model."""
        return None


@dataclass(frozen=True, kw_only=True)
class BilinearLoopTheorem(BilinearTheorem, abstract=True):
    """Base class of certificates about the closed loop of a bilinear model with its observer."""

    c: Float[np.ndarray, "p n"]
    l_nodes: Float[np.ndarray, "qn p"]
    m: Float[np.ndarray, "n n"]
    factor_observer: float
    coupling: float
    weight: float


@dataclass(frozen=True, kw_only=True)
class BilinearLoop(BilinearLoopTheorem):
    """Certificate that a bilinear closed loop comes to rest from a stated set of initial states. `V
    = |x|_P + weight |e|_M` shrinks by `factor` from every start with `V <= radius`."""

    gain_state: float
    gain_error: float
    radius: float

    part: ClassVar[str] = "bilinear_loop"

    @staticmethod
    def conditions(proof: Any) -> dict[str, Blocks]:
        """Matrix inequalities at all input levels and segments of a bilinear loop with observer,
        and conditions that connect them."""
        matrices = (
            feedback_conditions(proof) | observer_conditions(proof) | coupling_conditions(proof)
        )
        matrices["input by state"] = input_bound_block(proof, proof.gain_state, proof.p)
        matrices["input by error"] = input_bound_block(proof, proof.gain_error, proof.m)
        return matrices | cascade_conditions(proof) | range_conditions(proof)


def count_nodes(proof: Any) -> int:
    """Number of input levels (nodes) at which the matrices of a bilinear model are given."""
    _, count = proof.nodes.shape
    return int(count)


def state_matrix_at_node(proof: Any, node: int) -> Any:
    """State matrix A of a bilinear model at a given input level (node)."""
    rows = rows_of_node(proof, node)
    return proof.a_nodes[rows, :]


def rows_of_node(proof: Any, node: int) -> slice:
    """Rows that belong to one input level (node) in the stacked matrices of a bilinear model."""
    _, n = proof.a_nodes.shape
    first = node * n
    return slice(first, first + n)


def input_level_of_node(proof: Any, node: int) -> Any:
    """Scaled input at one input level (node) of a bilinear model."""
    place = slice(node, node + 1)
    return proof.nodes[:, place]


def segment_width(proof: Any, segment: int) -> Any:
    """Distance `D_k` between two neighbouring input levels (nodes) of a bilinear model."""
    lower = input_level_of_node(proof, segment)
    upper = input_level_of_node(proof, segment + 1)
    return upper - lower


def input_vector_step(proof: Any, segment: int) -> Any:
    """Change `b_{k+1} - b_k = D_k B_k` of a bilinear model's input vector between neighbouring
    input levels, as a column."""
    lower = slice(segment, segment + 1)
    upper = slice(segment + 1, segment + 2)
    step = proof.b_nodes[upper, :] - proof.b_nodes[lower, :]
    return step.T


def contraction_blocks(matrix: Any, metric: Any, factor: Any) -> Blocks:
    """Block matrix that is positive definite exactly if a matrix shrinks the norm in a metric by a
    given factor. `X' P X < factor^2 P`, by its Schur complement."""
    square = factor * factor
    changed = matrix.T @ metric
    return [[square * metric, changed], [metric]]


def gain_bound_blocks(matrix: Any, output_metric: Any, bound: Any, metric: Any) -> Blocks:
    """Block matrix that is positive definite exactly if a matrix X has a gain below a bound between
    two metrics: `X' Q X < bound^2 P`."""
    square = bound * bound
    changed = matrix.T @ output_metric
    return [[square * metric - changed @ matrix]]


def feedback_conditions(proof: Any) -> dict[str, Blocks]:
    """Conditions on the state feedback of a bilinear model, one for each pair of an input level
    (node) and a segment between levels. Both sides are multiplied by the segment's width."""
    conditions: dict[str, Blocks] = {}
    for segment in range(count_nodes(proof) - 1):
        width = segment_width(proof, segment)
        fed_back = input_vector_step(proof, segment) @ proof.k
        factor = width * proof.factor_controller
        for node in range(count_nodes(proof)):
            closed = width * state_matrix_at_node(proof, node)
            closed = closed + fed_back
            label = f"state feedback at node {node + 1}, segment {segment + 1}"
            conditions[label] = contraction_blocks(closed, proof.p, factor)
    return conditions


def observer_conditions(proof: Any) -> dict[str, Blocks]:
    """Conditions on the observer of a bilinear model, one for each input level (node)."""
    conditions: dict[str, Blocks] = {}
    for node in range(count_nodes(proof)):
        rows = rows_of_node(proof, node)
        injected = proof.l_nodes[rows, :] @ proof.c
        error_matrix = state_matrix_at_node(proof, node) + injected
        label = f"observer at node {node + 1}"
        conditions[label] = contraction_blocks(error_matrix, proof.m, proof.factor_observer)
    return conditions


def coupling_conditions(proof: Any) -> dict[str, Blocks]:
    """Conditions that bound how much the estimation error moves the state of a bilinear loop, one
    per segment between input levels."""
    conditions: dict[str, Blocks] = {}
    for segment in range(count_nodes(proof) - 1):
        width = segment_width(proof, segment)
        moved = input_vector_step(proof, segment) @ proof.k
        bound = width * proof.coupling
        label = f"coupling on segment {segment + 1}"
        conditions[label] = gain_bound_blocks(moved, proof.p, bound, proof.m)
    return conditions


def input_bound_block(proof: Any, gain: Any, metric: Any) -> Blocks:
    """Block matrix that is positive definite exactly if `|K x| <= gain |x|_metric` for every
    state."""
    one = np.eye(1)
    return gain_bound_blocks(proof.k, one, gain, metric)


def cascade_conditions(proof: Any) -> dict[str, Blocks]:
    """Conditions under which a weighted sum of the norms of state and estimation error shrinks in
    each sample."""
    names = ("factor_controller", "factor_observer", "coupling", "weight")
    conditions = positivity_conditions(proof, *names)
    conditions["metric of the state"] = [[proof.p]]
    conditions["metric of the error"] = [[proof.m]]
    above_controller = proof.factor - proof.factor_controller
    conditions["factor above that of the controller"] = [[above_controller]]
    above_observer = proof.factor - proof.factor_observer
    excess = proof.weight * above_observer
    conditions["factor above that of the observer"] = [[excess - proof.coupling]]
    conditions["factor below 1"] = [[1 - proof.factor]]
    return conditions


def positivity_conditions(proof: Any, *names: str) -> dict[str, Blocks]:
    """Conditions that some scalars in a certificate, such as the radius, are positive."""
    return {f"{name} above 0": [[getattr(proof, name)]] for name in names}


def range_conditions(proof: Any) -> dict[str, Blocks]:
    """Conditions under which the input stays between the outermost input levels (nodes), from every
    certified initial state."""
    conditions = positivity_conditions(proof, "radius", "gain_state", "gain_error")
    by_state = proof.radius * proof.gain_state
    by_error = proof.radius * proof.gain_error
    last = count_nodes(proof) - 1
    limits = {"lowest": -input_level_of_node(proof, 0), "highest": input_level_of_node(proof, last)}
    for name, limit in limits.items():
        conditions[f"{name} input by state"] = [[limit - by_state]]
        weighted = proof.weight * limit
        conditions[f"{name} input by error"] = [[weighted - by_error]]
    return conditions


def example_numbers(factor_controller: float) -> dict[str, Any]:
    """Numbers of a worked example: a bilinear loop with one state, three input levels and `L_i =
    0.1 - A_i`."""
    one = np.ones((1, 1))
    a_nodes = np.array([[0.4], [0.5], [0.6]])
    nodes = np.array([-1.0, 0.0, 1.0])
    numbers: dict[str, Any] = {"factor_observer": 0.2, "coupling": 0.25, "weight": 1.0}
    numbers |= {"factor": 0.5, "factor_controller": factor_controller}
    numbers |= {"gain_state": 0.3, "gain_error": 0.3, "radius": 3.0}
    numbers |= {"nodes": nodes, "a_nodes": a_nodes, "b_nodes": nodes[:, None]}
    numbers |= {"c": one, "p": one, "m": one}
    numbers["k"] = -0.2 * one
    numbers["l_nodes"] = 0.1 - a_nodes
    return numbers
