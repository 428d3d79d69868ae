"""Observer with linear output injection whose estimation error contracts despite a monotone
nonlinear output map.

Problem. `x+ = A x + B S_u(u)`, `y = S_y(C x + D S_u(u))` with `A (n, n)`, `C (p, n)`: find `L` such
that `xh+ = A xh + B S_u(u) + L (yh - y)`, `yh = S_y(C xh + D S_u(u))`, comes nearer to `x` by `r =
sqrt(1 - rate)` a sample.

Hypotheses. Every Jacobian of `S_y` lies in the ball `alpha I + beta Delta`, `||Delta||_2 <= 1`,
with `|alpha| > beta`; for a linear `S_y` `beta = 0`, and observability is the only limit. `S_u` may
be anything: it cancels.

Statement. If `Q = Q^T, U, V, eta` satisfy

    [ (1 - rate) Q - eta C^T C   (U A + alpha V C)^T   0       ]
    [ *                          U + U^T - Q           beta V  ]  > 0
    [ *                          *                     eta I   ]

then `L = U^{-1} V` does so in the metric `M = Q`. Exact arithmetic takes `V = U L` from the stored
`U` and `L`.

When not to use it. Where the sensor's noise matters more than the rate: the gain of a fast observer
passes it on.

Reference. [Z26] Theorem 2, eq. (19); docs/theory.md. It is Theorem 1 for `(A^T, C^T)`. `U = Q`
loses nothing.

Example. `x+ = x`, `y = S_y(x)` with slopes in [0.8, 1.2] and `L = -0.7`: as in `state_feedback`,
transposed.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=one, c=one, alpha=1.0, beta=0.2, q=one, u=one, eta=0.07, l=-0.7 * one)
>>> print(*(ObserverOfBall.holds(**numbers, rate=1 - r**2) for r in (0.5, 0.4)))
True False
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Observer, ProblemCertificate
from ssm_study.certificates.theorem import Blocks


@dataclass(frozen=True, kw_only=True)
class ObserverOfBall(ProblemCertificate, Observer):
    """Certificate of an observer for a model whose static output map has all Jacobians in a known
    ball."""

    u: Float[np.ndarray, "n n"]
    v: Float[np.ndarray, "n p"]
    eta: float

    products: ClassVar[Mapping[str, tuple[str, str]]] = {"v": ("u", "l")}

    @staticmethod
    def inequality(proof: Any) -> Blocks:
        """Blocks of the matrix inequality that proves an observer's error contracts ([Z26], Theorem
        2), for a certificate's matrices."""
        contracted_metric = (1 - proof.rate) * proof.q
        error_block = contracted_metric - proof.eta * (proof.c.T @ proof.c)
        error_step = proof.u @ proof.a + proof.alpha * (proof.v @ proof.c)
        next_metric = proof.u + proof.u.T - proof.q
        slope_step_block = proof.beta * proof.v
        slope_block = proof.eta * np.eye(proof.c.shape[0])
        return [[error_block, error_step.T, 0], [next_metric, slope_step_block], [slope_block]]
