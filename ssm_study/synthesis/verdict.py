"""From what a method found to a typed certificate: stored floats, the exact verdict on them, information beside it.

Derivation: docs/theory.md, "The verdict".
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssm_study.synthesis import exact
from ssm_study.synthesis.certificate import Infeasible, Observer, StateFeedback
from ssm_study.synthesis.frontier import Frontier
from ssm_study.synthesis.problem import NoSolution, Problem, Solution, condition, margin, theorem_matrix
from ssm_study.systems import JacobianBall

CONTROLLER, OBSERVER = "state feedback", "observer"
MOST_CONDITION = 1 / np.finfo(float).eps  # of a metric scaled to unit diagonal: beyond it, rounding alone decides


@dataclass(frozen=True, kw_only=True)
class Request:
    """One part that is being designed: what was asked, what is possible, who tries, since when."""

    side: str
    rate: float
    ball: JacobianBall
    frontier: Frontier
    method: str
    started: float

    def refused(self) -> Infeasible | None:
        """What no method can do, with the number that decides; None if the request lies inside the frontier."""
        ball, limit = self.ball, self.frontier.rate_limit
        if abs(ball.alpha) <= ball.beta:
            return self.nothing(
                f"the slopes [{ball.lower:.4g}, {ball.upper:.4g}] include zero, so nothing is sure to act; "
                "raise the slope floor (model.slope_lower) or use a scaffolding with slopes bounded by construction",
                "not asked",
                proved=True,
            )
        if self.rate >= limit:
            return self.nothing(
                f"the asked rate {self.rate:.6g} is not below the frontier {limit:.6g}, set by "
                f"{self.frontier.decided_by}; ask for less, raise the slope floor (model.slope_lower), or drop states "
                "(reduction.truncate_to)",
                "not asked",
                proved=True,
            )
        return None

    def nothing(self, reason: str, status: str, proved: bool = False) -> Infeasible:
        return Infeasible(
            side=self.side,
            alpha=self.ball.alpha,
            beta=self.ball.beta,
            rate=self.rate,
            rate_limit=self.frontier.rate_limit,
            proved=proved,
            reason=reason,
            method=self.method,
            solver_status=status,
            seconds=time.perf_counter() - self.started,
        )

    def not_found(self, status: str) -> Infeasible:
        """The method came back empty-handed inside the frontier: information, not a verdict."""
        limit = self.frontier.rate_limit
        reason = f"the rate is inside the frontier {limit:.6g}, yet {self.method} found no certificate ({status})"
        return self.nothing(f"{reason}; try synthesis=riccati or a lower rate", status)

    def verified(self, problem: Problem, solution: Solution) -> StateFeedback | Observer:
        """The typed result; `problem` is in Theorem 1's form, transposed for an observer."""
        build = _observer if self.side == OBSERVER else _state_feedback
        information = {
            "rate": self.rate,
            "alpha": self.ball.alpha,
            "beta": self.ball.beta,
            "margin": margin(theorem_matrix(problem.a, problem.b, self.ball, self.rate, solution)),
            "condition": condition(solution.p),
            "rate_limit": self.frontier.rate_limit,
            "method": self.method,
            "solver_status": solution.status,
        }
        return build(problem, solution, information, self.started)

    def first_certified(
        self, problem: Problem, attempts: Iterable[Callable[[], Solution]]
    ) -> StateFeedback | Observer | Infeasible:
        """The first attempt that is certified; else what the last one with matrices comes to; else why none did."""
        best: StateFeedback | Observer | None = None
        status = "no attempt"
        for attempt in attempts:
            try:
                best = self.verified(problem, attempt())
            except NoSolution as nothing:
                status = str(nothing)
                continue
            if best.certified:
                return best
        return self.not_found(status) if best is None else self._not_certified(best)

    def _not_certified(self, best: StateFeedback | Observer) -> StateFeedback | Observer | Infeasible:
        """Matrices that floats could have held are handed on as found, not certified; hopeless ones are refused."""
        limit, remedy = (
            self.frontier.rate_limit,
            "balance the model, drop states (reduction.truncate_to) or ask for less",
        )
        if best.condition > MOST_CONDITION:
            reason = f"the rate is inside the frontier {limit:.6g}, yet its metric needs more digits than floats have"
            return self.nothing(f"{reason}: its condition number is {best.condition:.1e}; {remedy}", best.solver_status)
        told = f"not positive definite in exact arithmetic, condition number {best.condition:.1e}; {remedy}"
        return replace(best, solver_status=f"{best.solver_status}; {told}")


def _state_feedback(problem: Problem, solution: Solution, information: dict[str, Any], started: float) -> StateFeedback:
    a, b, p, y, k, sigma = problem.a, problem.b, solution.p, solution.y, solution.k, solution.sigma
    alpha, beta, rate = information["alpha"], information["beta"], information["rate"]
    certified = exact.is_positive_definite(exact.theorem_one(a, b, alpha, beta, rate, p, y, k, sigma))
    matrices: dict[str, Any] = {"a": a, "b": b, "p": p, "y": y, "x": exact.exact_product(k, y), "sigma": sigma, "k": k}
    return StateFeedback(**matrices, **information, certified=certified, seconds=time.perf_counter() - started)


def _observer(problem: Problem, solution: Solution, information: dict[str, Any], started: float) -> Observer:
    a, c, q, u, l_ = (m.T.copy() for m in (problem.a, problem.b, solution.p, solution.y, solution.k))
    alpha, beta, rate, eta = information["alpha"], information["beta"], information["rate"], solution.sigma
    certified = exact.is_positive_definite(exact.theorem_two(a, c, alpha, beta, rate, q, u, l_, eta))
    matrices: dict[str, Any] = {"a": a, "c": c, "q": q, "u": u, "v": exact.exact_product(u, l_), "eta": eta, "l": l_}
    return Observer(**matrices, **information, certified=certified, seconds=time.perf_counter() - started)
