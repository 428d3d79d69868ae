"""Observer of a model with neurons that injects the output error also into the neurons, and whose
error contracts.

Problem. For `x+ = A x + B v + E w`, `w = phi(F x + G v + bias) - phi(bias)`, `y = S_y(C x + D v + H
w)`: find `L` and
`L_z` such that `xh+ = A xh + B v + E wh + L (yh - y)`, `wh = phi(F xh + G v + bias + L_z (yh - y))
- phi(bias)`, comes
nearer to `x` by `r = sqrt(1 - rate)` a sample. `B, D, G` cancel.

Hypotheses. Slopes of each neuron in [0, 1]; Jacobians of `S_y` in the ball `alpha I + beta Delta`,
`||Delta||_2 <= 1`; `L_z = 0` where `H != 0`, for the injection would then depend on itself.

Statement. If `Q = Q^T, U, V, eta` and a diagonal `Lambda > 0`, with `N = Lambda L_z`, satisfy

    [ r^2 Q - eta C^T C   0       -(Lambda F + alpha N C)^T - eta C^T H   (U A + alpha V C)^T ]
    [ *                   eta I   -beta N^T                               beta V^T            ]
    [ *                   *       2 Lambda - eta H^T H                    (U E + alpha V H)^T ]  > 0
    [ *                   *       *                                       U + U^T - Q         ]

then `L = U^{-1} V` and `L_z` do so in the metric `M = Q`. Row 2 makes eta positive: with a negative
one the first corner would certify anything. For a linear `S_y`, `beta = 0`, a small eta drops out.

When not to use it. Without neurons: `observer` has an exact frontier.

Reference. docs/theory.md, "With neurons"; `E = 0` is [Z26] Theorem 2. `U = Q` loses nothing.

Example. `x+ = 0.5 x + 0.4 phi(x)`, `y = x`. With `L = -0.5` alone the error shrinks by 0.4 at slope
one; injected into the neuron as well, `L_z = -1`, nothing is left of it.

>>> import numpy as np
>>> one = np.ones((1, 1))
>>> numbers = dict(a=0.5 * one, c=one, e=0.4 * one, f=one, h=0 * one)
>>> numbers |= dict(alpha=1.0, beta=0.0, q=one, u=one, l=-0.5 * one)
>>> numbers |= dict(eta=1e-6, lambda_=np.ones(1), rate=1 - 0.1**2)
>>> print(*(StructuredObserver.holds(**numbers, l_z=l_z * one) for l_z in (-1.0, 0.0)))
True False
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.certificate import Observer, ProblemCertificate
from ssm_study.certificates.theorem import Blocks, VerificationContext, multiplier_matrix

NeuronOutput = Float[np.ndarray, "p q"]
NeuronInjection = Float[np.ndarray, "q p"]


@dataclass(frozen=True, kw_only=True)
class StructuredObserver(ProblemCertificate, Observer):
    """Certificate of an observer for a model with neurons. Shapes: `e (n, q)`, `f (q, n)`, `h (p,
    q)`, `u (n, n)`, `v (n, p)`, `l_z (q, p)`, `lambda_ (q,)`."""

    e: Float[np.ndarray, "n q"]
    f: Float[np.ndarray, "q n"]
    h: NeuronOutput
    u: Float[np.ndarray, "n n"]
    v: Float[np.ndarray, "n p"]
    eta: float
    l_z: NeuronInjection
    lambda_: Float[np.ndarray, "q"]

    products: ClassVar[Mapping[str, tuple[str, str]]] = {"v": ("u", "l")}

    @staticmethod
    def inequality(proof: Any) -> Blocks:
        """Blocks of the matrix inequality that a certificate of an observer for a model with
        neurons must satisfy."""
        weights = multiplier_matrix(proof.lambda_)
        return structured_observer_inequality(proof, weights, weights @ proof.l_z)

    @classmethod
    def holds(cls, **numbers: Any) -> bool:
        """Whether the theorem's matrix conditions hold and the observer may inject the output error
        into the neurons."""
        if _closes_algebraic_loop(numbers["h"], numbers["l_z"]):
            return False
        return super().holds(**numbers)

    def failed_checks(self, context: VerificationContext) -> list[str]:
        """One sentence for each claim of the observer's certificate that does not hold for the
        model."""
        messages = []
        if _closes_algebraic_loop(self.h, self.l_z) and self.certified:
            messages.append(".l_z: must be zero, for neurons stand in the output (H)")
        return messages + super().failed_checks(context)


def _closes_algebraic_loop(h: NeuronOutput, l_z: NeuronInjection) -> bool:
    """Whether an observer that injects the output error into neurons has an algebraic loop, because
    neurons affect the output."""
    return bool(np.any(h) and np.any(l_z))


def structured_observer_inequality(proof: Any, multipliers: Any, injection_product: Any) -> Blocks:
    """Blocks of the matrix inequality that proves contraction of an observer of a model with
    neurons, for given multipliers. `injection_product` is `N = Lambda L_z`; `multipliers` is the
    diagonal matrix Lambda.
    """
    neuron_inputs = multipliers @ proof.f + proof.alpha * (injection_product @ proof.c)
    error_step = proof.u @ proof.a + proof.alpha * (proof.v @ proof.c)
    neuron_step = proof.u @ proof.e + proof.alpha * (proof.v @ proof.h)
    contracted_metric = (1 - proof.rate) * proof.q
    error_block = contracted_metric - proof.eta * (proof.c.T @ proof.c)
    error_neuron_block = -1.0 * neuron_inputs.T - proof.eta * (proof.c.T @ proof.h)
    slope_block = proof.eta * np.eye(proof.c.shape[0])
    slope_neuron_block = (-1.0 * proof.beta) * injection_product.T
    slope_step_block = proof.beta * proof.v.T
    neuron_block = 2.0 * multipliers - proof.eta * (proof.h.T @ proof.h)
    next_metric = proof.u + proof.u.T - proof.q
    return [
        [error_block, 0, error_neuron_block, error_step.T],
        [slope_block, slope_neuron_block, slope_step_block],
        [neuron_block, neuron_step.T],
        [next_metric],
    ]
