"""Design of controller and observer from a model and its Jacobian balls, each with an exact
verdict.

The theorems are 1 and 2 of [Z26]; how one problem serves both: docs/theory.md.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ssm_study.certificates.certificate import (
    SIDES,
    Design,
    Infeasible,
    Observer,
    Side,
    StateFeedback,
    digest,
)
from ssm_study.certificates.frontier import Frontier, controller_frontier
from ssm_study.certificates.problem import (
    Neurons,
    NoSolution,
    Problem,
    Solution,
    dual,
    linear_algebra_failures_as_no_solution,
)
from ssm_study.certificates.theorem import Theorem, VerificationContext, theorem_named
from ssm_study.certificates.theorems.integral_action import frequencies, with_modes
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.refusal import BadRequest, require, require_at_least, require_positive
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import Trajectories
from ssm_study.synthesis.input_inversion import design_with_inverted_input
from ssm_study.systems import Balls, JacobianBall, StructuredSystem, System

ILL = 1e6  # a metric of a smaller condition number gains nothing from fewer states
MOST_CONDITION = (
    1 / np.finfo(float).eps
)  # of a metric scaled to unit diagonal: beyond it, rounding alone decides
FRONTIER_ROUNDING = (
    1e-8  # the frontier is recomputed from eigenvalues, which differ by rounding on another machine
)


@dataclass(frozen=True, kw_only=True)
class DesignAttempt:
    """Attempt to design controller or observer, with the request, its theoretical limit, the
    method, and the time it began."""

    theorem: type[Side]
    rate: float
    ball: JacobianBall
    frontier: Frontier
    method: str
    started: float

    def refused(self) -> Infeasible | None:
        """Refusal of a request beyond the theoretical limit, with the number that decides. None if
        the request lies within it."""
        ball = self.ball
        limit = self.frontier.rate_limit
        if abs(ball.alpha) <= ball.beta:
            reason = (
                f"the slopes [{ball.lower:.4g}, {ball.upper:.4g}] include zero, so no input "
                "is sure to have an effect; "
                "raise the slope floor (model.slope_lower) or use a scaffolding with slopes "
                "bounded by construction"
            )
            return self.infeasible(reason, "not asked", proved=True)
        if self.rate >= limit:
            by = self.frontier.decided_by
            floor = ", raise the slope floor (model.slope_lower)" * (by == "the slopes")
            reason = (
                f"rate {self.rate:.6g} is infeasible: {by} allow{'s' * (by != 'the slopes')} "
                "only rates below "
            )
            reason += (
                f"{limit:.6g}; request a smaller rate{floor} or drop states (reduction.truncate_to)"
            )
            return self.infeasible(reason, "not asked", proved=True)
        return None

    def infeasible(self, reason: str, status: str, proved: bool = False) -> Infeasible:
        """Result of an attempt without a certificate. `reason` says why."""
        asked: Any = {
            "theorem": self.theorem.name(),
            "rate": self.rate,
            "rate_limit": self.frontier.rate_limit,
        }
        asked |= {"alpha": self.ball.alpha, "beta": self.ball.beta, "method": self.method}
        seconds = time.perf_counter() - self.started
        return Infeasible(
            **asked, proved=proved, reason=reason, solver_status=status, seconds=seconds
        )

    def verified(self, problem: Problem, solution: Solution) -> Any:
        """Certificate of controller or observer from a solution. `problem` is in Theorem 1's form,
        transposed for an observer."""
        numbers = self.theorem.numbers_of(problem, solution)
        told: dict[str, Any] = {"method": self.method, "started": self.started}
        return self.theorem.proved(
            numbers, rate_limit=self.frontier.rate_limit, status=solution.status, **told
        )

    def first_certified(self, problem: Problem, attempts: Iterable[Callable[[], Solution]]) -> Any:
        """First attempt that is certified; otherwise the result of the last one with matrices, or
        the reason why no attempt gave any.

        Matrices that floats could have held are handed on as found, not certified; hopeless ones
        are refused.
        """
        best: Side | None = None
        status = "no attempt"
        for attempt in attempts:
            try:
                with linear_algebra_failures_as_no_solution():
                    best = self.verified(problem, attempt())
            except NoSolution as error:
                status = str(error)
                continue
            if best.certified:
                return best
        inside = f"the rate is inside the frontier {self.frontier.rate_limit:.6g}, yet"
        if best is None:  # information, not a verdict
            reason = (
                f"{inside} {self.method} found no certificate ({status}); try synthesis=riccati "
                "or a lower rate"
            )
            return self.infeasible(reason, status)
        fewer = "drop states (reduction.truncate_to) or " * (best.condition > ILL)
        number = f"{best.condition:.1e}; {fewer}request a smaller rate"
        if best.condition > MOST_CONDITION:
            reason = (
                f"{inside} its metric needs more digits than floats have: its condition number "
                f"is {number}"
            )
            return self.infeasible(reason, best.solver_status)
        told = f"not positive definite in exact arithmetic, condition number {number}"
        return replace(best, solver_status=f"{best.solver_status}; {told}")


def failed_checks(
    content: dict[str, Any], linear: Any, balls: Balls, controlled: Any = None
) -> list[str]:
    """Sentences on the claims of a `certificate.json` that do not hold. Empty when all hold.

    `linear` is the recurrence, `balls` those of `model.json`, `controlled` what the state feedback
    acts on where that is not the model itself (integral action). Claims are each part's digest, the
    model's fields and ball, products, rate limits, and `certified`, or that an infeasible rate is
    excluded.
    """
    try:
        design = Design.from_json(content)
    except BadRequest as malformed:
        return [str(malformed)]
    if (
        design.inverts and balls.input.relative_radius < 1
    ):  # S_u has an inverse, and the law applies it
        balls = replace(balls, input=JacobianBall(alpha=1.0, beta=0.0))
    context = VerificationContext(
        system=linear, controlled=controlled or linear, balls=balls, gains=design.gains
    )
    broken = [
        f"{part}.digest: the stored numbers are not those that were written"
        for part, fields in content.items()
        if part in design.content and fields.get("digest") != digest(fields)
    ]
    for label, part in design.content.items():
        broken += [f"{label}{claim}" for claim in _of_part(part, context)]
    for (
        label,
        again,
    ) in (
        design.extra_certificates.items()
    ):  # what is proved beside a side is of the gains that are deployed
        own = again.gains.items() if isinstance(again, Side) else ()
        if not all(np.array_equal(gain, design.gains.get(letter, np.nan)) for letter, gain in own):
            broken.append(f"{label}: the gain is not the one that is deployed")
    for side in SIDES:
        stated = content[side].get("certified_rate")
        derived = design.certified_rate(side)
        if stated != derived:
            broken.append(f"{side}.certified_rate = {stated!r}: what is proved is {derived!r}")
    return broken


def _of_part(part: Theorem | Infeasible, context: VerificationContext) -> list[str]:
    """Sentences on the claims of one part that do not hold."""
    theorem = theorem_named(part.theorem) if isinstance(part, Infeasible) else type(part)
    ball = theorem.ball(context)
    limit = theorem.rate_limit_of(context)
    broken = []
    stated = getattr(part, "rate_limit", np.nan)
    if limit is not None and not abs(stated - limit) <= FRONTIER_ROUNDING:
        broken.append(f".rate_limit = {stated!r}: the frontier is {limit!r}")
    if isinstance(part, Infeasible):
        excluded = abs(ball.alpha) <= ball.beta or (
            limit is not None and part.rate >= limit - FRONTIER_ROUNDING
        )
        if part.proved and not excluded:
            broken.append(f".proved: the rate {part.rate:g} is inside the frontier {limit:g}")
        return broken
    if Fraction(ball.beta) + abs(Fraction(ball.alpha) - Fraction(part.alpha)) > Fraction(part.beta):
        stated = f"{part.alpha!r}, {part.beta!r}"
        filled = f"{ball.alpha!r}, {ball.beta!r}"
        broken.append(
            f".alpha, beta = {stated}: the model's Jacobians fill the ball {filled}, which "
            "is not inside"
        )
    return broken + part.failed_checks(context)


REPAIRS = (
    0.03,
    0.3,
    0.8,
)  # a near miss is solved again at these shares of the way (in log r) to the frontier
REPAIR_FLOOR = (
    0.5  # or to this share of r where the frontier is nearer to zero (r = 0 for a linear output)
)
FASTEST = 1 - 1e-13  # of the rates: faster ones, as repairs try, must still be told from 1


def contraction_rate(field: str, rate: Any, remedy: str) -> None:
    """Raise `BadRequest` for a value that is no contraction rate, or so near 1 that a faster one
    rounds to 1."""
    fits = isinstance(rate, int | float) and 0 < rate <= FASTEST
    require(fits, field, rate, "a contraction rate lies in (0, 1), at least 1e-13 below 1", remedy)


@dataclass(frozen=True, kw_only=True)
class Synthesis(ABC):
    """Design of controller and observer at the requested contraction rates (distances shrink by
    `sqrt(1 - rate)` per sample).

    The weights of the controller's guaranteed cost and the variances the observer is tuned for, in
    scaled units: conf/synthesis/riccati.yaml. With `invert_input` the law is `u = S_u^{-1}(K xh)`
    (`synthesis.input_inversion`). With an `internal_model` (`step`, `ramp`, `sine(0.5Hz)`) the
    controller is that of the model with these modes z (`theorems.integral_action`) and
    `integral_weight |z|^2` in its cost: larger removes errors sooner.
    """

    rate_controller: float
    rate_observer: float
    output_weight: float = 1.0
    state_weight: float = 1e-4
    input_weight: float = 0.01
    input_noise: float = 1.0
    state_noise: float = 1e-4
    output_noise: float = 1.0
    invert_input: bool = False
    internal_model: Sequence[str] = ()
    integral_weight: float = 1e-3

    method: ClassVar[str]
    feedback_theorem: ClassVar[type[StateFeedback]] = StateFeedbackOfBall
    observer_theorem: ClassVar[type[Observer]] = ObserverOfBall

    def __post_init__(self) -> None:
        for name in ("rate_controller", "rate_observer"):
            contraction_rate(f"synthesis.{name}", getattr(self, name), "try 0.1")
        for name in (
            "state_weight",
            "input_weight",
            "state_noise",
            "output_noise",
            "integral_weight",
        ):
            require_positive(f"synthesis.{name}", getattr(self, name), "try 1")
        for name in ("output_weight", "input_noise"):
            require_at_least(0, f"synthesis.{name}", getattr(self, name), "try 1")
        frequencies(self.internal_model)

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the internal model's modes."""
        return tuple(self.internal_model)

    @abstractmethod
    def solve(self, problem: Problem) -> Solution:
        """Matrices of Theorem 1 for the problem. Raises `NoSolution` when the method finds none."""

    def design(
        self, model: Any, balls: Balls, validation: Trajectories = (), shown: Mismatch | None = None
    ) -> Design:
        """Design controller and observer independently, for the model's `system` if it has one,
        else for its linear recurrence."""
        if self.invert_input:
            return design_with_inverted_input(
                replace(self, invert_input=False), model, validation, shown
            )
        system = getattr(model, "system", model.linear)
        controlled = with_modes(model, self.modes, self.integral_weight) if self.modes else system
        feedback = self.state_feedback(controlled, balls.input)
        observer = self.observer(system, balls.output)
        return Design(state_feedback=feedback, observer=observer)

    def state_feedback(self, system: System, ball: JacobianBall) -> StateFeedback | Infeasible:
        """Design of the state feedback: Theorem 1 for `x+ = A x + B S_u(u)`, or its counterpart for
        a model with neurons."""
        neurons = isinstance(system, StructuredSystem)
        return self._certified(
            StructuredStateFeedback if neurons else self.feedback_theorem, system, ball
        )

    def observer(self, system: System, ball: JacobianBall) -> Observer | Infeasible:
        """Design of the observer for `y = S_y(C x + D S_u(u))`: Theorem 2, solved as Theorem 1 for
        `(A^T, C^T)` and verified in its own form."""
        neurons = isinstance(system, StructuredSystem)
        return self._certified(
            StructuredObserver if neurons else self.observer_theorem, system, ball
        )

    def _certified(self, theorem: type[Side], system: System, ball: JacobianBall) -> Any:
        """Certified solution for controller or observer, or the reason why there is none."""
        rate = self.rate_observer if theorem.observes else self.rate_controller
        limit = controller_frontier(dual(system) if theorem.observes else system, ball)
        started = time.perf_counter()
        request = DesignAttempt(
            theorem=theorem,
            rate=rate,
            ball=ball,
            frontier=limit,
            method=self.method,
            started=started,
        )
        if refused := request.refused():
            return refused
        problem = self.problem(system, ball, theorem.observes)
        return request.first_certified(problem, self.attempts(problem, limit))

    def problem(self, system: System, ball: JacobianBall, observes: bool = False) -> Problem:
        """Problem that is solved for the controller. With `observes` it is that of the observer on
        the dual system."""
        weights = (self.output_weight, self.state_weight, self.input_weight, self.rate_controller)
        if observes:
            weights = (self.input_noise, self.state_noise, self.output_noise, self.rate_observer)
            system = dual(system)
        on_output, on_state, on_input, rate = weights
        weight = on_output * system.c.T @ system.c + on_state * np.eye(
            system.order
        )  # of |C x|^2, and of x itself
        data: Any = {"a": system.a, "b": system.b, "state_weight": weight, "input_weight": on_input}
        if isinstance(system, StructuredSystem):
            data["neurons"] = Neurons(e=system.e, f=system.f, g=system.g, observes=observes)
        return Problem(**data, ball=ball, rate=rate)

    def attempts(self, problem: Problem, frontier: Frontier) -> list[Callable[[], Solution]]:
        """Solutions at the requested rate, then at faster ones, which hold at the requested rate
        with a larger margin."""
        r = problem.contraction
        floor = max(frontier.contraction_limit, REPAIR_FLOOR * problem.contraction)
        rates = [problem.rate, *(1 - (r * (floor / r) ** share) ** 2 for share in REPAIRS)]
        return [partial(self.solve, problem.at(rate)) for rate in rates]
