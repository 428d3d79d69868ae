"""The inequalities of a structured model, solved as they stand by CVXPY: the oracle of the game
Riccati route.

Linear in `(P, X, T, sigma)` for a state feedback and in `(Q, V, Lambda, N, eta)` for an observer;
`Y = P`, `U = Q`. For a ball without radius the rows of its multiplier are left out. Source:
docs/theory.md; the inequalities stand in `theorems.structured_state_feedback` and
`theorems.structured_observer`.
"""

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import LETTERS, Side
from ssm_study.certificates.problem import Neurons, NoSolution, Problem, Solution, symmetric
from ssm_study.certificates.semidefinite import solved
from ssm_study.certificates.theorem import Blocks
from ssm_study.certificates.theorems import structured_observer, structured_state_feedback
from ssm_study.synthesis.objectives import goal_and_constraints
from ssm_study.synthesis.structured_riccati import logs_of, without_ball

Rows = Float[np.ndarray, "_ _"]

INSIDE = (
    1e-3  # how far below the largest rate of given gains a certificate is stored, as a share of it
)
RATE_STEPS = 12  # halvings of the interval of rates: to 1/4096


class StructuredLmi:
    """One problem with neurons, ready to be solved at any rate.

    `objective` as in `objectives.goal_and_constraints`; a state feedback's cost stands beside the
    state, an observer's noise where the step arrives. With `fixed` the gains are that solution's,
    and only the metric and the multipliers are sought; `of.k` holds the gain, so that one program
    proves many.
    """

    def __init__(self, *, problem: Problem, objective: str, fixed: Solution | None = None) -> None:
        self.problem = problem
        self.fixed = fixed
        neurons, ball, (n, m) = problem.of_neurons.scaled(), problem.ball, problem.b.shape
        k = cp.Parameter((m, n), value=None if fixed is None else fixed.k)
        self.of = of = SimpleNamespace(
            p=(p := cp.Variable((n, n), symmetric=True)),
            x=cp.Variable((m, n)) if fixed is None else k @ p,
            k=k,
            t=cp.Variable(neurons.e.shape[1]),
            sigma=cp.Variable() if ball.beta > 0 else 0.0,
            rate=cp.Parameter(),
            alpha=ball.alpha,
            beta=ball.beta,
        )
        upper, rows = self._inequality(of, neurons)
        if ball.beta == 0:  # without those of its multiplier
            rows = [i for i in range(len(upper)) if i not in rows]
            upper = [[upper[i][j - i] for j in rows if j >= i] for i in rows]
        root = np.real(scipy.linalg.sqrtm(problem.state_weight))
        weighted = [root @ p, np.sqrt(problem.input_weight) * of.x]
        goal, constraints = goal_and_constraints(
            objective, upper, p, len(upper) - 1 if neurons.observes else 0, weighted
        )
        self.program = cp.Problem(cp.Minimize(goal), constraints)

    def _inequality(self, of: Any, neurons: Neurons) -> tuple[Blocks, list[int]]:
        """The theorem's, and the rows of the ball's multiplier."""
        (q, m), t = neurons.g.shape, cp.diag(of.t)
        data = {
            "a": self.problem.a,
            "b": self.problem.b,
            "e": neurons.e,
            "f": neurons.f,
            "g": neurons.g,
        }
        if not neurons.observes:
            named = SimpleNamespace(**vars(of), **data, y=of.p)
            return structured_state_feedback.inequality(named, (np.eye(q), t, t)), [1, 4]
        of.n = cp.Variable((q, m)) if neurons.injects else np.zeros((q, m))
        if self.fixed is not None and self.fixed.k_w is not None:
            of.n = t @ (self.fixed.k_w / self.problem.of_neurons.units).T
        turned = {LETTERS[letter]: matrix.T for letter, matrix in data.items()}
        named = SimpleNamespace(**vars(of), **turned, q=of.p, u=of.p, v=of.x.T, eta=of.sigma)
        return structured_observer.inequality(named, t, of.n), [1]

    def solve(self, rate: float, solver: str = "CLARABEL") -> Solution:
        """Raises `NoSolution` with the solver's status when it returns no matrices."""
        of = self.of
        fixed = self.fixed
        neurons = self.problem.of_neurons
        of.rate.value = rate
        status = solved(self.program, solver)
        p = symmetric(of.p.value)
        k = scipy.linalg.solve(p, of.x.value.T, assume_a="sym").T if fixed is None else of.k.value
        weights = of.t.value if neurons.observes else 1 / of.t.value
        k_w = np.zeros((len(k), len(of.t.value)))
        if fixed is None and neurons.injects:
            k_w = (of.n.value / weights[:, None]).T
        sigma = (
            float(of.sigma.value)
            if self.problem.ball.beta > 0
            else without_ball(self.problem, p, k)
        )
        found = Solution(
            p=p, y=p, k=k, k_w=k_w, sigma=sigma, multipliers=weights, status=status
        ).of_neurons(neurons)
        return found if fixed is None else replace(found, k_w=fixed.k_w)

    @classmethod
    def of_gains(cls, problem: Problem) -> "StructuredLmi":
        """The program that `proved` asks, for gains that inject nothing."""
        (n, m), one = problem.b.shape, np.eye(len(problem.a))
        none = np.zeros((m, problem.of_neurons.e.shape[1]))
        fixed = Solution(p=one, y=one, k=np.zeros((m, n)), sigma=1.0, status="", k_w=none)
        return cls(problem=problem, objective="largest_margin", fixed=fixed)

    def proved(self, k: Rows) -> Solution:
        """Matrices that prove the problem's rate for this gain; raises `NoSolution` without any."""
        self.of.k.value = k
        found = self.solve(self.problem.rate)
        if not holds(self.problem, found):
            raise NoSolution(f"not certified for all slopes at rate {self.problem.rate:.6g}")
        return found


def holds(problem: Problem, found: Solution) -> bool:
    """The verdict of the theorem in exact arithmetic."""
    kinds = (
        structured_state_feedback.StructuredStateFeedback,
        structured_observer.StructuredObserver,
    )
    theorem: type[Side] = kinds[problem.of_neurons.observes]
    return theorem.holds(**theorem.numbers_of(problem, found))


def largest_rate(problem: Problem, fixed: Solution | None = None) -> float:
    """The largest rate over all gains (or `fixed` ones) as far as the solver finds it; 0 if there
    is none."""
    return fastest(problem, fixed)[0]


def fastest(problem: Problem, fixed: Solution | None = None) -> tuple[float, Solution | None]:
    """That rate, by bisection on the exact verdict, and its matrices, from which a search may
    start."""
    program = StructuredLmi(problem=problem, objective="largest_margin", fixed=fixed)
    low = 0.0
    high = 1.0
    best = None
    for _ in range(RATE_STEPS):
        rate = (low + high) / 2
        try:
            found = program.solve(rate)
            faster = holds(problem.at(rate), found)
        except NoSolution:
            faster = False
        low, high, best = (rate, high, found) if faster else (low, rate, best)
    return low, best and replace(best, logs=logs_of(problem.at(low), best))


def at_largest_rate(part: Any) -> Side | None:
    """The part's gains with matrices at the largest rate; None where that is no more than is
    certified already."""
    started, (problem, gains) = time.perf_counter(), part.as_problem()
    rate = largest_rate(problem, gains) * (1 - INSIDE)
    if rate <= part.rate:
        return None
    try:
        again = StructuredLmi(
            problem=problem.at(rate), objective="largest_margin", fixed=gains
        ).solve(rate)
    except NoSolution:
        return None
    numbers = part.numbers_of(problem.at(rate), again)
    told = {"rate_limit": part.rate_limit, "method": part.method}
    status = f"{again.status}, {INSIDE:.1%} inside the largest rate"
    proved: Side = part.proved(numbers, status=status, started=started, **told)
    return proved if proved.certified else None
