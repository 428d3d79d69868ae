"""Proof that a closed loop with input limits contracts from all initial states, for a gain designed
without limits.

Problem. `u = sat(K x)`, each input cut at its limits: what is certified from any start?

Hypotheses. Those of `state_feedback`.

Statement. A limit is a map of slopes in [0, 1], so `S_u(sat(.))` has Jacobians `J D`, D diagonal
with entries in [0, 1]. They lie in the ball `alpha_s I + beta_s Delta` with

    alpha_s = beta_s = nu / 2 (one input, slopes of S_u up to nu),    alpha_s = alpha / 2, beta_s =
    |alpha| / 2 + beta,

since `J D - alpha I / 2 = alpha (D - I / 2) + beta Delta D`; the inequality of `state_feedback`
with it, `[(1 - rate) P - sigma B B^T, A Y + alpha_s B X, 0; ...] > 0`, proves the rate, at most the
model's own: with slope zero the input does nothing. The observer is told the applied input: its
rate holds, and its error enters, as without limits.

When not to use it. Where no limit acts (`unlimited_start`), or with integrators, which a limit
holds.

Reference. [Z26] Theorem 1, eq. (11), with another ball; docs/theory.md, "The gains that are
deployed".

Example. `x+ = 0.5 x + sat(-0.4 x)`: between 0.5 and 0.1 of a distance is left, at a limit 0.5.

>>> import numpy as np
>>> from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
>>> one = np.ones((1, 1))
>>> told = dict(rate_limit=1.0, method="", started=0.0, status="")
>>> numbers = dict(a=0.5 * one, b=one, k=-0.4 * one, p=one, y=one)
>>> numbers |= dict(sigma=0.5, alpha=1.0, beta=0.0, rate=0.1)
>>> found = certify_under_limits(StateFeedbackOfBall.from_numbers(numbers, **told))
>>> print(f"{found.rate:.2f} < 1 - {0.5}^2, certified: {found.certified}")
0.75 < 1 - 0.5^2, certified: True
"""

import math
from dataclasses import dataclass, replace

from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.deployed_rate import certificate_at_largest_rate
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.systems import JacobianBall

LEAST = 1e-6  # below it nothing is said to contract


@dataclass(frozen=True, kw_only=True)
class LimitedFeedback(StateFeedbackOfBall):
    """Certificate that a closed loop contracts when its input saturates at the limits. It has the
    fields of `state_feedback`, for a wider ball."""

    @classmethod
    def required_ball(cls, context: VerificationContext) -> JacobianBall:
        """Ball of Jacobians of the input's saturation followed by the model's static input map."""
        return ball_of_saturated_map(context.balls.input, context.controlled.b.shape[1])


def ball_of_saturated_map(ball: JacobianBall, input_count: int) -> JacobianBall:
    """Ball of Jacobians of a saturation followed by a static input map. It contains zero and the
    ball of `S_u`; its radius is rounded up."""
    size = abs(ball.alpha)
    if input_count == 1:
        half = math.nextafter((size + ball.beta) / 2, math.inf)
        centre = math.copysign(half, ball.alpha)
        return JacobianBall(alpha=centre, beta=half)
    radius = math.nextafter(size / 2 + ball.beta, math.inf)
    return JacobianBall(alpha=ball.alpha / 2, beta=radius)


def certify_under_limits(unlimited_certificate: StateFeedbackOfBall) -> LimitedFeedback | None:
    """Certificate that a closed loop whose input is cut at limits contracts from every initial
    state; None where no rate is proved. The rate is near the largest one with limits."""
    ball = JacobianBall(alpha=unlimited_certificate.alpha, beta=unlimited_certificate.beta)
    inputs = unlimited_certificate.b.shape[1]
    limited_ball = ball_of_saturated_map(ball, inputs)
    limit = contraction_frontier(unlimited_certificate.a, unlimited_certificate.b, limited_ball)
    rates = {"rate": LEAST, "rate_limit": limit.rate_limit}
    slow_certificate = LimitedFeedback(**(vars(unlimited_certificate) | vars(limited_ball) | rates))
    certificate = certificate_at_largest_rate(slow_certificate)
    if certificate is None:
        return None
    assert isinstance(certificate, LimitedFeedback)
    return replace(certificate, method="limited input")
