"""Largest contraction rate that one metric proves for a given gain, often above the rate requested
of the design.

Problem. A gain K is deployed with a certificate at the requested rate; find the largest rate at
which some metric certifies this very gain. For an observer the same of `(A^T, C^T, L^T)`.

Hypotheses. Those of `state_feedback` (`observer`); the gain is given.

Statement. With `A_K = A + alpha B K`, a metric for the distance factor r exists if and only if `r >
radius(A_K)` and

    || beta K (z I - A_K / r)^{-1} B / r ||_inf < 1,

which is monotone in r (bounded-real lemma). At such r the least solution of

    P = Ah_K (P^{-1} - beta^2 K^T K)^{-1} Ah_K^T + Bh Bh^T + E,      Ah_K = A_K / r,  Bh = B / r,  E
    > 0

satisfies the inequality of `state_feedback`, `[(1 - rate) P - B B^T, A P + alpha B K P, 0; ...] >
0`, with slack E. What is stored lies 0.1 % inside, and exact arithmetic decides.

When not to use it. As a promise for the plant, or as a reason to ask for no rate: the weights chose
the gain, not the rate. For Jacobians known to be diagonal several multipliers prove more; this is
then sufficient only.

Reference. [Z26] Theorem 1, eq. (11), at a given gain; docs/theory.md; Gahinet & Apkarian 1994
(bounded-real lemma).

Example. `x+ = x + S_u(u)`, slopes in [0.8, 1.2], `K = -0.7`: the slowest slope leaves 0.44 of a
distance.

>>> import numpy as np
>>> from ssm_study.systems import JacobianBall
>>> one = np.ones((1, 1))
>>> ball = JacobianBall.from_slopes(0.8, 1.2)
>>> print(f"{largest_rate(one, one, -0.7 * one, ball):.4f} = 1 - {0.44}^2")
0.8064 = 1 - 0.44^2
"""

import time
from itertools import product
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.bounds.frequency import hinf_norm
from ssm_study.certificates.certificate import GainTheorem
from ssm_study.certificates.problem import NoSolution, Solution
from ssm_study.certificates.riccati import SLACK, least_metric
from ssm_study.systems import JacobianBall, StateSpace, spectral_radius

RATE_TOLERANCE = 1e-6  # the rate is found to this share; what is stored lies further inside
# How far inside, as shares of the rate, in order of trial; where none is certified the asked rate
# stands.
LARGEST_RATE = 1 - 1e-9  # of a gain that brings every state to rest in a few samples
INSIDE = (1e-3, 3e-3, 1e-2, 3e-2, 0.1)
SLACKS = (SLACK, 1e-3 * SLACK)  # E, where the largest rate leaves more room, and less
# the equation is solved this share of the way (in log r) from the largest rate to the stored one
BETWEEN = 0.5
# stands for a norm that is infinite (r at or below the spectral radius), so that the search can
# compare
FAR = 1e6


def largest_rate(
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n m"],
    k: Float[np.ndarray, "m n"],
    ball: JacobianBall,
) -> float:
    """Largest contraction rate that a single metric proves for a system with a given state-feedback
    gain. `1 - r^2` at the smallest such r, up to the relative error `RATE_TOLERANCE`; negative
    where even r = 1 is not proved."""
    closed = a + ball.alpha * b @ k
    radius = spectral_radius(closed)
    smallest = max(radius, np.finfo(float).eps)
    if ball.beta == 0 or not k.any():
        return 1 - smallest**2

    def log_loop_norm(log_r: float) -> float:
        """Logarithm of the closed loop's H-infinity norm at an assumed contraction factor, zero at
        the smallest factor that can be proved."""
        r = float(np.exp(log_r))
        norm = np.inf
        if r > radius:
            no_feedthrough = np.zeros((len(k), b.shape[1]))
            loop = StateSpace(a=closed / r, b=b / r, c=ball.beta * k, d=no_feedthrough)
            norm = hinf_norm(loop)
        limited_norm = np.clip(norm, 1 / FAR, FAR)
        return float(np.log(limited_norm))

    low = float(np.log(smallest))
    high = float(np.log(smallest)) + 1.0  # the norm falls as r grows: bracket, then Brent
    if log_loop_norm(low) <= 0:
        # the gain does next to nothing: the metric of the linear part has all the room
        return 1 - smallest**2
    while log_loop_norm(high) >= 0:
        low = high
        high = high + 1.0
    root = scipy.optimize.brentq(log_loop_norm, low, high, xtol=RATE_TOLERANCE)
    return float(1 - np.exp(2 * root))


def certificate_at_largest_rate(certificate: Any) -> GainTheorem | None:
    """Certificate of the largest contraction rate for a gain that is certified at a smaller one;
    None if no larger rate is proved."""
    started = time.perf_counter()
    problem, solution = certificate.as_problem()
    limit = min(largest_rate(problem.a, problem.b, solution.k, problem.ball), LARGEST_RATE)
    try:
        # coordinates in which the certificate's metric is the identity
        right = np.linalg.cholesky(solution.p / solution.sigma)
    except np.linalg.LinAlgError:
        return None  # definite by a margin that floats do not see
    for inside, slack in product(INSIDE, SLACKS):
        rate = limit * (1 - inside)
        if rate <= certificate.rate or rate <= 0:
            return None
        between = (1 - limit) ** ((1 - BETWEEN) / 2) * (1 - rate) ** (BETWEEN / 2)
        contraction = float(between)
        left = np.linalg.inv(right)
        try:
            p = least_metric(problem, solution.k, contraction, right, left, slack)
        except NoSolution:
            continue
        status = f"{inside:.1%} inside the largest rate {limit:.6g}"
        slower_problem = problem.at_rate(rate)
        new_solution = Solution(p=p, y=p, k=solution.k, sigma=1.0, status=status)
        numbers = certificate.certificate_numbers(slower_problem, new_solution)
        information = {"rate_limit": certificate.rate_limit, "method": certificate.method}
        proved: GainTheorem = certificate.from_numbers(
            numbers, status=status, started=started, **information
        )
        if proved.certified:
            return proved
    return None
