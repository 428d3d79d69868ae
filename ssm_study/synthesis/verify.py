"""Re-derive every claim of a stored certificate from the file and the model alone; name the ones that do not hold.

What is claimed and how it is decided: docs/theory.md, "The verdict".
"""

from fractions import Fraction
from typing import Any

import numpy as np

from ssm_study.refusal import BadRequest
from ssm_study.synthesis import exact
from ssm_study.synthesis.certificate import Design, Infeasible, Observer, StateFeedback, digest
from ssm_study.synthesis.frontier import Frontier, controller_frontier, observer_frontier
from ssm_study.systems import JacobianBall, StateSpace

# The frontier is recomputed in floats, from eigenvalues; on another machine they differ by rounding.
FRONTIER_ROUNDING = 1e-8


def broken_claims(
    content: dict[str, Any],
    linear: StateSpace,
    balls: tuple[JacobianBall, JacobianBall],
    controlled: StateSpace | None = None,
) -> list[str]:
    """Sentences, one per claim of a `certificate.json` that does not hold; empty when all do.

    `linear` is the model's linear part and `balls` the Jacobian balls of `S_u` and `S_y`, re-derived from `model.json`;
    `controlled` is what the state feedback acts on where that is not the model itself (integral action).
    A claim is: the digest of each part; `a, b` (`a, c`) are the model's; the ball contains the model's; `x = k y`
    (`v = u l`), correctly rounded; the linear matrix inequality, in rational arithmetic, agrees with `certified`; the
    rate limit; and for a part without a certificate, that the frontier excludes it if it says so.
    """
    try:
        design = Design.from_json(content)
    except BadRequest as malformed:
        return [str(malformed)]
    broken, controlled = _digests(content), controlled or linear
    broken += _of_part("state_feedback", design.state_feedback, balls[0], controller_frontier(controlled, balls[0]))
    broken += _of_part("observer", design.observer, balls[1], observer_frontier(linear, balls[1]))
    if isinstance(design.state_feedback, StateFeedback):
        broken += _of_feedback(design.state_feedback, controlled)
    if isinstance(design.observer, Observer):
        broken += _of_observer(design.observer, linear)
    return broken


def _digests(content: dict[str, Any]) -> list[str]:
    altered = [part for part, fields in content.items() if fields.get("digest") != digest(fields)]
    return [f"{part}.digest: the stored numbers are not those that were written" for part in altered]


def _of_part(
    label: str, part: StateFeedback | Observer | Infeasible, ball: JacobianBall, frontier: Frontier
) -> list[str]:
    broken = []
    if abs(part.rate_limit - frontier.rate_limit) > FRONTIER_ROUNDING:
        broken.append(f"{label}.rate_limit = {part.rate_limit!r}: the frontier is {frontier.rate_limit!r}")
    if isinstance(part, Infeasible):
        excluded = part.rate >= frontier.rate_limit - FRONTIER_ROUNDING or abs(ball.alpha) <= ball.beta
        if part.proved and not excluded:
            broken.append(f"{label}.proved: the rate {part.rate:g} is inside the frontier {frontier.rate_limit:g}")
    elif Fraction(ball.beta) + abs(Fraction(ball.alpha) - Fraction(part.alpha)) > Fraction(part.beta):
        broken.append(
            f"{label}.alpha, beta = {part.alpha!r}, {part.beta!r}: the model's Jacobians fill the ball "
            f"{ball.alpha!r}, {ball.beta!r}, which is not inside"
        )
    return broken


def _of_feedback(part: StateFeedback, linear: StateSpace) -> list[str]:
    if part.k.shape != linear.b.T.shape or part.p.shape != linear.a.shape or part.y.shape != linear.a.shape:
        return ["state_feedback: the matrices do not fit the model"]
    lmi = exact.theorem_one(part.a, part.b, part.alpha, part.beta, part.rate, part.p, part.y, part.k, part.sigma)
    pairs = {"a": (part.a, linear.a), "b": (part.b, linear.b), "x": (part.x, exact.exact_product(part.k, part.y))}
    return _unequal("state_feedback", pairs) + _verdict("state_feedback", part, exact.is_positive_definite(lmi))


def _of_observer(part: Observer, linear: StateSpace) -> list[str]:
    if part.l.shape != linear.c.T.shape or part.q.shape != linear.a.shape or part.u.shape != linear.a.shape:
        return ["observer: the matrices do not fit the model"]
    lmi = exact.theorem_two(part.a, part.c, part.alpha, part.beta, part.rate, part.q, part.u, part.l, part.eta)
    pairs = {"a": (part.a, linear.a), "c": (part.c, linear.c), "v": (part.v, exact.exact_product(part.u, part.l))}
    return _unequal("observer", pairs) + _verdict("observer", part, exact.is_positive_definite(lmi))


def _unequal(label: str, pairs: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[str]:
    differ = [name for name, (stored, derived) in pairs.items() if not np.array_equal(stored, derived)]
    return [f"{label}.{name}: differs from what the model and the other matrices give" for name in differ]


def _verdict(label: str, part: StateFeedback | Observer, definite: bool) -> list[str]:
    holds = definite and 0 < part.rate < 1
    if holds == part.certified:
        return []
    return [f"{label}.certified = {part.certified}: in exact arithmetic the inequality {'holds' if holds else 'fails'}"]
