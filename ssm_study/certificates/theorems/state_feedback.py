"""Linear state feedback that makes a linear system with a monotone nonlinear input map contract.

Problem. `x+ = A x + B S_u(u)` with `A (n, n)`, `B (n, m)`: find `K` such that `u = K x` makes the
distance of any two trajectories shrink by `r = sqrt(1 - rate)` or more in each sample.

Hypotheses. Every Jacobian of `S_u` lies in the ball `alpha I + beta Delta`, `||Delta||_2 <= 1` (for
one input: slopes in `[alpha - beta, alpha + beta]`), with `|alpha| > beta`. Bounds on singular
values alone are not enough.

Statement. If `P = P^T, Y, X, sigma` satisfy

    [ (1 - rate) P - sigma B B^T   A Y + alpha B X   0          ]
    [ *                            Y + Y^T - P       beta X^T   ]  > 0
    [ *                            *                 sigma I    ]

then `K = X Y^{-1}` does so in the metric `M = P^{-1}`. Exact arithmetic takes `X = K Y` from the
stored `K` and `Y`.

When not to use it. For a map whose slopes come near zero: the rate is then limited by the open loop
(`frontier`). For what happens on a plant that is not the model: see `measured_discs` and
`robustness.prediction`.

Reference. [Z26] Theorem 1, eq. (11), in the dual form that its proof derives; docs/theory.md. `Y =
P` loses nothing.

Example. `x+ = x + S_u(u)`, slopes in [0.8, 1.2], `K = -0.7`: distances shrink by `1 - 0.7 * 0.8 =
0.44` at the smallest
slope, so `r = 0.5` is proved and `0.4` is not.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=one, b=one, alpha=1.0, beta=0.2, p=one, y=one, sigma=0.07, k=-0.7 * one)
>>> print(*(StateFeedbackOfBall.holds(**numbers, rate=1 - r**2) for r in (0.5, 0.4)))
True False
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import ProblemCertificate, StateFeedback
from ssm_study.certificates.theorem import Blocks


@dataclass(frozen=True, kw_only=True)
class StateFeedbackOfBall(ProblemCertificate, StateFeedback):
    """Certificate of a state feedback for a model whose static input map has all Jacobians in a
    known ball."""

    y: Float[np.ndarray, "n n"]
    x: Float[np.ndarray, "m n"]
    sigma: float

    products: ClassVar[Mapping[str, tuple[str, str]]] = {"x": ("k", "y")}

    @staticmethod
    def inequality(proof: Any) -> Blocks:
        """Blocks of the matrix inequality that proves contraction under a state feedback ([Z26],
        Theorem 1), for a certificate's matrices."""
        contracted_metric = (1 - proof.rate) * proof.p
        state_block = contracted_metric - proof.sigma * (proof.b @ proof.b.T)
        state_step = proof.a @ proof.y + proof.alpha * (proof.b @ proof.x)
        next_metric = proof.y + proof.y.T - proof.p
        slope_step_block = proof.beta * proof.x.T
        slope_block = proof.sigma * np.eye(proof.b.shape[1])
        return [[state_block, state_step, 0], [next_metric, slope_step_block], [slope_block]]
