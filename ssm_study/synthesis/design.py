"""From a model and its Jacobian balls to a controller and an observer, each with an exact verdict.

The theorems are 1 and 2 of [Z26]; how one problem serves both: docs/theory.md.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback
from ssm_study.synthesis.frontier import Frontier, controller_frontier, observer_frontier
from ssm_study.synthesis.problem import Problem, Solution
from ssm_study.synthesis.verdict import CONTROLLER, OBSERVER, Request
from ssm_study.systems import JacobianBall, StateSpace

# A near miss is solved again for a faster rate: this share of the way (in log r) from the asked rate to the frontier.
REPAIRS = (0.03, 0.3, 0.8)
# A frontier at r = 0 (linear output) would make the repair infinitely fast; this is fast enough.
REPAIR_FLOOR = 0.5


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
    state_weight: float = 1e-4
    input_weight: float = 0.01
    input_noise: float = 1.0
    state_noise: float = 1e-4
    output_noise: float = 1.0

    method: ClassVar[str]

    def __post_init__(self) -> None:
        for name in ("rate_controller", "rate_observer"):
            rate = getattr(self, name)
            require(bool(0 < rate < 1), f"synthesis.{name}", rate, "a contraction rate lies in (0, 1)", "try 0.1")
        for name in ("state_weight", "input_weight", "state_noise", "output_noise"):
            weight = getattr(self, name)
            require(bool(0 < weight < np.inf), f"synthesis.{name}", weight, "must be positive and finite", "try 1")
        for name in ("output_weight", "input_noise"):
            weight = getattr(self, name)
            require(bool(0 <= weight < np.inf), f"synthesis.{name}", weight, "must not be negative", "try 1")

    @abstractmethod
    def solve(self, problem: Problem) -> Solution:
        """Matrices of Theorem 1 for the problem. Raises `NoSolution` when the method ends without any."""

    def design(
        self,
        model: HasLinear,
        input_ball: JacobianBall,
        output_ball: JacobianBall,
        validation: tuple[Trajectory, ...] = (),  # noqa: ARG002  for specifications that choose by a record
        start_up_samples: int = 0,  # noqa: ARG002
    ) -> Design:
        """Both parts, independently: `input_ball` holds the Jacobians of S_u, `output_ball` those of S_y."""
        return Design(
            state_feedback=self.state_feedback(model.linear, input_ball),
            observer=self.observer(model.linear, output_ball),
        )

    def state_feedback(self, linear: StateSpace, ball: JacobianBall) -> StateFeedback | Infeasible:
        """Theorem 1 for `x+ = A x + B S_u(u)`."""
        request = self._request(CONTROLLER, self.rate_controller, ball, controller_frontier(linear, ball))
        return request.refused() or self._searched(request, self.controller_problem(linear, ball))  # type: ignore[return-value]

    def observer(self, linear: StateSpace, ball: JacobianBall) -> Observer | Infeasible:
        """Theorem 2 for `y = S_y(C x + D S_u(u))`: Theorem 1 for `(A^T, C^T)`, transposed and verified as itself."""
        request = self._request(OBSERVER, self.rate_observer, ball, observer_frontier(linear, ball))
        return request.refused() or self._searched(request, self.observer_problem(linear, ball))  # type: ignore[return-value]

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

    def _request(self, side: str, rate: float, ball: JacobianBall, frontier: Frontier) -> Request:
        started = time.perf_counter()
        return Request(side=side, rate=rate, ball=ball, frontier=frontier, method=self.method, started=started)

    def _searched(self, request: Request, problem: Problem) -> StateFeedback | Observer | Infeasible:
        return request.first_certified(problem, self.attempts(problem, request.frontier))

    def attempts(self, problem: Problem, frontier: Frontier) -> list[Callable[[], Solution]]:
        """The method at the asked rate, then at faster ones, whose solutions hold at the asked rate with room."""
        r, floor = problem.contraction, max(frontier.contraction_limit, REPAIR_FLOOR * problem.contraction)
        rates = [problem.rate, *(1 - (r * (floor / r) ** share) ** 2 for share in REPAIRS)]
        return [partial(self.solve, replace(problem, rate=rate)) for rate in rates]
