"""Gains of controller and observer for a bilinear model, and the certificates of its closed loop.

Gains are those of least guaranteed cost over all vertices (semidefinite programs); then metrics are
sought for these gains, as they are rounded. What counts is decided afterwards in exact arithmetic.
Source: docs/theory.md, "Products of input and state".
"""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from jaxtyping import Float

from ssm_study.certificates.bilinear_certificates import RestCertificates
from ssm_study.certificates.problem import NoSolution, symmetric_part
from ssm_study.certificates.semidefinite import solve_program
from ssm_study.certificates.theorem import Theorem
from ssm_study.certificates.theorems.bilinear_contraction import BilinearContraction
from ssm_study.certificates.theorems.bilinear_everywhere import BilinearEverywhere
from ssm_study.certificates.theorems.bilinear_loop import BilinearLoop
from ssm_study.models.bilinear import Bilinear, hat_functions
from ssm_study.refusal import require_positive

SOLVER = "CLARABEL"
HALVINGS = 6  # of the interval in which a factor is sought
ROUNDING = 1e-6  # relative: what keeps an inequality strict after numbers are rounded
STRICT = 1e-7  # what makes a solver's inequality strict
BACK_OFF = 0.05  # share of the way from the least factor to one, which leaves room for the metric
OBSERVER_SHARE = 0.25  # of the way from the observer's factor to one, that of the loop at least
DRIFT = 0.05  # variance of the state's drift in a sample, as a share of its second moment
SENSOR_NOISE = 0.05  # deviation of the sensor's noise, scaled units
LARGEST_FACTOR = 0.98  # of a set that is said to contract
Matrix = Float[np.ndarray, "n n"]


@dataclass(frozen=True, kw_only=True)
class BilinearSynthesis:
    """Settings of a bilinear design: weight of the input in the cost, and deviation of the sensor
    noise."""

    input_weight: float = 1.0
    sensor_noise: float = SENSOR_NOISE

    def __post_init__(self) -> None:
        require_positive("input_weight", self.input_weight, "try 1")
        require_positive("sensor_noise", self.sensor_noise, "try 0.05")

    def design(self, model: Bilinear) -> RestCertificates:
        """Design controller and observer of a bilinear model, and certify their closed loop."""
        try:
            k = feedback_gain(model, self.input_weight)
            gains = observer_gains(model, self.sensor_noise)
        except NoSolution as failure:
            k = np.zeros((1, model.order))
            gains = np.zeros((len(model.nodes), model.order, len(model.c)))
            return RestCertificates(k=k, l_nodes=gains, parts={}, reasons={"gains": str(failure)})
        loop = LoopVertices(model=model, k=k, gains=gains)
        parts: dict[str, Theorem] = {}
        reasons: dict[str, str] = {}
        for find in (certify_loop, certify_everywhere, certify_contraction):
            label = find.__name__.replace("certify", "bilinear")
            try:
                parts[label] = find(loop)
            except NoSolution as failure:
                reasons[label] = str(failure)
        return RestCertificates(k=k, l_nodes=gains, parts=parts, reasons=reasons)


@dataclass(frozen=True, kw_only=True)
class LoopVertices:
    """Matrices of a bilinear loop at the nodes and segments of its input, and metrics in which they
    contract."""

    model: Bilinear
    k: Float[np.ndarray, "1 n"]
    gains: Float[np.ndarray, "q n p"]

    @property
    def limit(self) -> float:
        """Largest input amplitude, in both directions, that stays within the nodes."""
        return float(min(-self.model.nodes[0], self.model.nodes[-1]))

    @cached_property
    def closed_loops(self) -> list[Matrix]:
        """Closed-loop matrices `A_i + B_k K` of all nodes and segments."""
        return [a + b @ self.k for a in self.model.a for b in input_columns(self.model)]

    @cached_property
    def error_matrices(self) -> list[Matrix]:
        """Matrices `A_i + L_i C` of the estimation error at all nodes."""
        pairs = zip(self.model.a, self.gains, strict=True)
        return [a + gain @ self.model.c for a, gain in pairs]

    @property
    def floor(self) -> Matrix:
        """Smallest metric that is allowed; in it the input is at most the norm of the state."""
        return self.k.T @ self.k + ROUNDING * np.eye(self.model.order)

    @cached_property
    def state_metric(self) -> Matrix:
        """Metric in which the state contracts under the state feedback."""
        reason = "no metric is found in which the state shrinks at all input levels"
        return contraction_metric(self.closed_loops, self.floor, reason)

    @cached_property
    def uncontrolled_metric(self) -> Matrix:
        """Metric in which the state contracts with and without the state feedback."""
        reason = "the model without control is not shown to come to rest at all input levels"
        return contraction_metric([*self.closed_loops, *self.model.a], self.floor, reason)

    @cached_property
    def error_metric(self) -> Matrix:
        """Metric in which the estimation error contracts."""
        reason = "no metric is found in which the observer's error shrinks"
        return contraction_metric(self.error_matrices, self.floor, reason)


def input_columns(model: Bilinear) -> Float[np.ndarray, "s n 1"]:
    """Slopes `B_k` of the vector b over the segments between nodes, as columns."""
    widths = np.diff(model.nodes)[:, None]
    slopes = np.diff(model.b, axis=0) / widths
    return slopes[:, :, None]


def state_second_moment(model: Bilinear) -> Matrix:
    """Second moment of the states that random inputs within the nodes reach."""
    from ssm_study.models.bilinear_kernel import simulate_states  # loads numba

    rng = np.random.default_rng(0)
    levels = rng.uniform(model.nodes[0], model.nodes[-1], 200)
    hats = hat_functions(model.nodes, np.repeat(levels, 10))
    states = simulate_states(hats, model.a, model.b, np.zeros(model.order))
    if not np.isfinite(states).all():
        raise NoSolution("the model's free run grows without bound")
    return states.T @ states / len(states)


def feedback_gain(model: Bilinear, input_weight: float) -> Float[np.ndarray, "1 n"]:
    """State-feedback gain K with the smallest bound on a quadratic cost that holds at all vertices
    of the model.

    With `W = P^{-1}` and `Z = K W`: `(A + B K)' P (A + B K) - P + C'C + R K'K < 0`, by a Schur
    complement; the trace of P is minimised.
    """
    n = model.order
    p = len(model.c)
    w = cp.Variable((n, n), symmetric=True)
    z = cp.Variable((1, n))
    bound = cp.Variable((n, n), symmetric=True)
    identity = np.eye(n)
    constraints = [cp.bmat([[bound, identity], [identity, w]]) >> 0]
    outputs = model.c @ w
    inputs = np.sqrt(input_weight) * z
    for a in model.a:
        for b in input_columns(model):
            closed = a @ w + b @ z
            zeros = np.zeros((n, p + 1))
            cost = cp.vstack([outputs, inputs])
            rows = [[w, closed.T, cost.T], [closed, w, zeros], [cost, zeros.T, np.eye(p + 1)]]
            constraints.append(cp.bmat(rows) >> STRICT * np.eye(2 * n + p + 1))
    program = cp.Problem(cp.Minimize(cp.trace(bound)), constraints)
    solve_or_explain(program, "no single gain steadies the model at all of its input levels")
    return np.linalg.solve(symmetric_value(w), solved_value(z).T).T


def observer_gains(model: Bilinear, sensor_noise: float) -> Float[np.ndarray, "q n p"]:
    """Observer gains L_i with the smallest bound on the variance of the estimation error that holds
    at all nodes.

    With `M` and `Y_i = M L_i`: `(A + L C) S (A + L C)' + G G' + L N L' < S`, `S = M^{-1}`, by a
    Schur complement; the trace of S is minimised.
    """
    n = model.order
    p = len(model.c)
    moment = state_second_moment(model)
    drift = np.linalg.cholesky(DRIFT * moment + STRICT * np.trace(moment) * np.eye(n))
    m = cp.Variable((n, n), symmetric=True)
    bound = cp.Variable((n, n), symmetric=True)
    identity = np.eye(n)
    constraints = [cp.bmat([[bound, identity], [identity, m]]) >> 0]
    products = [cp.Variable((n, p)) for _ in model.a]
    for a, y in zip(model.a, products, strict=True):
        error = m @ a + y @ model.c
        noise = cp.hstack([m @ drift, sensor_noise * y])
        zeros = np.zeros((n, n + p))
        rows = [[m, error, noise], [error.T, m, zeros], [noise.T, zeros.T, np.eye(n + p)]]
        constraints.append(cp.bmat(rows) >> STRICT * np.eye(3 * n + p))
    program = cp.Problem(cp.Minimize(cp.trace(bound)), constraints)
    solve_or_explain(program, "no gains make an observer converge at all of the input levels")
    metric = symmetric_value(m)
    return np.stack([np.linalg.solve(metric, solved_value(y)) for y in products])


def solve_or_explain(program: cp.Problem, reason: str) -> str:
    """Solve a cvxpy program and return its status; raises `NoSolution` with the given reason."""
    try:
        return solve_program(program, SOLVER)
    except NoSolution as failure:
        raise NoSolution(f"{reason} ({failure})") from failure


def solved_value(variable: cp.Variable) -> Float[np.ndarray, "_ _"]:
    """Matrix that a solver found for a variable."""
    return np.asarray(variable.value)


def symmetric_value(variable: cp.Variable) -> Matrix:
    """Symmetric matrix that a solver found for a variable."""
    return symmetric_part(solved_value(variable))


def contraction_metric(matrices: list[Matrix], floor: Matrix, reason: str) -> Matrix:
    """Smallest metric in which all given matrices contract, by nearly the smallest common factor.
    Raises `NoSolution` with the reason where none is found."""
    highest = 1.0 - 10.0 * ROUNDING
    metric = metric_for_factor(matrices, highest, floor, reason)
    lowest = max(float(np.abs(np.linalg.eigvals(matrix)).max()) for matrix in matrices)
    for _ in range(HALVINGS):
        factor = 0.5 * (lowest + highest)
        try:
            metric = metric_for_factor(matrices, factor, floor, reason)
            highest = factor
        except NoSolution:
            lowest = factor
    try:
        return metric_for_factor(matrices, highest + BACK_OFF * (1.0 - highest), floor, reason)
    except NoSolution:
        return metric


def metric_for_factor(matrices: list[Matrix], factor: float, floor: Matrix, reason: str) -> Matrix:
    """Metric in which all given matrices contract by a given factor."""
    n = len(floor)
    p = cp.Variable((n, n), symmetric=True)
    constraints = [p >> floor]
    for matrix in matrices:
        rows = [[factor**2 * p, matrix.T @ p], [p @ matrix, p]]
        constraints.append(cp.bmat(rows) >> STRICT * np.eye(2 * n))
    program = cp.Problem(cp.Minimize(cp.trace(p)), constraints)
    status = solve_or_explain(program, reason)
    if not status.endswith("optimal"):
        raise NoSolution(f"{reason} ({status})")
    return symmetric_value(p)


def largest_norm_factor(matrices: list[Matrix], metric: Matrix) -> float:
    """Largest factor by which any of several matrices changes a metric's norm, rounded up."""
    root = np.linalg.cholesky(metric).T
    inverse = np.linalg.inv(root)
    norms = [float(np.linalg.norm(root @ matrix @ inverse, 2)) for matrix in matrices]
    return max(*norms, ROUNDING) * (1.0 + ROUNDING)


def bound_by_metric(
    rows: Float[np.ndarray, "_ n"], metric: Matrix, outer: Float[np.ndarray, "_ _"] | None = None
) -> float:
    """Smallest g with `|rows x| <= g |x|` in the norms of given metrics, rounded up."""
    inverse = np.linalg.inv(np.linalg.cholesky(metric).T)
    left = np.eye(len(rows)) if outer is None else np.linalg.cholesky(outer).T
    return max(float(np.linalg.norm(left @ rows @ inverse, 2)), ROUNDING) * (1.0 + ROUNDING)


def model_and_feedback_numbers(loop: LoopVertices, p: Matrix) -> dict[str, Any]:
    """Fields that every certificate of a bilinear loop has: model matrices, state feedback and its
    metric."""
    model = loop.model
    return {
        "alpha": 1.0,
        "beta": 0.0,
        "nodes": model.nodes,
        "a_nodes": model.a.reshape(-1, model.order),
        "b_nodes": model.b,
        "k": loop.k,
        "p": p,
        "factor_controller": largest_norm_factor(loop.closed_loops, p),
    }


def observer_numbers(loop: LoopVertices, p: Matrix, least_factor: float) -> dict[str, Any]:
    """Fields that every certificate of a bilinear loop with an observer has: observer gains and
    their metric."""
    model = loop.model
    m = loop.error_metric
    factor_observer = largest_norm_factor(loop.error_matrices, m)
    coupling = max(bound_by_metric(b @ loop.k, m, p) for b in input_columns(model))
    through_observer = factor_observer + OBSERVER_SHARE * (1.0 - factor_observer)
    above = least_factor + ROUNDING + BACK_OFF * (1.0 - least_factor)
    factor = max(above, through_observer)
    return {
        "c": model.c,
        "l_nodes": loop.gains.reshape(-1, len(model.c)),
        "m": m,
        "factor_observer": factor_observer,
        "coupling": coupling,
        "weight": coupling / (factor - factor_observer) * (1.0 + ROUNDING),
        "factor": factor,
    }


def certify_loop(loop: LoopVertices) -> BilinearLoop:
    """Certificate that a bilinear loop comes to rest from a set of initial states."""
    started = time.perf_counter()
    refuse_one_sided_input(loop)
    numbers = model_and_feedback_numbers(loop, loop.state_metric)
    numbers |= observer_numbers(loop, loop.state_metric, numbers["factor_controller"])
    gain_state = bound_by_metric(loop.k, loop.state_metric)
    gain_error = bound_by_metric(loop.k, loop.error_metric)
    reach = max(gain_state, gain_error / numbers["weight"])
    numbers["gain_state"] = gain_state
    numbers["gain_error"] = gain_error
    numbers["radius"] = loop.limit / reach * (1.0 - ROUNDING)
    return decide_exactly(BilinearLoop, numbers, started)


def certify_everywhere(loop: LoopVertices) -> BilinearEverywhere:
    """Certificate that a bilinear loop with a limited input comes to rest from every initial
    state."""
    started = time.perf_counter()
    p = loop.uncontrolled_metric
    numbers = model_and_feedback_numbers(loop, p)
    uncontrolled = largest_norm_factor([*loop.model.a], p)
    numbers["factor_uncontrolled"] = uncontrolled
    numbers |= observer_numbers(loop, p, max(numbers["factor_controller"], uncontrolled))
    return decide_exactly(BilinearEverywhere, numbers, started)


def certify_contraction(loop: LoopVertices) -> BilinearContraction:
    """Certificate that two trajectories of a bilinear loop approach each other inside a set of
    states."""
    started = time.perf_counter()
    refuse_one_sided_input(loop)
    model = loop.model
    numbers = model_and_feedback_numbers(loop, loop.state_metric)
    widths = np.diff(model.nodes)[:, None, None]
    changes = np.diff(model.a, axis=0) / widths
    variation = largest_norm_factor([*changes], loop.state_metric)
    gain_state = bound_by_metric(loop.k, loop.state_metric)
    slope = variation * gain_state
    controller = numbers["factor_controller"]
    largest = max(LARGEST_FACTOR, 0.5 * (1.0 + controller))
    radius = min((largest - controller) / slope, loop.limit / gain_state)
    radius *= 1.0 - ROUNDING
    factor = controller + radius * slope * (1.0 + ROUNDING) + STRICT
    numbers |= {
        "gain_state": gain_state,
        "variation": variation,
        "radius": radius,
        "factor": factor,
    }
    return decide_exactly(BilinearContraction, numbers, started)


def refuse_one_sided_input(loop: LoopVertices) -> None:
    """Raise `NoSolution` if the input at the equilibrium is the smallest or largest input of the
    log."""
    if loop.limit <= 0.0:
        raise NoSolution("the equilibrium of the input is an end of the inputs that the log has")


def decide_exactly(kind: Any, numbers: dict[str, Any], started: float) -> Any:
    """Certificate with the verdict of exact arithmetic; raises `NoSolution` if it is refused."""
    status = f"{SOLVER.lower()}: optimal"
    certificate = kind.from_numbers(numbers, started=started, status=status, method="vertices")
    if not certificate.certified:
        raise NoSolution("the solver's numbers do not prove it in exact arithmetic")
    return certificate
