"""From a model and its Jacobian balls to a controller and an observer, each with an exact verdict."""

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np

from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis import exact
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback
from ssm_study.synthesis.frontier import Frontier, controller_frontier, observer_frontier
from ssm_study.synthesis.problem import NoSolution, Problem, Solution, condition, margin, theorem_matrix
from ssm_study.systems import JacobianBall, StateSpace

# A near miss is solved again for a faster rate: this share of the way (in log r) from the asked rate to the frontier.
REPAIRS = (1e-3, 0.1, 0.5, 0.9)
# A frontier at r = 0 (linear output) would make the repair infinitely fast; this is fast enough.
REPAIR_FLOOR = 0.5

Part = TypeVar("Part", bound=StateFeedback | Observer | Infeasible)


@runtime_checkable
class HasLinear(Protocol):
    """All that synthesis needs of a model."""

    @property
    def linear(self) -> StateSpace: ...


@dataclass(frozen=True, kw_only=True)
class Synthesis(ABC):
    """Controller and observer at the asked contraction rates (distances shrink by `sqrt(1 - rate)` per sample).

    Weights, in scaled units: the controller minimises the guaranteed cost of
    `output_weight |C x|^2 + state_weight |x|^2 + input_weight |u|^2`; the observer is tuned as if `B` carried noise of
    variance `input_noise`, every state `state_noise`, and the output `output_noise`.
    """

    rate_controller: float
    rate_observer: float
    output_weight: float = 1.0
    state_weight: float = 1e-3
    input_weight: float = 1.0
    input_noise: float = 1.0
    state_noise: float = 1e-3
    output_noise: float = 1.0

    method: ClassVar[str]

    def __post_init__(self) -> None:
        for name in ("rate_controller", "rate_observer"):
            rate = getattr(self, name)
            require(0 < rate < 1, f"synthesis.{name}", rate, "a contraction rate lies in (0, 1)", "try 0.1")
        for name in ("state_weight", "input_weight", "state_noise", "output_noise"):
            weight = getattr(self, name)
            require(0 < weight < np.inf, f"synthesis.{name}", weight, "must be positive and finite", "try 1")
        for name in ("output_weight", "input_noise"):
            weight = getattr(self, name)
            require(0 <= weight < np.inf, f"synthesis.{name}", weight, "must not be negative", "try 1")

    @abstractmethod
    def solve(self, problem: Problem) -> Solution:
        """Matrices of Theorem 1 for the problem. Raises `NoSolution` when the method ends without any."""

    def design(
        self,
        model: HasLinear,
        input_ball: JacobianBall,
        output_ball: JacobianBall,
        validation: tuple[Trajectory, ...] = (),  # noqa: ARG002  for specifications that choose by a record
    ) -> Design:
        """Both parts, independently: `input_ball` holds the Jacobians of S_u, `output_ball` those of S_y."""
        return Design(
            state_feedback=self.state_feedback(model.linear, input_ball),
            observer=self.observer(model.linear, output_ball),
        )

    def state_feedback(self, linear: StateSpace, ball: JacobianBall) -> StateFeedback | Infeasible:
        """Theorem 1 for `x+ = A x + B S_u(u)`."""
        started = time.perf_counter()
        limit = controller_frontier(linear, ball)
        refused = self._refused("state feedback", self.rate_controller, ball, limit, started)
        if refused is not None:
            return refused
        problem = self.controller_problem(linear, ball)
        best: StateFeedback | Infeasible = self._nothing("state feedback", problem, limit, "", started)
        for solution in self._attempts(problem, limit):
            if isinstance(solution, NoSolution):
                best = _better(best, self._nothing("state feedback", problem, limit, str(solution), started))
                continue
            best = _better(best, self._state_feedback(problem, solution, limit, started))
            if best.certified:
                break
        return best

    def observer(self, linear: StateSpace, ball: JacobianBall) -> Observer | Infeasible:
        """Theorem 2 for `y = S_y(C x + D S_u(u))`: Theorem 1 for `(A^T, C^T)`, transposed and verified as itself."""
        started = time.perf_counter()
        limit = observer_frontier(linear, ball)
        refused = self._refused("observer", self.rate_observer, ball, limit, started)
        if refused is not None:
            return refused
        problem = self.observer_problem(linear, ball)
        best: Observer | Infeasible = self._nothing("observer", problem, limit, "", started)
        for solution in self._attempts(problem, limit):
            if isinstance(solution, NoSolution):
                best = _better(best, self._nothing("observer", problem, limit, str(solution), started))
                continue
            best = _better(best, self._observer(problem, solution, limit, started))
            if best.certified:
                break
        return best

    def controller_problem(self, linear: StateSpace, ball: JacobianBall) -> Problem:
        weight = self.output_weight * linear.c.T @ linear.c + self.state_weight * np.eye(linear.order)
        return Problem(
            a=linear.a,
            b=linear.b,
            ball=ball,
            rate=self.rate_controller,
            state_weight=weight,
            input_weight=self.input_weight,
        )

    def observer_problem(self, linear: StateSpace, ball: JacobianBall) -> Problem:
        weight = self.input_noise * linear.b @ linear.b.T + self.state_noise * np.eye(linear.order)
        return Problem(
            a=np.ascontiguousarray(linear.a.T),
            b=np.ascontiguousarray(linear.c.T),
            ball=ball,
            rate=self.rate_observer,
            state_weight=weight,
            input_weight=self.output_noise,
        )

    def _attempts(self, problem: Problem, limit: Frontier) -> Iterator[Solution | NoSolution]:
        """The method at the asked rate, then at faster ones, whose solutions hold at the asked rate with room."""
        r = problem.contraction
        floor = max(limit.contraction_limit, REPAIR_FLOOR * r)
        for share in (0.0, *REPAIRS):
            rate = problem.rate if share == 0 else 1 - (r * (floor / r) ** share) ** 2
            try:
                yield self.solve(replace(problem, rate=rate))
            except NoSolution as nothing:
                yield nothing

    def _refused(
        self, side: str, rate: float, ball: JacobianBall, limit: Frontier, started: float
    ) -> Infeasible | None:
        """What no method can do, with the number that decides."""
        reason = None
        if abs(ball.alpha) <= ball.beta:
            reason = (
                f"the slopes [{ball.lower:.4g}, {ball.upper:.4g}] include zero, so the {side} is not certain to act; "
                "raise the slope floor (model.slope_lower) or use a scaffolding with slopes bounded by construction"
            )
        elif rate >= limit.rate_limit:
            reason = (
                f"the asked rate {rate:.6g} is not below the frontier {limit.rate_limit:.6g}, set by "
                f"{limit.decided_by}; "
                "ask for less, raise the slope floor (model.slope_lower), or drop states (reduction.truncate_to)"
            )
        if reason is None:
            return None
        return Infeasible(
            side=side,
            alpha=ball.alpha,
            beta=ball.beta,
            rate=rate,
            rate_limit=limit.rate_limit,
            proved=True,
            reason=reason,
            method=self.method,
            solver_status="not asked",
            seconds=time.perf_counter() - started,
        )

    def _nothing(self, side: str, problem: Problem, limit: Frontier, status: str, started: float) -> Infeasible:
        return Infeasible(
            side=side,
            alpha=problem.ball.alpha,
            beta=problem.ball.beta,
            rate=problem.rate,
            rate_limit=limit.rate_limit,
            proved=False,
            reason=f"the rate is inside the frontier {limit.rate_limit:.6g}, yet {self.method} found no certificate "
            f"({status}); try synthesis=riccati or a lower rate",
            method=self.method,
            solver_status=status,
            seconds=time.perf_counter() - started,
        )

    def _state_feedback(self, problem: Problem, solution: Solution, limit: Frontier, started: float) -> StateFeedback:
        a, b, ball, rate = problem.a, problem.b, problem.ball, problem.rate
        p, y, k, sigma = solution.p, solution.y, solution.k, solution.sigma
        lmi = exact.theorem_one(a, b, ball.alpha, ball.beta, rate, p, y, k, sigma)
        return StateFeedback(
            a=a,
            b=b,
            alpha=ball.alpha,
            beta=ball.beta,
            rate=rate,
            p=p,
            y=y,
            x=exact.exact_product(k, y),
            sigma=sigma,
            k=k,
            certified=exact.is_positive_definite(lmi),
            margin=margin(theorem_matrix(a, b, ball, rate, solution)),
            condition=condition(p),
            rate_limit=limit.rate_limit,
            method=self.method,
            solver_status=solution.status,
            seconds=time.perf_counter() - started,
        )

    def _observer(self, problem: Problem, solution: Solution, limit: Frontier, started: float) -> Observer:
        a, c, ball, rate = problem.a.T.copy(), problem.b.T.copy(), problem.ball, problem.rate
        q, u, l_, eta = solution.p, solution.y.T.copy(), solution.k.T.copy(), solution.sigma
        lmi = exact.theorem_two(a, c, ball.alpha, ball.beta, rate, q, u, l_, eta)
        return Observer(
            a=a,
            c=c,
            alpha=ball.alpha,
            beta=ball.beta,
            rate=rate,
            q=q,
            u=u,
            v=exact.exact_product(u, l_),
            eta=eta,
            l=l_,
            certified=exact.is_positive_definite(lmi),
            margin=margin(theorem_matrix(problem.a, problem.b, ball, rate, solution)),
            condition=condition(q),
            rate_limit=limit.rate_limit,
            method=self.method,
            solver_status=solution.status,
            seconds=time.perf_counter() - started,
        )


def _better(best: Part, new: Part) -> Part:
    """Certified before matrices before nothing; among equals the later attempt, which had more room."""
    return best if isinstance(new, Infeasible) and not isinstance(best, Infeasible) else new
