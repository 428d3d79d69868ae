"""State feedback that inverts the static input map of a model with neurons, certified without a
ball of Jacobians.

Problem. As in `structured_state_feedback`, for the law `u = S_u^{-1}(K xh)`.

Hypotheses. Those of `inverted_input`; slopes of each neuron in [0, 1].

Statement. `v = S_u(u) = K x` exactly, so the inequality of `structured_state_feedback` with `alpha
= 1, beta = 0`, `[r^2 (Y + Y^T - P), 0, -(F Y + G X)^T Lambda, (A Y + B X)^T, X^T; ...] > 0`, proves
that the law contracts at the rate.

When not to use it. As `inverted_input`.

Reference. docs/theory.md, "With neurons"; `E = 0` is `inverted_input`: [Z26] Theorem 1 with a known
input map.

Example. That of `structured_state_feedback`, at 0.25: frozen slopes leave between 0.2 and -0.2 of a
distance.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=0.5 * one, b=one, e=0.4 * one, f=one, g=0 * one)
>>> numbers |= dict(p=one, y=one, k=-0.7 * one, rate=1 - 0.25**2)
>>> numbers |= dict(sigma=1e4, lambda_=np.full(1, 0.1))
>>> for alpha, beta in ((1.0, 0.0), (0.9, 0.1)):
...     print(StructuredInvertedInput.holds(**numbers, alpha=alpha, beta=beta))
True
False
"""

from dataclasses import dataclass

from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback


@dataclass(frozen=True, kw_only=True)
class StructuredInvertedInput(StructuredStateFeedback):
    """Certificate of a state feedback for a model with neurons whose control law inverts the static
    input map. It has the fields of `structured_state_feedback`; the verifier demands `alpha = 1,
    beta = 0`."""
