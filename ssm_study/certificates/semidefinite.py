"""Solution of semidefinite programs by cvxpy, and the program that proves
`theorems.structured_tolerance`."""

import warnings
from collections.abc import Iterator
from typing import Any

import cvxpy as cp
import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import NoSolution, symmetric_part

# SCS is a first-order method: at these limits it stops within seconds, accurate or not; the exact
# verdict decides. Clarabel's supernodal factorisation is ten times faster than its default from
# order 28, and no slower below.
SOLVERS: dict[str, dict[str, Any]] = {
    "CLARABEL": {"direct_solve_method": "faer", "max_threads": 1},
    "SCS": {"max_iters": 20_000, "time_limit_secs": 10.0},
}
# directions that no signal reaches keep this share of the mean: with less the solver fails
FLOOR = 1e-3
LEAST_BALL = (
    1e-2  # radius whose multiplier is scaled as this one's; without any it has next to no effect
)
INSIDE_LARGEST = (1e-3, 1e-2, 0.1)  # likewise of a tolerance, in order of trial

Rows = Float[np.ndarray, "_ _"]


def solve_program(program: cp.Problem, solver: str) -> str:
    """Solve a cvxpy program in place and return its status. Raises `NoSolution` when the solver
    returns no matrices."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # "may be inaccurate": the exact verdict says whether it matters
            program.solve(solver=solver, **SOLVERS[solver])
    except (cp.error.SolverError, ArithmeticError, ValueError) as error:
        raise NoSolution(f"{solver.lower()}: {error}") from error
    status = f"{solver.lower()}: {program.status}"
    if any(variable.value is None for variable in program.variables()):
        raise NoSolution(status)
    return status


def largest_mismatch(
    loop: Rows, into_u: Rows, seen: Rows, into_w: Rows, beta: float
) -> Iterator[dict[str, Any]]:
    """Largest mismatch that a semidefinite program proves for a loop with neurons. `s, lambda_p, p,
    lambda_` of `theorems.structured_tolerance` from its matrices, each `INSIDE_LARGEST` of s.

    In coordinates where every signal has unit size while all slopes are one half: the loop's own
    Gramian. Raises `NoSolution` where the solver ends without matrices, `LinAlgError` for a loop
    that does not rest at these slopes.
    """
    order, width = loop.shape
    m = len(into_u)
    enter = seen.shape[1]  # (xi, p, e) enter, neurons stand beside
    at_half_slopes = loop[:, :enter] + loop[:, enter:] @ seen / 2
    right, moved, w, z = _signal_scales(at_half_slopes, into_u, seen, into_w, beta)
    sizes_of_signals = [*np.full(m, moved), *np.ones(enter - order - m), *z]
    scale = scipy.linalg.block_diag(right, np.diag(sizes_of_signals))
    one = np.eye(width)
    state = one[:order]
    uncertainty = one[order : order + m]
    mismatch = one[order + m : enter]
    neurons = one[enter:]
    step = np.linalg.solve(right, loop @ scale)
    neuron_inputs = (seen @ scale[:enter]) / z[:, None]
    input_rows = beta / moved * into_u @ scale[:order]
    weighted_rows = into_w @ scale[:order] / w
    p = cp.Variable((order, order), symmetric=True)
    weights = cp.Variable(len(z))
    lambda_p = cp.Variable()
    mu = cp.Variable()
    t = cp.Variable()
    given = cp.Parameter()

    def room(mu: Any) -> cp.Expression:
        """Identity matrix times a variable slack, by which an inequality is strict."""
        sectors = neurons.T @ cp.diag(weights) @ (neurons - neuron_inputs)
        ball = lambda_p * (uncertainty.T @ uncertainty - input_rows.T @ input_rows)
        gain = mu * (weighted_rows.T @ weighted_rows)
        supply = ball - gain + mismatch.T @ mismatch
        return state.T @ p @ state - step.T @ p @ step + sectors + sectors.T + supply

    solve_program(cp.Problem(cp.Maximize(mu), [room(mu) >> 0]), "CLARABEL")
    if not float(np.asarray(mu.value)) > 0:  # below zero the mismatch would have to help
        raise NoSolution("the loop is not proved to rest without any mismatch")
    deepest = cp.Problem(cp.Maximize(t), [room(given) >> t * one])
    left = np.linalg.inv(right)
    for share in INSIDE_LARGEST:
        given.value = np.asarray(mu.value) * (1 - share) ** 2
        solve_program(deepest, "CLARABEL")
        numbers = {"p": symmetric_part(left.T @ p.value @ left), "lambda_": weights.value / z**2}
        sizes = {
            "s": float(np.sqrt(given.value)) / w,
            "lambda_p": float(np.asarray(lambda_p.value)) / moved**2,
        }
        yield numbers | sizes


def _signal_scales(
    middle: Rows, into_u: Rows, seen: Rows, into_w: Rows, beta: float
) -> tuple[Rows, float, float, Float[np.ndarray, "_"]]:
    """Sizes of the loop's signals, by which the semidefinite program is scaled. A root of the
    Gramian of the loop `[A B_p B_e]`, and the sizes of p, `W u` and what the neurons see in it."""
    order, width = middle.shape
    m = len(into_u)
    moved = 0.0  # of p: none at first, then what e alone makes of u
    for _ in range(2):
        into = middle[:, order:] * np.repeat([moved, 1.0], [m, width - order - m])
        gramian = scipy.linalg.solve_discrete_lyapunov(middle[:, :order], into @ into.T)
        least = FLOOR * np.trace(gramian) / order * np.eye(order)
        right = np.linalg.cholesky(symmetric_part(gramian) + least)
        u = np.linalg.norm(into_u[:, :order] @ right, axis=1)
        w = np.linalg.norm(into_w[:, :order] @ right, axis=1)
        z = np.linalg.norm(seen[:, :order] @ right, axis=1)
        moved = float(u.max()) * max(beta, LEAST_BALL)
        if not moved > 0:
            raise NoSolution("the mismatch does not reach the input")
    return right, moved, float(w.max()), np.maximum(z, FLOOR * z.max())
