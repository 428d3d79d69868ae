"""Linear state feedback that makes a model with neurons inside its recurrence contract, whatever
the neurons' slopes.

Problem. `x+ = A x + B v + E w`, `v = S_u(u)`, `w = phi(F x + G v + bias) - phi(bias)` with q
neurons: find `K` such that `u = K x` makes the distance of any two trajectories shrink by `r =
sqrt(1 - rate)` or more in each sample.

Hypotheses. Slopes of each neuron in [0, 1]; Jacobians of `S_u` in the ball `alpha I + beta Delta`,
`||Delta||_2 <= 1`.

Statement. If `P = P^T, Y, X, sigma > 0` and a diagonal `Lambda > 0` satisfy

    [ r^2 (Y + Y^T - P)   0         -(F Y + alpha G X)^T Lambda   (A Y + alpha B X)^T   X^T     ]
    [ *                   sigma I   -beta sigma G^T Lambda        beta sigma B^T        0       ]
    [ *                   *         2 Lambda                      E^T                   0       ]  >
    0
    [ *                   *         *                             P                     0       ]
    [ *                   *         *                             *                     sigma I ]

then `K = X Y^{-1}` does so in the metric `M = P^{-1}`. With rows and columns 3 multiplied by `T =
Lambda^{-1}` it is linear in `(P, Y, X, T, sigma)`: the form that is solved. For a linear `S_u`,
`beta = 0`, a large sigma drops out.

When not to use it. Without neurons: `state_feedback` has an exact frontier. Where a neuron can cut
the input off.

Reference. docs/theory.md; Revay, Wang & Manchester 2024 (multiplier); `E = 0` is [Z26] Theorem 1.
`Y = P` loses nothing.

Example. `x+ = 0.5 x + 0.4 phi(x) + S_u(u)`, slopes of `S_u` in [0.8, 1], `K = -0.7`: between `0.9 -
0.56 = 0.34` and
`0.5 - 0.7 = -0.2` for frozen slopes, so 0.5 is proved and 0.3 is not.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=0.5 * one, b=one, e=0.4 * one, f=one, g=0 * one)
>>> numbers |= dict(alpha=0.9, beta=0.1, p=one, y=one, k=-0.7 * one)
>>> numbers |= dict(sigma=4.0, lambda_=np.full(1, 0.2))
>>> print(*(StructuredStateFeedback.holds(**numbers, rate=1 - r**2) for r in (0.5, 0.3)))
True False
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import ProblemCertificate, StateFeedback
from ssm_study.certificates.theorem import Blocks, multiplier_matrix


@dataclass(frozen=True, kw_only=True)
class StructuredStateFeedback(ProblemCertificate, StateFeedback):
    """Certificate of a state feedback for a model with neurons. Shapes: `e (n, q)`, `f (q, n)`, `g
    (q, m)`, `y (n, n)`, `x (m, n)`, `lambda_ (q,)`, `sigma > 0`."""

    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    g: Float[np.ndarray, "q m"]
    y: Float[np.ndarray, "n n"]
    x: Float[np.ndarray, "m n"]
    sigma: float
    lambda_: Float[np.ndarray, "q"]

    products: ClassVar[Mapping[str, tuple[str, str]]] = {"x": ("k", "y")}

    @staticmethod
    def inequality(proof: Any) -> Blocks:
        """Blocks of the matrix inequality that a certificate of a state feedback for a model with
        neurons must satisfy."""
        weights = multiplier_matrix(proof.lambda_)
        identity = np.eye(weights.shape[0])
        return structured_feedback_inequality(proof, (weights, identity, weights))


def structured_feedback_inequality(proof: Any, neuron_row: tuple[Any, Any, Any]) -> Blocks:
    """Blocks of the matrix inequality of a state feedback for a model with neurons, with a given
    scaling of the neurons' rows. For any diagonal S, `neuron_row` is `(S, S T, S T S)`."""
    scale, scaled_t, t = neuron_row
    identity = np.eye(proof.b.shape[1])
    state_step = proof.a @ proof.y + proof.alpha * (proof.b @ proof.x)
    neuron_inputs = proof.f @ proof.y + proof.alpha * (proof.g @ proof.x)
    neurons = neuron_inputs.T @ scale
    contracted_metric = (1 - proof.rate) * (proof.y + proof.y.T - proof.p)
    slope_block = proof.sigma * identity
    slope_neuron_block = (proof.sigma * (-1.0 * proof.beta)) * (proof.g.T @ scale)
    slope_step_block = (proof.sigma * proof.beta) * proof.b.T
    neuron_step_block = scaled_t @ proof.e.T
    return [
        [contracted_metric, 0, -1.0 * neurons, state_step.T, proof.x.T],
        [slope_block, slope_neuron_block, slope_step_block, 0],
        [2.0 * t, neuron_step_block, 0],
        [proof.p, 0],
        [slope_block],
    ]
