"""The minimum-energy gain: a certified controller for every rate inside the frontier, without any iteration.

`K = K0 / ((1 - delta^2) alpha)` with `delta = beta/alpha` and `K0 = -(I + Bh^T S Bh)^{-1} Bh^T S Ah` the minimum-energy
gain of `(A/r, B/r)`, which mirrors the modes with `|lambda| > r` at the circle of radius r and leaves the others.
Derivation: docs/theory.md.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.frontier import fast_part, frontier, minimum_energy
from ssm_study.synthesis.problem import NoSolution, Problem, Solution
from ssm_study.systems import JacobianBall

# The gain is built for a slightly harder problem (faster, wider ball), so that the asked one holds with room: half of
# what the frontier leaves, in the logarithm.
SHARE_OF_ROOM = 0.5


def minimum_energy_gain(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], ball: JacobianBall, contraction: float
) -> Float[np.ndarray, "m n"]:
    """`K0 / ((1 - delta^2) alpha)` at `r = contraction`; zero where no mode is faster than asked."""
    part = fast_part(a, b, contraction)
    if part.order == 0:
        return np.zeros((b.shape[1], len(a)))
    ah, bh = part.a / contraction, part.b / contraction
    s = np.linalg.inv(minimum_energy(ah, bh))
    k0 = -np.linalg.solve(np.eye(b.shape[1]) + bh.T @ s @ bh, bh.T @ s @ ah)
    return k0 @ part.basis.T / ((1 - ball.relative_radius**2) * ball.alpha)


def harder(problem: Problem) -> tuple[float, float]:
    """`(r', delta')` between the asked values and the frontier: the room is shared between rate and radius."""
    limit = frontier(problem.a, problem.b, problem.ball).contraction_limit
    r = problem.contraction
    return float(r * (max(limit, 1e-3 * r) / r) ** SHARE_OF_ROOM), problem.ball.relative_radius


def minimum_energy_solution(problem: Problem) -> Solution:
    """The gain at the harder rate, and a metric for it from the bounded-real Riccati equation of the closed loop."""
    faster, _ = harder(problem)
    k = minimum_energy_gain(problem.a, problem.b, problem.ball, faster)
    return certify_gain(problem, k, status="closed form")


def certify_gain(problem: Problem, k: Float[np.ndarray, "m n"], status: str) -> Solution:
    """A metric that certifies a given gain: `S = Ah_cl^T (S^{-1} - Bh Bh^T)^{-1} Ah_cl + beta^2 K^T K + eps Q`.

    The bounded-real lemma for `beta K (zI - Ah_cl)^{-1} Bh`: solvable iff that norm is below one, which is what
    Theorem 1 asks of K. The slack `eps Q` is searched from large to small. Raises `NoSolution` if none works.
    """
    ah, bh = problem.a_hat, problem.b_hat
    closed = ah + problem.ball.alpha * bh @ k
    if np.abs(np.linalg.eigvals(closed)).max() >= 1:
        raise NoSolution("the gain does not reach the rate at the centre of the ball")
    cost = problem.ball.beta**2 * k.T @ k
    slack = scipy.linalg.solve_discrete_lyapunov(closed.T, np.eye(len(ah)))
    for eps in np.geomspace(1e-2, 1e-12, 11):
        weight = cost + eps * np.eye(len(ah)) / max(np.linalg.norm(bh.T @ slack @ bh, 2), np.finfo(float).tiny)
        try:
            s = scipy.linalg.solve_discrete_are(closed, bh, weight, -np.eye(bh.shape[1]))
        except (np.linalg.LinAlgError, ValueError):
            continue
        s = (s + s.T) / 2
        if np.linalg.eigvalsh(bh.T @ s @ bh)[-1] < 1 and np.linalg.eigvalsh(s)[0] > 0:
            inverse = np.linalg.inv(s)
            p = (inverse + inverse.T) / 2
            return Solution(p=p, y=p, k=k, sigma=1.0, status=status)
    raise NoSolution("the bounded-real Riccati equation of the closed loop has no solution in floats")


@dataclass(frozen=True, kw_only=True)
class ClosedFormSynthesis(Synthesis):
    """The minimum-energy gains: no weights, the least effort that reaches the rate."""

    method: ClassVar[str] = "closed_form"

    def solve(self, problem: Problem) -> Solution:
        return minimum_energy_solution(problem)
