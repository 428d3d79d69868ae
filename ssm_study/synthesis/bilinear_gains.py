"""Gains of controller and observer for a bilinear model, with the least guaranteed cost.

The cost is bounded at all vertices of the model by semidefinite programs; what counts is decided
afterwards in exact arithmetic, in `bilinear_design`. Source: docs/theory.md, "Products of input and
state".
"""

import cvxpy as cp
import numpy as np
from jaxtyping import Float

from ssm_study.certificates.problem import NoSolution, symmetric_part
from ssm_study.certificates.semidefinite import solve_program
from ssm_study.models.bilinear import Bilinear, hat_functions

SOLVER = "CLARABEL"
STRICT = 1e-7  # what makes a solver's inequality strict
DRIFT = 0.05  # variance of the state's drift in a sample, as a share of its second moment
Matrix = Float[np.ndarray, "n n"]


def input_vector_slopes(model: Bilinear) -> Float[np.ndarray, "s n 1"]:
    """Slopes `B_k` of a bilinear model's input vector b between neighbouring input levels (nodes),
    as columns."""
    node_distances = np.diff(model.nodes)
    widths = node_distances[:, None]
    slopes_of_b = np.diff(model.b, axis=0)
    slopes = slopes_of_b / widths
    return slopes[:, :, None]


def state_second_moment(model: Bilinear) -> Matrix:
    """Second moment of a bilinear model's states under random inputs within the model's input
    range."""
    from ssm_study.models.bilinear_kernel import simulate_states  # loads numba

    rng = np.random.default_rng(0)
    lowest_node = model.nodes[0]
    highest_node = model.nodes[-1]
    levels = rng.uniform(lowest_node, highest_node, 200)
    held_levels = np.repeat(levels, 10)
    hats = hat_functions(model.nodes, held_levels)
    zero_state = np.zeros(model.order)
    states = simulate_states(hats, model.a, model.b, zero_state)
    if not np.isfinite(states).all():
        raise NoSolution("the model's free run grows without bound")
    return states.T @ states / len(states)


def feedback_gain(model: Bilinear, input_weight: float) -> Float[np.ndarray, "1 n"]:
    """State-feedback gain K with the smallest quadratic-cost bound that holds at all input levels
    and segments of the model.

    With `W = P^{-1}` and `Z = K W`: `(A + B K)' P (A + B K) - P + C'C + R K'K < 0`, by a Schur
    complement; the trace of P is minimised.
    """
    n = model.order
    p = len(model.c)
    square = (n, n)
    w = cp.Variable(square, symmetric=True)
    z = cp.Variable((1, n))
    bound = cp.Variable((n, n), symmetric=True)
    identity = np.eye(n)
    blocks = [[bound, identity], [identity, w]]
    constraints = [cp.bmat(blocks) >> 0]
    outputs = model.c @ w
    inputs = np.sqrt(input_weight) * z
    for a in model.a:
        for b in input_vector_slopes(model):
            closed = a @ w + b @ z
            zeros = np.zeros((n, p + 1))
            cost = cp.vstack([outputs, inputs])
            metric_row = [w, closed.T, cost.T]
            closed_row = [closed, w, zeros]
            cost_row = [cost, zeros.T, np.eye(p + 1)]
            rows = [metric_row, closed_row, cost_row]
            whole_matrix = cp.bmat(rows)
            size = 2 * n + p + 1
            constraints.append(whole_matrix >> STRICT * np.eye(size))
    cost_bound = cp.trace(bound)
    program = cp.Problem(cp.Minimize(cost_bound), constraints)
    solve_or_raise(program, "no single gain steadies the model at all of its input levels")
    metric = symmetric_solution_matrix(w)
    gain_product = solution_matrix(z).T
    return np.linalg.solve(metric, gain_product).T


def observer_gains(model: Bilinear, sensor_noise: float) -> Float[np.ndarray, "q n p"]:
    """Observer gains L_i with the smallest bound on the estimation error's variance at all input
    levels (nodes).

    With `M` and `Y_i = M L_i`: `(A + L C) S (A + L C)' + G G' + L N L' < S`, `S = M^{-1}`, by a
    Schur complement; the trace of S is minimised.
    """
    n = model.order
    p = len(model.c)
    moment = state_second_moment(model)
    regularised_moment = DRIFT * moment + STRICT * np.trace(moment) * np.eye(n)
    drift = np.linalg.cholesky(regularised_moment)
    square = (n, n)
    m = cp.Variable(square, symmetric=True)
    bound = cp.Variable((n, n), symmetric=True)
    identity = np.eye(n)
    blocks = [[bound, identity], [identity, m]]
    constraints = [cp.bmat(blocks) >> 0]
    products = [cp.Variable((n, p)) for _ in model.a]
    for a, y in zip(model.a, products, strict=True):
        error = m @ a + y @ model.c
        noise = cp.hstack([m @ drift, sensor_noise * y])
        zeros = np.zeros((n, n + p))
        metric_row = [m, error, noise]
        error_row = [error.T, m, zeros]
        noise_row = [noise.T, zeros.T, np.eye(n + p)]
        rows = [metric_row, error_row, noise_row]
        whole_matrix = cp.bmat(rows)
        size = 3 * n + p
        constraints.append(whole_matrix >> STRICT * np.eye(size))
    variance_bound = cp.trace(bound)
    program = cp.Problem(cp.Minimize(variance_bound), constraints)
    solve_or_raise(program, "no gains make an observer converge at all of the input levels")
    metric = symmetric_solution_matrix(m)
    gains = [np.linalg.solve(metric, solution_matrix(y)) for y in products]
    return np.stack(gains)


def solve_or_raise(program: cp.Problem, failure_reason: str) -> str:
    """Solve a cvxpy program and return its status; raises `NoSolution` with a given reason if there
    is no solution."""
    try:
        return solve_program(program, SOLVER)
    except NoSolution as failure:
        raise NoSolution(f"{failure_reason} ({failure})") from failure


def solution_matrix(variable: cp.Variable) -> Float[np.ndarray, "_ _"]:
    """Value of a matrix variable of a solved cvxpy program."""
    return np.asarray(variable.value)


def symmetric_solution_matrix(variable: cp.Variable) -> Matrix:
    """Symmetric part of the value of a matrix variable of a solved cvxpy program."""
    return symmetric_part(solution_matrix(variable))
