"""The largest mismatch of a model with neurons under which every trajectory of the loop is proved
to come to rest.

Problem. The loop `u = K xh` with the observer of `structured_observer` runs on a plant with `y =
y_model + e`, `e = Delta(W u)`: how large may the mismatch Delta be? Letters as there and in
`tolerance`.

Hypotheses. Slopes of each neuron in [0, 1]; `S_u` in the ball `alpha I + beta Delta`; `S_y(v) =
alpha_out v`; `L_z = 0` where `H != 0`. Delta is causal, and `||e||_2 <= s ||W u||_2` from rest: it
is held against rest, not against another trajectory, so the claim is rest and not contraction.

Statement. With `xi = (x, eps, x_W)`, `A_xi, B_p, B_e, C_u, C_W` of `tolerance`, and two sets of
neurons beside them, of the plant's model against rest and of the observer against the plant's,

    w = phi(z) - phi(bias),    z - bias = [F + alpha G K, alpha G K_x, 0] xi + G p,
    d = phi(zh) - phi(z),      zh - z = [0, F + alpha_out L_z C, 0] xi - L_z e,

which enter by `B_w = [E; 0; 0]`, `B_d = [0; E + alpha_out L H; 0]`, if `P, lambda_p, s > 0` and
diagonal `Lambda > 0` (both sets) satisfy, with `Z (xi, p, e)` the two rows above,

    diag( P - lambda_p beta^2 C_u^T C_u - s^2 C_W^T C_W,  lambda_p I,  I,  2 Lambda ) - [0, -Z^T
    Lambda; *, 0]
        - [A_xi B_p B_e B_w B_d]^T P [A_xi B_p B_e B_w B_d]  >  0

(the second matrix added with both its corners), then x and eps are square-summable and tend to zero
from every start.

When not to use it. As a promise of contraction: all come to rest, but nothing is said of two on
their way.

Reference. docs/theory.md, "With neurons"; Megretski & Rantzer 1997, Theorem 1; `E = 0, H = 0` is
`tolerance`.

Example. `x+ = 0.2 x + 0.3 phi(x) + u`, `K = -0.25`, `L = -0.5`: at slope zero e answers u by `1.2 /
(8 * 0.7 * 0.95)`.

>>> import numpy as np
>>> from ssm_study.certificates.theorems.tolerance import largest_tolerance
>>> from ssm_study.systems import Balls, JacobianBall, StructuredSystem
>>> one, unit = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> matrices = dict(a=0.2 * one, b=one, c=one, d=0 * one, e=0.3 * one, f=one, g=0 * one, h=0 * one)
>>> loop = StructuredSystem(**matrices)
>>> gains = {"k": -0.25 * one, "l": -0.5 * one, "l_z": 0 * one}
>>> balls = Balls(input=unit, output=unit)
>>> context = VerificationContext(system=loop, controlled=loop, balls=balls, gains=gains)
>>> found = largest_tolerance(context, weight=one, theorem=StructuredTolerance)
>>> print(f"{found.s:.2f} <= {8 * 0.7 * 0.95 / 1.2:.2f}, certified: {found.certified}")
4.43 <= 4.43, certified: True
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.theorem import VerificationContext, assemble_blocks
from ssm_study.certificates.theorems.tolerance import Candidates, Tolerance


@dataclass(frozen=True, kw_only=True)
class StructuredTolerance(Tolerance):
    """Certificate of the largest mismatch under which the loop of a model with neurons comes to
    rest. The fields of `tolerance`, and `e (s, q), f (q, s), g (q, m)`, `h (p, q)`, `l_z (q,
    p)`, `lambda_ (2 q,)`."""

    e: Float[np.ndarray, "s q"]
    f: Float[np.ndarray, "q s"]
    g: Float[np.ndarray, "q m"]
    h: Float[np.ndarray, "p q"]
    l_z: Float[np.ndarray, "q p"]
    lambda_: Float[np.ndarray, "w"]

    @staticmethod
    def matrices(of: Any) -> Any:
        """Matrices of the loop in the theorem's statement, from the fields of the certificate."""
        (s, m), (p, n), q = of.b.shape, of.c.shape, of.g.shape[0]
        (linear, into_u), filtered = Tolerance.matrices(of), of.weight.shape[0] - m
        inside = of.e[:n, :] + of.alpha_out * (of.l @ of.h)
        steps = [
            [of.e, np.zeros((s, q))],
            [np.zeros((n, q)), inside],
            [np.zeros((filtered, q)), np.zeros((filtered, q))],
        ]
        none = np.zeros((q, filtered))
        moved = of.alpha * of.g
        first = [of.f + moved @ of.k, moved @ of.k[:, :n], none, of.g, np.zeros((q, p))]
        second = [
            np.zeros((q, s)),
            of.f[:, :n] + of.alpha_out * (of.l_z @ of.c),
            none,
            np.zeros((q, m)),
            -1.0 * of.l_z,
        ]
        return (
            assemble_blocks([[linear, assemble_blocks(steps)]]),
            into_u,
            assemble_blocks([first, second]),
        )

    def model_data(self, context: VerificationContext) -> dict[str, Any]:
        looped = context.system.h.any() and self.l_z.any()
        return super().model_data(context) | ({"alpha_out": np.nan} if looped else {})

    @classmethod
    def candidates(
        cls, into_w: Any, beta: float, loop: Any, into_u: Any, seen: Any = None
    ) -> Candidates:
        """Candidate values of the tolerance with metric and neuron multipliers, the largest
        tolerance first. A semidefinite program maximises `s^2`; each candidate lies a little
        inside, with room to round."""
        from ssm_study.certificates.semidefinite import largest_mismatch  # CVXPY

        for found in largest_mismatch(loop, into_u, seen, into_w, beta):
            yield {**found, "status": "inside the largest that the solver finds"}
