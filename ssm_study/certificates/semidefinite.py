"""Solution of semidefinite programs by cvxpy."""

import warnings
from typing import Any

import cvxpy as cp

from ssm_study.certificates.problem import NoSolution

# SCS is a first-order method: at these limits it stops within seconds, accurate or not; the exact
# verdict decides. Clarabel's supernodal factorisation is ten times faster than its default from
# order 28, and no slower below.
SOLVERS: dict[str, dict[str, Any]] = {
    "CLARABEL": {"direct_solve_method": "faer", "max_threads": 1},
    "SCS": {"max_iters": 20_000, "time_limit_secs": 10.0},
}


def solve_program(program: cp.Problem, solver: str) -> str:
    """Solve a semidefinite program that is formulated in cvxpy, in place, and return the solver's
    status. Raises `NoSolution` when the solver returns no matrices."""
    try:
        with warnings.catch_warnings():
            # "may be inaccurate": the exact verdict says whether it matters
            warnings.simplefilter("ignore")
            program.solve(solver=solver, **SOLVERS[solver])
    except (cp.error.SolverError, ArithmeticError, ValueError) as error:
        raise NoSolution(f"{solver.lower()}: {error}") from error
    status = f"{solver.lower()}: {program.status}"
    if any(variable.value is None for variable in program.variables()):
        raise NoSolution(status)
    return status
