"""Theorems 1 and 2 of [Z26] (Zakwan et al.) as printed there: linear matrix inequalities that CVXPY
solves.

Compiled once per pair `(A, B)`; rate and ball are parameters, so a sweep over rates re-solves
without compiling. The solver's status is information: inside the frontier its "infeasible" is often
false (docs/theory.md), and the verdict on what it returns is exact arithmetic's.
"""

import time
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, ClassVar

import cvxpy as cp
import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import GainTheorem
from ssm_study.certificates.frontier import Frontier
from ssm_study.certificates.problem import NoSolution, Problem, Solution, symmetric_part
from ssm_study.certificates.semidefinite import SOLVERS, solve_program
from ssm_study.certificates.theorem import Blocks, symmetric_from_upper
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.refusal import BadRequest, require_one_of
from ssm_study.synthesis.design import DesignAttempt, Synthesis
from ssm_study.synthesis.objectives import Goal, goal_and_constraints
from ssm_study.systems import JacobianBall, StateSpace

OBJECTIVES = ("feasibility", "largest_margin", "smallest_gain", "guaranteed_cost")
# The inequality is strict and homogeneous in (P, Y, X, sigma): its scale is fixed by P >= I, its
# strictness by this.
STRICTNESS = 1e-6

Matrix = Float[np.ndarray, "_ _"]


class CompiledLmi:
    """Matrix inequality of a state feedback, compiled once and solved for any contraction rate and
    ball of Jacobians.

    `full` keeps the extra matrix Y; `Y = P` is lossless with a third of the unknowns. Weights
    matter for `guaranteed_cost` only, whose cost is that of the Riccati route.
    """

    def __init__(
        self,
        *,
        a: Matrix,
        b: Matrix,
        objective: str,
        full: bool,
        state_weight: Matrix,
        input_weight: float,
    ) -> None:
        n, m = b.shape
        p = cp.Variable((n, n), symmetric=True)
        x = cp.Variable((m, n))
        y = cp.Variable((n, n)) if full else p
        parts: dict[str, Any] = {"p": p, "y": y, "x": x}
        parts["sigma"] = cp.Variable(nonneg=True)
        parts["rate"] = cp.Parameter()
        parts["alpha"] = cp.Parameter()
        parts["beta"] = cp.Parameter(nonneg=True)
        self.parts = parts
        of = SimpleNamespace(a=a, b=b, **parts)
        upper = StateFeedbackOfBall.inequality(of)
        if objective == "smallest_gain":
            goal, constraints = _minimum_gain_objective(upper, p, y, x)
        else:
            complex_root = scipy.linalg.sqrtm(state_weight)
            root = np.real(complex_root)
            weighted_input = np.sqrt(input_weight) * x
            performance = [root @ y, weighted_input]
            goal, constraints = goal_and_constraints(objective, upper, p, 1, performance)
        minimize = cp.Minimize(goal)
        self.problem = cp.Problem(minimize, constraints)

    def solve(self, problem: Problem, solver: str = "CLARABEL") -> Solution:
        """Solve the compiled linear matrix inequality for gain and metric. Raises `NoSolution` with
        the solver's status if there is none."""
        parts = self.parts
        alpha = problem.ball.alpha
        beta = problem.ball.beta
        parameters = {"rate": problem.rate, "alpha": alpha, "beta": beta}
        for name, value in parameters.items():
            parts[name].value = value
        status = solve_program(self.problem, solver)
        p = symmetric_part(parts["p"].value)
        is_one_matrix = parts["y"] is parts["p"]
        y = p if is_one_matrix else parts["y"].value
        x = parts["x"].value
        try:
            transposed_gain = np.linalg.solve(y.T, x.T)
            k = transposed_gain.T
        except np.linalg.LinAlgError as error:
            raise NoSolution(f"{status}, singular Y") from error
        sigma = float(parts["sigma"].value)
        return Solution(p=p, y=y, k=k, sigma=sigma, status=status)


def _minimum_gain_objective(
    upper: Blocks, p: cp.Expression, y: cp.Expression, x: cp.Expression
) -> Goal:
    """Objective and constraints that minimise the norm of the gain subject to a linear matrix
    inequality."""
    matrix = cp.bmat(symmetric_from_upper(upper))
    g = cp.Variable(nonneg=True)
    inputs = x.shape[0]
    metric_slack = y + y.T - p
    metric_row = [metric_slack, x.T]
    scaled_identity = g * np.eye(inputs)
    gain_row = [x, scaled_identity]
    bound = cp.bmat([metric_row, gain_row])
    size = matrix.shape[0]
    margin = STRICTNESS * np.eye(size)
    is_strict = matrix >> margin
    state_count = p.shape[0]
    is_scaled = p >> np.eye(state_count)
    return g, [is_strict, is_scaled, bound >> 0]


@lru_cache(maxsize=4)
def _compiled_inequality(
    data: tuple[bytes, bytes, bytes], order: int, objective: str, is_full: bool, input_weight: float
) -> Any:
    """Linear matrix inequality compiled for CVXPY, cached for problems with the same data."""
    a, b, weight = (np.frombuffer(part).reshape(order, -1) for part in data)
    return CompiledLmi(
        a=a, b=b, objective=objective, full=is_full, state_weight=weight, input_weight=input_weight
    )


@dataclass(frozen=True, kw_only=True)
class LmiSynthesis(Synthesis):
    """Synthesis by the linear matrix inequalities of Zakwan et al. `objective` is one of
    `OBJECTIVES`, `solver` CLARABEL or SCS."""

    objective: str = "guaranteed_cost"
    full: bool = False
    solver: str = "CLARABEL"

    method: ClassVar[str] = "lmi"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(OBJECTIVES, "synthesis.objective", self.objective)
        require_one_of(SOLVERS, "synthesis.solver", self.solver)

    def solve(self, problem: Problem) -> Solution:
        if problem.neurons is None:
            order = len(problem.a)
            has_weight = self.objective == "guaranteed_cost"
            weight = problem.state_weight if has_weight else np.eye(order)
            a_bytes = problem.a.tobytes()
            b_bytes = problem.b.tobytes()
            weight_bytes = weight.tobytes()
            data = (a_bytes, b_bytes, weight_bytes)
            compiled = _compiled_inequality(
                data, order, self.objective, self.full, problem.input_weight
            )
            return compiled.solve(problem, self.solver)
        from ssm_study.synthesis.structured_lmi import StructuredLmi  # which solves by this module

        objective = "guaranteed_cost" if self.objective == "smallest_gain" else self.objective
        program = StructuredLmi(problem=problem, objective=objective)
        return program.solve(problem.rate, self.solver)


def certificate_from_paper_lmi(
    system: StateSpace,
    ball: JacobianBall,
    rate: float,
    theorem: type[GainTheorem] = StateFeedbackOfBall,
) -> Any:
    """Contraction certificate from the linear matrix inequality exactly as it is printed in the
    paper [Z26]. Any solution with the block matrix `>= I` is taken.

    There is one attempt at the requested rate, without the frontier and without repairs, as a
    second opinion for every record. Returns a certificate, certified or not, or `Infeasible` if the
    solver returns no matrices.
    """
    method = LmiSynthesis(
        rate_controller=rate, rate_observer=rate, objective="feasibility", full=True
    )
    frontier = Frontier(contraction_limit=0.0, decided_by="not asked")
    started = time.perf_counter()
    attempt = DesignAttempt(
        theorem=theorem,
        rate=rate,
        ball=ball,
        frontier=frontier,
        method=method.method,
        started=started,
    )
    try:
        problem = method.problem(system, ball, theorem.observes)
        solution = method.solve(problem)
        return attempt.certify_solution(problem, solution)
    except (NoSolution, BadRequest) as error:
        return attempt.infeasible_result("the solver returned no matrices", str(error))
