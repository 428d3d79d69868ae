"""State feedback that inverts the static input map: `u = S_u^{-1}(K xh)`, certified without a ball
of Jacobians.

Problem. As in `state_feedback`, for a law that commands `v = S_u(u)` and not u.

Hypotheses. The Jacobians of `S_u` lie in a ball that does not hold zero, `|alpha_u| > beta_u`:
`S_u` is then one to one, and `u = S_u^{-1}(v)` exists for every v. No limit of u acts.

Statement. `S_u(S_u^{-1}(K x)) = K x`, so the inequality of `state_feedback` with `alpha = 1, beta =
0`, `[(1 - rate) P - sigma B B^T, A Y + B X, 0; ...] > 0`, proves that `u = S_u^{-1}(K x)` contracts
at the rate.

When not to use it. Through a dead zone, for the sake of speed: it asks for several times the input
and buys little.

Reference. [Z26] Theorem 1, eq. (11), at another ball; docs/theory.md, "With neurons".

Example. Slopes in [0.2, 1] of `x+ = 1.2 x + S_u(u)`, `K = -0.9`: 0.3 of a distance is left,
whatever the slopes.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=1.2 * one, b=one, k=-0.9 * one, p=one, y=one, sigma=1e-3, rate=1 - 0.31**2)
>>> balls = ((1.0, 0.0), (0.6, 0.4))
>>> print(*(InvertedInput.holds(**numbers, alpha=alpha, beta=beta) for alpha, beta in balls))
True False
"""

from dataclasses import dataclass

from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall


@dataclass(frozen=True, kw_only=True)
class InvertedInput(StateFeedbackOfBall):
    """Certificate of a state feedback whose control law inverts the static input map. The verifier
    demands `alpha = 1, beta = 0`."""
