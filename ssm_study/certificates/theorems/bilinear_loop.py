"""Controller and observer of a bilinear model: the loop comes to rest from a stated set of initial
states.

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
    """Certificate about a bilinear model, with the matrices of the model. `a_nodes` has the A_i
    below one another, `b_nodes` the b_i in its rows."""

    nodes: Float[np.ndarray, "q"]
    a_nodes: Float[np.ndarray, "qn n"]
    b_nodes: Float[np.ndarray, "q n"]
    k: Float[np.ndarray, "m n"]
    p: Float[np.ndarray, "n n"]
    factor_controller: float
    factor: float

    metric_matrix: ClassVar[str] = "p"

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        """Fields of the certificate that are matrices of the model."""
        model = context.system
        stacked = model.a.reshape(-1, model.order)
        data = {"nodes": model.nodes, "a_nodes": stacked, "b_nodes": model.b}
        if hasattr(self, "c"):
            data["c"] = model.c
        return data

    @staticmethod
    def required_ball(context: VerificationContext) -> JacobianBall:  # noqa: ARG004
        """Ball of Jacobians of the identity, because a bilinear model has no static maps."""
        return JacobianBall(alpha=1.0, beta=0.0)

    @classmethod
    def largest_provable_rate(cls, context: VerificationContext) -> float | None:  # noqa: ARG003
        """Return None, because no formula for the largest rate is known."""
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
    """Certificate that a bilinear loop comes to rest from a stated set of initial states. `V =
    |x|_P + weight |e|_M` shrinks by `factor` from every start with `V <= radius`."""

    gain_state: float
    gain_error: float
    radius: float

    part: ClassVar[str] = "bilinear_loop"

    @staticmethod
    def conditions(of: Any) -> dict[str, Blocks]:
        """Matrix inequalities at all vertices of the bilinear model, and conditions that connect
        their numbers."""
        matrices = feedback_conditions(of) | observer_conditions(of) | coupling_conditions(of)
        matrices["input by state"] = input_bound_block(of, of.gain_state, of.p)
        matrices["input by error"] = input_bound_block(of, of.gain_error, of.m)
        return matrices | cascade_conditions(of) | range_conditions(of)


def count_nodes(of: Any) -> int:
    """Number of nodes."""
    _, count = of.nodes.shape
    return int(count)


def matrix_at(of: Any, node: int) -> Any:
    """Matrix A of a node."""
    rows = rows_of_node(of, node)
    return of.a_nodes[rows, :]


def rows_of_node(of: Any, node: int) -> slice:
    """Rows that a node has in stacked matrices."""
    _, n = of.a_nodes.shape
    first = node * n
    return slice(first, first + n)


def node_at(of: Any, node: int) -> Any:
    """Scaled input of a node."""
    place = slice(node, node + 1)
    return of.nodes[:, place]


def segment_width(of: Any, segment: int) -> Any:
    """Distance `D_k` between the nodes of a segment."""
    lower = node_at(of, segment)
    upper = node_at(of, segment + 1)
    return upper - lower


def input_step(of: Any, segment: int) -> Any:
    """Step `b_{k+1} - b_k = D_k B_k` over a segment, as a column."""
    lower = slice(segment, segment + 1)
    upper = slice(segment + 1, segment + 2)
    step = of.b_nodes[upper, :] - of.b_nodes[lower, :]
    return step.T


def contraction_blocks(matrix: Any, metric: Any, factor: Any) -> Blocks:
    """Blocks that are positive definite exactly if a matrix shrinks the metric's norm by more than
    a factor. `X' P X < factor^2 P`, by its Schur complement."""
    square = factor * factor
    changed = matrix.T @ metric
    return [[square * metric, changed], [metric]]


def bounded_blocks(matrix: Any, outer: Any, bound: Any, metric: Any) -> Blocks:
    """Block that is positive definite exactly if `X' Q X < bound^2 P`, Q the outer metric."""
    square = bound * bound
    changed = matrix.T @ outer
    return [[square * metric - changed @ matrix]]


def feedback_conditions(of: Any) -> dict[str, Blocks]:
    """Conditions on the state feedback for each node and segment of a bilinear model, both sides
    times `D_k`."""
    conditions: dict[str, Blocks] = {}
    for segment in range(count_nodes(of) - 1):
        width = segment_width(of, segment)
        fed_back = input_step(of, segment) @ of.k
        factor = width * of.factor_controller
        for node in range(count_nodes(of)):
            closed = width * matrix_at(of, node)
            closed = closed + fed_back
            label = f"state feedback at node {node + 1}, segment {segment + 1}"
            conditions[label] = contraction_blocks(closed, of.p, factor)
    return conditions


def observer_conditions(of: Any) -> dict[str, Blocks]:
    """Conditions of the observer, one for each node."""
    conditions: dict[str, Blocks] = {}
    for node in range(count_nodes(of)):
        rows = rows_of_node(of, node)
        injected = of.l_nodes[rows, :] @ of.c
        error_matrix = matrix_at(of, node) + injected
        label = f"observer at node {node + 1}"
        conditions[label] = contraction_blocks(error_matrix, of.m, of.factor_observer)
    return conditions


def coupling_conditions(of: Any) -> dict[str, Blocks]:
    """Conditions that bound the effect of the estimation error on the state, one for each
    segment."""
    conditions: dict[str, Blocks] = {}
    for segment in range(count_nodes(of) - 1):
        width = segment_width(of, segment)
        moved = input_step(of, segment) @ of.k
        bound = width * of.coupling
        label = f"coupling on segment {segment + 1}"
        conditions[label] = bounded_blocks(moved, of.p, bound, of.m)
    return conditions


def input_bound_block(of: Any, gain: Any, metric: Any) -> Blocks:
    """Block that is positive definite exactly if the gain bounds the input by a metric's norm."""
    one = np.eye(1)
    return bounded_blocks(of.k, one, gain, metric)


def cascade_conditions(of: Any) -> dict[str, Blocks]:
    """Conditions on the numbers by which the norms of state and error add up to one that
    shrinks."""
    names = ("factor_controller", "factor_observer", "coupling", "weight")
    conditions = positive_numbers(of, *names)
    conditions["metric of the state"] = [[of.p]]
    conditions["metric of the error"] = [[of.m]]
    above_controller = of.factor - of.factor_controller
    conditions["factor above that of the controller"] = [[above_controller]]
    above_observer = of.factor - of.factor_observer
    excess = of.weight * above_observer
    conditions["factor above that of the observer"] = [[excess - of.coupling]]
    conditions["factor below 1"] = [[1 - of.factor]]
    return conditions


def positive_numbers(of: Any, *names: str) -> dict[str, Blocks]:
    """Conditions that the given numbers of the certificate are positive."""
    return {f"{name} above 0": [[getattr(of, name)]] for name in names}


def range_conditions(of: Any) -> dict[str, Blocks]:
    """Conditions that keep the input within the outermost nodes from every initial state in the
    set."""
    conditions = positive_numbers(of, "radius", "gain_state", "gain_error")
    by_state = of.radius * of.gain_state
    by_error = of.radius * of.gain_error
    last = count_nodes(of) - 1
    limits = {"lowest": -node_at(of, 0), "highest": node_at(of, last)}
    for name, limit in limits.items():
        conditions[f"{name} input by state"] = [[limit - by_state]]
        weighted = of.weight * limit
        conditions[f"{name} input by error"] = [[weighted - by_error]]
    return conditions


def example_numbers(factor_controller: float) -> dict[str, Any]:
    """Numbers of the worked example in the docstring: one state, three nodes, `L_i = 0.1 - A_i`."""
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
