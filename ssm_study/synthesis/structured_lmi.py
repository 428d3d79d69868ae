"""The inequalities of a structured model, solved as they stand by CVXPY: the oracle of the game Riccati route.

Linear in `(P, X, T, sigma)` for a state feedback and in `(Q, V, Lambda, N, eta)` for an observer; `Y = P`, `U = Q`. For
a ball without radius the rows of its multiplier are left out. Source: THEORY section 6; the inequalities stand in
`theorems.structured_state_feedback` and `theorems.structured_observer`.
"""

import time
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import scipy

from ssm_study.synthesis.certificate import Side
from ssm_study.synthesis.lmi import aim, solved
from ssm_study.synthesis.problem import NoSolution, Problem, Solution
from ssm_study.synthesis.structured_riccati import without_ball
from ssm_study.synthesis.theorem import Blocks
from ssm_study.synthesis.theorems import structured_observer, structured_state_feedback

INSIDE = 1e-3  # how far below the largest rate of given gains a certificate is stored, as a share of it
RATE_STEPS = 12  # halvings of the interval of rates: to 1/4096


@dataclass(frozen=True, kw_only=True)
class StructuredLmi:
    """One problem with neurons, ready to be solved at any rate.

    `objective` as in `lmi.aim`; a state feedback's cost stands beside the state, an observer's noise where the step
    arrives. With `fixed` the gains are that solution's, and only the metric and the multipliers are sought.
    """

    problem: Problem
    objective: str
    fixed: Solution | None = None
    of: Any = field(init=False, repr=False)
    program: cp.Problem = field(init=False, repr=False)

    def __post_init__(self) -> None:
        assert self.problem.neurons is not None
        neurons, ball, (n, m) = self.problem.neurons.scaled(), self.problem.ball, self.problem.b.shape
        of = SimpleNamespace(
            p=(p := cp.Variable((n, n), symmetric=True)),
            x=cp.Variable((m, n)) if self.fixed is None else self.fixed.k @ p,
            t=cp.Variable(neurons.e.shape[1]),
            sigma=cp.Variable() if ball.beta > 0 else 0.0,
            rate=cp.Parameter(),
            alpha=ball.alpha,
            beta=ball.beta,
        )
        upper, rows = (self._observing if neurons.observes else self._feeding)(of, neurons)
        if ball.beta == 0:  # without those of its multiplier
            rows = [i for i in range(len(upper)) if i not in rows]
            upper = [[upper[i][j - i] for j in rows if j >= i] for i in rows]
        root = np.real(scipy.linalg.sqrtm(self.problem.state_weight))
        weighted = [root @ p, np.sqrt(self.problem.input_weight) * of.x]
        at = len(upper) - 1 if neurons.observes else 0
        goal, constraints = aim(self.objective, upper, p, at, weighted)
        object.__setattr__(self, "of", of)
        object.__setattr__(self, "program", cp.Problem(cp.Minimize(goal), constraints))

    def _feeding(self, of: Any, neurons: Any) -> tuple[Blocks, list[int]]:
        """The inequality, and the rows of the ball's multiplier; so too of an observer."""
        t = cp.diag(of.t)
        data = {"a": self.problem.a, "b": self.problem.b, "e": neurons.e, "f": neurons.f, "g": neurons.g}
        named = SimpleNamespace(**vars(of), **data, y=of.p)
        return structured_state_feedback.inequality(named, (np.eye(neurons.e.shape[1]), t, t)), [1, 4]

    def _observing(self, of: Any, neurons: Any) -> tuple[Blocks, list[int]]:
        shape, t = (neurons.e.shape[1], self.problem.b.shape[1]), cp.diag(of.t)
        of.n = cp.Variable(shape) if neurons.injects else np.zeros(shape)
        if self.fixed is not None and self.fixed.k_w is not None:
            of.n = t @ (self.fixed.k_w / self.problem.neurons.units).T  # type: ignore[union-attr]  # it has neurons
        data = {"a": self.problem.a, "c": self.problem.b, "e": neurons.f, "f": neurons.e, "h": neurons.g}
        turned = {name: matrix.T for name, matrix in data.items()}
        named = SimpleNamespace(**vars(of), **turned, q=of.p, u=of.p, v=of.x.T, eta=of.sigma)
        return structured_observer.inequality(named, t, of.n), [1]

    def solve(self, rate: float, solver: str = "CLARABEL") -> Solution:
        """Raises `NoSolution` with the solver's status when it returns no matrices."""
        of, fixed, neurons = self.of, self.fixed, self.problem.neurons
        assert neurons is not None
        of.rate.value = rate
        status = solved(self.program, solver)
        p = (of.p.value + of.p.value.T) / 2
        k = scipy.linalg.solve(p, of.x.value.T, assume_a="sym").T if fixed is None else fixed.k
        weights, k_w = of.t.value if neurons.observes else 1 / of.t.value, np.zeros((len(k), len(of.t.value)))
        if fixed is None and neurons.injects:
            k_w = (of.n.value / weights[:, None]).T
        sigma = float(of.sigma.value) if self.problem.ball.beta > 0 else without_ball(self.problem, p, k)
        found = Solution(p=p, y=p, k=k, k_w=k_w, sigma=sigma, multipliers=weights, status=status)
        found = found.of_neurons(neurons)
        return found if fixed is None else replace(found, k_w=fixed.k_w)


def holds(problem: Problem, found: Solution) -> bool:
    """The verdict of the theorem in exact arithmetic."""
    assert problem.neurons is not None
    kinds = (structured_state_feedback.StructuredStateFeedback, structured_observer.StructuredObserver)
    theorem: type[Side] = kinds[problem.neurons.observes]
    return theorem.holds(**theorem.numbers_of(problem, found))


def largest_rate(problem: Problem, fixed: Solution | None = None) -> float:
    """The largest rate at which the solver's matrices hold, by bisection on the exact verdict; 0 if there is none.

    Over all gains, the best possible rate of the model as far as the solver finds it; or, `fixed`, of these gains.
    """
    program = StructuredLmi(problem=problem, objective="largest_margin", fixed=fixed)
    low, high = 0.0, 1.0
    for _ in range(RATE_STEPS):
        rate = (low + high) / 2
        try:
            found = holds(problem.at(rate), program.solve(rate))
        except NoSolution:
            found = False
        low, high = (rate, high) if found else (low, rate)
    return low


def at_largest_rate(part: Any) -> Side | None:
    """The part's gains with matrices at the largest rate; None where that is no more than is certified already."""
    started, (problem, gains) = time.perf_counter(), part.posed()
    rate = largest_rate(problem, gains) * (1 - INSIDE)
    if rate <= part.rate:
        return None
    try:
        again = StructuredLmi(problem=problem.at(rate), objective="largest_margin", fixed=gains).solve(rate)
    except NoSolution:
        return None
    numbers, told = part.numbers_of(problem.at(rate), again), {"rate_limit": part.rate_limit, "method": part.method}
    status = f"{again.status}, {INSIDE:.1%} inside the largest rate"
    proved: Side = part.proved(numbers, status=status, started=started, **told)
    return proved if proved.certified else None
