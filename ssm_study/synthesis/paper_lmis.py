"""The paper's two inequalities ([Z26] Theorems 1 and 2) as printed, through the paper's kind of solver:

A second opinion for every record.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ssm_study.refusal import BadRequest
from ssm_study.synthesis.frontier import Frontier
from ssm_study.synthesis.lmi import LmiSynthesis
from ssm_study.synthesis.problem import NoSolution, Problem
from ssm_study.synthesis.verdict import CONTROLLER, OBSERVER, Request
from ssm_study.systems import JacobianBall, StateSpace

NOT_ASKED = Frontier(contraction_limit=0.0, decided_by="not asked")


@dataclass(frozen=True, kw_only=True)
class Opinion:
    """What the solver said, and what exact arithmetic says of the matrices it returned.

    `margin` is the smallest eigenvalue of the inequality scaled to a unit diagonal; None without matrices.
    """

    status: str
    certified: bool
    margin: float | None
    seconds: float


def paper_lmis(
    linear: StateSpace,
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    rate_controller: float,
    rate_observer: float,
    solver: str = "CLARABEL",
) -> tuple[Opinion, Opinion]:
    """Theorems 1 and 2 with all their unknowns (P, Y, X, sigma), any solution with the block matrix `>= I`.

    One attempt each, at the asked rates, no frontier consulted, nothing repaired.
    """
    controller = theorem_one_alone(linear, input_ball, rate_controller, solver)
    method = _as_printed(rate_observer, solver)
    build = partial(method.observer_problem, linear, output_ball)
    return controller, _opinion(method, OBSERVER, build, rate_observer, output_ball)


def theorem_one_alone(linear: StateSpace, ball: JacobianBall, rate: float, solver: str = "CLARABEL") -> Opinion:
    """The controller's half of `paper_lmis`."""
    method = _as_printed(rate, solver)
    return _opinion(method, CONTROLLER, partial(method.controller_problem, linear, ball), rate, ball)


def _as_printed(rate: float, solver: str) -> LmiSynthesis:
    return LmiSynthesis(rate_controller=rate, rate_observer=rate, objective="feasibility", full=True, solver=solver)


def _opinion(method: LmiSynthesis, side: str, build: Callable[[], Problem], rate: float, ball: JacobianBall) -> Opinion:
    started = time.perf_counter()
    request = Request(side=side, rate=rate, ball=ball, frontier=NOT_ASKED, method=method.method, started=started)
    try:
        problem = build()
        part = request.verified(problem, method.solve(problem))
    except (NoSolution, BadRequest) as nothing:
        return Opinion(status=str(nothing), certified=False, margin=None, seconds=time.perf_counter() - started)
    return Opinion(status=part.solver_status, certified=part.certified, margin=part.margin, seconds=part.seconds)
