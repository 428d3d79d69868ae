"""[Z26] Theorems 1 and 2 as the paper states them: linear matrix inequalities, through CVXPY.

Compiled once per pair `(A, B)`; rate and ball are parameters, so a sweep over rates re-solves without compiling. The
solver's status is kept as information: inside the frontier its "infeasible" is often false (docs/theory.md), and the
verdict on what it returns is exact arithmetic's.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, TypeVar

import cvxpy as cp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.synthesis.certificate import Infeasible, Observer, StateFeedback
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.problem import NoSolution, Problem, Solution
from ssm_study.systems import JacobianBall, StateSpace

Part = TypeVar("Part", bound=StateFeedback | Observer | Infeasible)

OBJECTIVES = ("feasibility", "largest_margin", "smallest_gain", "guaranteed_cost", "largest_rate")
LARGEST_RATE_STEPS = 12  # halvings between the asked rate and the frontier: the rate to 1/4096 of that interval
# SCS is a first-order method: at these limits it stops within seconds, accurate or not; the exact verdict decides.
# Clarabel's supernodal factorisation is ten times faster than its default from order 28, and no slower below.
SOLVERS: dict[str, dict[str, Any]] = {
    "CLARABEL": {"direct_solve_method": "faer", "max_threads": 1},
    "SCS": {"max_iters": 20_000, "time_limit_secs": 10.0},
}
# The inequality is strict and homogeneous in (P, Y, X, sigma): its scale is fixed by P >= I, its strictness by this.
STRICTNESS = 1e-6


@dataclass(frozen=True, kw_only=True)
class CompiledLmi:
    """Theorem 1 for one pair `(a, b)`, ready to be solved at any rate and ball.

    `full` keeps the extra matrix Y; `Y = P` is lossless with a third of the unknowns. Weights matter for
    `guaranteed_cost` only.
    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n m"]
    objective: str
    full: bool
    state_weight: Float[np.ndarray, "n n"]
    input_weight: float
    parts: dict[str, Any] = field(init=False, repr=False)
    problem: cp.Problem = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n, m = self.b.shape
        p = cp.Variable((n, n), symmetric=True)
        parts = {
            "p": p,
            "y": cp.Variable((n, n)) if self.full else p,
            "x": cp.Variable((m, n)),
            "sigma": cp.Variable(nonneg=True),
            "r2": cp.Parameter(nonneg=True),
            "alpha": cp.Parameter(),
            "beta": cp.Parameter(nonneg=True),
        }
        object.__setattr__(self, "parts", parts)
        goal, constraints = getattr(self, f"_{self.objective}")()
        object.__setattr__(self, "problem", cp.Problem(cp.Minimize(goal), constraints))

    def solve(self, problem: Problem, solver: str = "CLARABEL") -> Solution:
        """Raises `NoSolution` with the solver's status when it returns no matrices."""
        parts = self.parts
        parts["r2"].value = 1 - problem.rate
        parts["alpha"].value, parts["beta"].value = problem.ball.alpha, problem.ball.beta
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # "may be inaccurate": the exact verdict says whether it matters
                self.problem.solve(solver=solver, **SOLVERS[solver])
        except (cp.error.SolverError, ArithmeticError, ValueError) as error:
            raise NoSolution(f"{solver.lower()}: {error}") from error
        status = f"{solver.lower()}: {self.problem.status}"
        if parts["x"].value is None:
            raise NoSolution(status)
        p, y = parts["p"].value, parts["y"].value
        p = (p + p.T) / 2
        y = y if self.full else p
        try:
            k = np.linalg.solve(y.T, parts["x"].value.T).T
        except np.linalg.LinAlgError as error:
            raise NoSolution(f"{status}, singular Y") from error
        return Solution(p=p, y=y, k=k, sigma=float(parts["sigma"].value), status=status)

    def _theorem(self, extra: list[cp.Expression]) -> cp.Expression:
        """The block matrix, with `extra` performance rows coupled to the middle block."""
        n, m = self.b.shape
        p, y, x, sigma = (self.parts[name] for name in ("p", "y", "x", "sigma"))
        r2, alpha, beta = (self.parts[name] for name in ("r2", "alpha", "beta"))
        sizes = [e.shape[0] for e in extra]
        rows = [
            [r2 * p - sigma * (self.b @ self.b.T), self.a @ y + alpha * (self.b @ x), np.zeros((n, m))],
            [(self.a @ y + alpha * (self.b @ x)).T, y + y.T - p, beta * x.T],
            [np.zeros((m, n)), beta * x, sigma * np.eye(m)],
        ]
        for row, height in zip(rows, (n, n, m), strict=True):
            row += [e.T if row is rows[1] else np.zeros((height, s)) for e, s in zip(extra, sizes, strict=True)]
        for i, (e, size) in enumerate(zip(extra, sizes, strict=True)):
            tail = [np.eye(size) if i == j else np.zeros((size, s)) for j, s in enumerate(sizes)]
            rows.append([np.zeros((size, n)), e, np.zeros((size, m)), *tail])
        return cp.bmat(rows)

    def _strict(self, matrix: cp.Expression) -> cp.Constraint:
        return matrix >> STRICTNESS * _identity_beside(matrix)

    def _feasibility(self) -> tuple[cp.Expression, list[cp.Constraint]]:
        """Any solution: what the bare theorem asks for."""
        matrix = self._theorem([])
        return cp.Constant(0), [matrix >> _identity_beside(matrix)]

    def _largest_margin(self) -> tuple[cp.Expression, list[cp.Constraint]]:
        """`max t` with the block matrix `>= t I` at fixed trace: the solution deepest inside."""
        matrix, t = self._theorem([]), cp.Variable()
        identity = _identity_beside(matrix)
        return -t, [matrix >> t * identity, cp.trace(matrix) == np.trace(identity)]

    def _smallest_gain(self) -> tuple[cp.Expression, list[cp.Constraint]]:
        """`min g` with `X^T X <= g (Y + Y^T - P) <= g Y^T P^{-1} Y` and `P >= I`: `||K||^2 <= g`."""
        n, m = self.b.shape
        p, y, x = (self.parts[name] for name in ("p", "y", "x"))
        g = cp.Variable(nonneg=True)
        bound = cp.bmat([[y + y.T - p, x.T], [x, g * np.eye(m)]])
        return g, [self._strict(self._theorem([])), p >> np.eye(n), bound >> 0]

    def _guaranteed_cost(self) -> tuple[cp.Expression, list[cp.Constraint]]:
        """`min trace(Z)`, `Z >= P^{-1}`, with rows `Q^(1/2) Y` and `R^(1/2) X`: the cost of the Riccati route."""
        n, _ = self.b.shape
        p, y, x = (self.parts[name] for name in ("p", "y", "x"))
        root = np.real(scipy.linalg.sqrtm(self.state_weight))
        z = cp.Variable((n, n), symmetric=True)
        matrix = self._theorem([root @ y, np.sqrt(self.input_weight) * x])
        return cp.trace(z), [matrix >> 0, cp.bmat([[z, np.eye(n)], [np.eye(n), p]]) >> 0]


def _identity_beside(matrix: cp.Expression) -> Float[np.ndarray, "s s"]:
    size, _ = matrix.shape
    return np.eye(size)


def compiled(problem: Problem, objective: str, full: bool) -> CompiledLmi:
    """The compiled inequality for this pair, from a small cache."""
    shape, weights = problem.b.shape, problem.state_weight if objective == "guaranteed_cost" else np.eye(len(problem.a))
    key = (problem.a.tobytes(), problem.b.tobytes(), weights.tobytes())
    return _compiled(shape, key, objective, full, problem.input_weight)


@lru_cache(maxsize=4)
def _compiled(
    shape: tuple[int, int], key: tuple[bytes, bytes, bytes], objective: str, full: bool, input_weight: float
) -> CompiledLmi:
    n, m = shape
    a, b, weight = (np.frombuffer(part).reshape(n, -1) for part in key)
    return CompiledLmi(
        a=a, b=b.reshape(n, m), objective=objective, full=full, state_weight=weight, input_weight=input_weight
    )


@dataclass(frozen=True, kw_only=True)
class LmiSynthesis(Synthesis):
    """The paper's route. `objective` is one of `OBJECTIVES`, `solver` CLARABEL or SCS.

    With `largest_rate` the asked rates are floors: each side gets the largest rate at which the solver's matrices are
    certified exactly, by bisection up to the frontier.
    """

    objective: str = "guaranteed_cost"
    full: bool = False
    solver: str = "CLARABEL"

    method: ClassVar[str] = "lmi"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, choices in (("objective", OBJECTIVES), ("solver", tuple(SOLVERS))):
            value = getattr(self, name)
            require(value in choices, f"synthesis.{name}", value, "unknown", f"use one of {', '.join(choices)}")

    def state_feedback(self, linear: StateSpace, ball: JacobianBall) -> StateFeedback | Infeasible:
        if self.objective != "largest_rate":
            return super().state_feedback(linear, ball)
        return _largest(lambda rate: self._at(rate_controller=rate).state_feedback(linear, ball), self.rate_controller)

    def observer(self, linear: StateSpace, ball: JacobianBall) -> Observer | Infeasible:
        if self.objective != "largest_rate":
            return super().observer(linear, ball)
        return _largest(lambda rate: self._at(rate_observer=rate).observer(linear, ball), self.rate_observer)

    def _at(self, **rate: float) -> "LmiSynthesis":
        return replace(self, objective="largest_margin", **rate)  # type: ignore[arg-type]  # the two rate fields only

    def solve(self, problem: Problem) -> Solution:
        return compiled(problem, self.objective, self.full).solve(problem, self.solver)


def _largest(certify: Callable[[float], Part], floor: float) -> Part:
    """The last certified part of a bisection on the rate; what the floor gives, if that is not certified."""
    best = certify(floor)
    low, high = floor, best.rate_limit
    for _ in range(LARGEST_RATE_STEPS if best.certified else 0):
        middle = (low + high) / 2
        found = certify(middle)
        best, low, high = (found, middle, high) if found.certified else (best, low, middle)
    return best
