"""Design of controller and observer from a model and its balls of Jacobians, each decided in exact
arithmetic.

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
    GainTheorem,
    Infeasible,
    Observer,
    ProblemCertificate,
    StateFeedback,
    certificate_digest,
)
from ssm_study.certificates.frontier import Frontier, controller_frontier
from ssm_study.certificates.problem import (
    Neurons,
    NoSolution,
    Problem,
    Solution,
    dual_system,
    linear_algebra_failures_as_no_solution,
)
from ssm_study.certificates.theorem import Theorem, VerificationContext, find_theorem
from ssm_study.certificates.theorems.integral_action import (
    append_internal_model,
    count_modes_by_frequency,
)
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.certificates.theorems.structured_observer import StructuredObserver
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.refusal import BadRequest, require, require_at_least, require_positive
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import Trajectories
from ssm_study.systems import JacobianBall, JacobianBalls, StructuredSystem, System

ILL = 1e6  # a metric of a smaller condition number gains nothing from fewer states
MOST_CONDITION = (
    1 / np.finfo(float).eps
)  # of a metric scaled to unit diagonal: beyond it, rounding alone decides
FRONTIER_ROUNDING = (
    1e-8  # the frontier is recomputed from eigenvalues, which differ by rounding on another machine
)


@dataclass(frozen=True, kw_only=True)
class DesignAttempt:
    """Attempt to design a controller or an observer at a requested contraction rate."""

    theorem: type[GainTheorem]
    rate: float
    ball: JacobianBall
    frontier: Frontier
    method: str
    started: float

    @property
    def has_exact_rate_limit(self) -> bool:
        """Whether the largest contraction rate that a design attempt's theorem can prove is known
        exactly. It is for the paper's inequalities; the theorem of another package may reach
        further."""
        return issubclass(self.theorem, ProblemCertificate)

    def infeasible_beyond_limit(self) -> Infeasible | None:
        """Infeasible result for a requested rate above the theoretical limit; None for a smaller
        rate, or if the theorem's own limit is not known."""
        if not self.has_exact_rate_limit:
            return None
        ball = self.ball
        limit = self.frontier.rate_limit
        if abs(ball.alpha) <= ball.beta:
            reason = (
                f"the slopes [{ball.lower:.4g}, {ball.upper:.4g}] include zero, so no input "
                "is sure to have an effect; "
                "raise the slope floor (model.slope_lower) or use a scaffolding with slopes "
                "bounded by construction"
            )
            return self.infeasible_result(reason, "not asked", proved=True)
        if self.rate >= limit:
            return self.infeasible_result(self._excess_rate_text(), "not asked", proved=True)
        return None

    def _excess_rate_text(self) -> str:
        """Text on a requested rate above the theoretical limit: the largest possible rate, and the
        remedies."""
        limit = self.frontier.rate_limit
        by = self.frontier.decided_by
        slopes = by == "the slopes"
        if limit <= 0 and by == "a mode out of reach":
            modulus = self.frontier.contraction_limit
            cause = "the output does not show it"
            if not self.theorem.observes:
                cause = "the input does not reach it"
            return (
                f"rate {self.rate:.6g} is infeasible: a mode of modulus {modulus:.4g} is not "
                f"stable and {cause}, so no gain stabilises it; use another actuator or sensor"
            )
        sentence = f"rate {self.rate:.6g} is infeasible: {by} allow{'s' * (not slopes)}"
        remedies = ["raise the slope floor (model.slope_lower)"] if slopes else []
        remedies.append("drop states (reduction.truncate_to)")
        if limit <= 0:
            return f"{sentence} no positive rate; {' or '.join(remedies)}"
        other_remedies = remedies[:-1]
        remedy = ", ".join(["request a smaller rate", *other_remedies])
        return f"{sentence} only rates below {limit:.6g}; {remedy} or {remedies[-1]}"

    def infeasible_result(self, reason: str, status: str, proved: bool = False) -> Infeasible:
        """Infeasible result of a design attempt that gave no certificate, with the reason."""
        theorem = self.theorem.name()
        rate_limit = self.frontier.rate_limit
        request: Any = {"theorem": theorem, "rate": self.rate, "rate_limit": rate_limit}
        alpha = self.ball.alpha
        beta = self.ball.beta
        request |= {"alpha": alpha, "beta": beta, "method": self.method}
        seconds = time.perf_counter() - self.started
        return Infeasible(
            **request, proved=proved, reason=reason, solver_status=status, seconds=seconds
        )

    def certify_solution(self, problem: Problem, solution: Solution) -> Any:
        """Certificate made from the gain and metric that a solver returned, decided in exact
        arithmetic. `problem` has the form of Theorem 1, transposed for an observer."""
        numbers = self.theorem.certificate_numbers(problem, solution)
        information: dict[str, Any] = {"method": self.method, "started": self.started}
        rate_limit = self.frontier.rate_limit
        return self.theorem.from_numbers(
            numbers, rate_limit=rate_limit, status=solution.status, **information
        )

    def first_certified_solution(
        self, problem: Problem, attempts: Iterable[Callable[[], Solution]]
    ) -> Any:
        """First certificate confirmed in exact arithmetic among several attempts to solve a
        problem, or else the last attempt's result.

        Matrices that floats could have held are handed on as found, not certified; hopeless ones
        are refused.
        """
        best: GainTheorem | None = None
        status = "no attempt"
        for attempt in attempts:
            try:
                with linear_algebra_failures_as_no_solution():
                    best = self.certify_solution(problem, attempt())
            except NoSolution as error:
                status = str(error)
                continue
            if best.certified:
                return best
        inside = ""
        if self.has_exact_rate_limit:
            inside = f"the rate is inside the frontier {self.frontier.rate_limit:.6g}, yet "
        if best is None:  # information, not a verdict
            reason = (
                f"{inside}{self.method} found no certificate ({status}); try synthesis=riccati "
                "or a lower rate"
            )
            return self.infeasible_result(reason, status)
        fewer = "drop states (reduction.truncate_to) or " * (best.condition > ILL)
        number = f"{best.condition:.1e}; {fewer}request a smaller rate"
        if best.condition > MOST_CONDITION:
            reason = (
                f"{inside}its metric needs more digits than floats have: its condition number "
                f"is {number}"
            )
            return self.infeasible_result(reason, best.solver_status)
        told = f"not positive definite in exact arithmetic, condition number {number}"
        return replace(best, solver_status=f"{best.solver_status}; {told}")


def failed_checks(
    content: dict[str, Any], system: Any, balls: JacobianBalls, controlled: Any = None
) -> list[str]:
    """One sentence for each claim in a stored `certificate.json` that does not hold for the model.

    `system` is the recurrence, `balls` those of `model.json`, `controlled` what the state feedback
    acts on where that is not the model itself (integral action). Claims are each part's digest, the
    model's fields and ball, products, rate limits, and `certified`, or that an infeasible rate is
    excluded.
    """
    try:
        design = Design.from_json(content)
    except BadRequest as malformed:
        return [str(malformed)]
    context = VerificationContext(
        system=system, controlled=controlled or system, balls=balls, gains=design.gains
    )
    broken = [
        f"{part}.digest: the stored numbers are not those that were written"
        for part, fields in content.items()
        if part in design.certificates_by_name
        and fields.get("digest") != certificate_digest(fields)
    ]
    for label, part in design.certificates_by_name.items():
        claims = _failed_checks_of_certificate(part, context)
        broken += [f"{label}{claim}" for claim in claims]
    for (
        label,
        again,
    ) in (
        design.extra_certificates.items()
    ):  # what is proved beside a side is of the gains that are deployed
        own = again.gains.items() if isinstance(again, GainTheorem) else ()
        if not all(np.array_equal(gain, design.gains.get(letter, np.nan)) for letter, gain in own):
            broken.append(f"{label}: the gain is not the one that is deployed")
    for side in SIDES:
        stated = content[side].get("certified_rate")
        derived = design.certified_rate(side)
        if stated != derived:
            broken.append(f"{side}.certified_rate = {stated!r}: what is proved is {derived!r}")
    return broken


def _failed_checks_of_certificate(
    part: Theorem | Infeasible, context: VerificationContext
) -> list[str]:
    """One sentence for each claim of one certificate that does not hold for the model."""
    theorem = find_theorem(part.theorem) if isinstance(part, Infeasible) else type(part)
    ball = theorem.required_ball(context)
    limit = theorem.largest_provable_rate(context)
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


# A near miss is solved again at these shares of the way (in log r) to the frontier.
REPAIRS = (0.03, 0.3, 0.8)
REPAIR_FLOOR = (
    0.5  # or to this share of r where the frontier is nearer to zero (r = 0 for a linear output)
)
FASTEST = 1 - 1e-13  # of the rates: faster ones, as repairs try, must still be told from 1


def require_contraction_rate(field: str, rate: Any, remedy: str) -> None:
    """Raise `BadRequest` unless a value is a contraction rate between 0 and 1 and not too close to
    1."""
    fits = isinstance(rate, int | float) and 0 < rate <= FASTEST
    require(fits, field, rate, "a contraction rate lies in (0, 1), at least 1e-13 below 1", remedy)


@dataclass(frozen=True, kw_only=True)
class Synthesis(ABC):
    """Base class of methods that design controller and observer at requested contraction rates.

    The weights of the controller's guaranteed cost and the variances the observer is tuned for, in
    scaled units: conf/synthesis/riccati.yaml. With an `internal_model` (`step`, `ramp`,
    `sine(0.5Hz)`) the controller is that of the model with these modes z
    (`theorems.integral_action`) and `integral_weight |z|^2` in its cost: larger removes errors
    sooner.
    """

    rate_controller: float
    rate_observer: float
    output_weight: float = 1.0
    state_weight: float = 1e-4
    input_weight: float = 0.01
    input_noise: float = 1.0
    state_noise: float = 1e-4
    output_noise: float = 1.0
    internal_model: Sequence[str] = ()
    integral_weight: float = 1e-3

    method: ClassVar[str]
    feedback_theorem: ClassVar[type[StateFeedback]] = StateFeedbackOfBall
    observer_theorem: ClassVar[type[Observer]] = ObserverOfBall

    def __post_init__(self) -> None:
        for name in ("rate_controller", "rate_observer"):
            rate = getattr(self, name)
            require_contraction_rate(f"synthesis.{name}", rate, "try 0.1")
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
        count_modes_by_frequency(self.internal_model)

    @property
    def internal_model_signals(self) -> tuple[str, ...]:
        """Names of the signals that the internal model generates, such as `step` and `sine`."""
        return tuple(self.internal_model)

    @abstractmethod
    def solve(self, problem: Problem) -> Solution:
        """Solve the synthesis problem for a gain and its contraction metric. Raises `NoSolution` if
        the method finds none."""

    def design(
        self,
        model: Any,
        balls: JacobianBalls,
        validation: Trajectories = (),  # noqa: ARG002  # `auto` chooses by the records
        mismatch: Mismatch | None = None,  # noqa: ARG002
    ) -> Design:
        """Design controller and observer of a model, each independently of the other."""
        system = getattr(model, "system", model.linear)
        controlled = (
            append_internal_model(model, self.internal_model_signals, self.integral_weight)
            if self.internal_model_signals
            else system
        )
        feedback = self.state_feedback(controlled, balls.input)
        observer = self.observer(system, balls.output)
        return Design(state_feedback=feedback, observer=observer)

    def state_feedback(self, system: System, ball: JacobianBall) -> StateFeedback | Infeasible:
        """Certified state feedback for a system, or the reason why there is none."""
        neurons = isinstance(system, StructuredSystem)
        theorem = StructuredStateFeedback if neurons else self.feedback_theorem
        return self._design_gain(theorem, system, ball)

    def observer(self, system: System, ball: JacobianBall) -> Observer | Infeasible:
        """Certified observer for a system, or the reason why there is none."""
        neurons = isinstance(system, StructuredSystem)
        theorem = StructuredObserver if neurons else self.observer_theorem
        return self._design_gain(theorem, system, ball)

    def _design_gain(self, theorem: type[GainTheorem], system: System, ball: JacobianBall) -> Any:
        """Certificate of one gain by a given theorem, or the reason why there is none."""
        rate = self.rate_observer if theorem.observes else self.rate_controller
        limit = controller_frontier(dual_system(system) if theorem.observes else system, ball)
        started = time.perf_counter()
        request = DesignAttempt(
            theorem=theorem,
            rate=rate,
            ball=ball,
            frontier=limit,
            method=self.method,
            started=started,
        )
        if refused := request.infeasible_beyond_limit():
            return refused
        problem = self.problem(system, ball, theorem.observes)
        return request.first_certified_solution(problem, self.solution_attempts(problem, limit))

    def problem(self, system: System, ball: JacobianBall, is_observer: bool = False) -> Problem:
        """Data of the synthesis problem for the controller or, by the dual system, the observer."""
        weights = (self.output_weight, self.state_weight, self.input_weight, self.rate_controller)
        if is_observer:
            weights = (self.input_noise, self.state_noise, self.output_noise, self.rate_observer)
            system = dual_system(system)
        on_output, on_state, on_input, rate = weights
        weight = on_output * system.c.T @ system.c + on_state * np.eye(
            system.order
        )  # of |C x|^2, and of x itself
        data: Any = {"a": system.a, "b": system.b, "state_weight": weight, "input_weight": on_input}
        if isinstance(system, StructuredSystem):
            data["neurons"] = Neurons(e=system.e, f=system.f, g=system.g, observes=is_observer)
        return Problem(**data, ball=ball, rate=rate)

    def solution_attempts(
        self, problem: Problem, frontier: Frontier
    ) -> list[Callable[[], Solution]]:
        """Functions that solve a synthesis problem at the requested contraction rate and at larger
        rates, which leave more margin."""
        r = problem.contraction_factor
        floor = max(frontier.contraction_limit, REPAIR_FLOOR * problem.contraction_factor)
        rates = [problem.rate, *(1 - (r * (floor / r) ** share) ** 2 for share in REPAIRS)]
        return [partial(self.solve, problem.at_rate(rate)) for rate in rates]
