"""How far a sensor's noise moves the output of the closed loop, for slopes that vary at will.

Problem. The loop `u = K xh` with its observer measures `y + n`: how large is the true output y,
beside the noise n?

Hypotheses. `S_u` as in `state_feedback`; `S_y` linear, `S_y(v) = alpha_out v`, no feedthrough; no
limit acts.

Statement. With the matrices of `tolerance` and `C_y = alpha_out [C, 0, 0]`, if `P > 0`, `lambda_p >
0` and `s > 0`
satisfy

    diag( P - lambda_p beta^2 C_u^T C_u - s^2 C_y^T C_y,  lambda_p I,  I ) - [A_xi B_p B_e]^T P
    [A_xi B_p B_e]  >  0

then `||y - y'||_2 <= ||n - n'||_2 / s` for any two noises from the same start; `1 / s` is the peak
without a ball.

When not to use it. As a forecast for white noise, which moves the output less: the bound is for the
worst frequency.

Reference. [Z26] Theorem 3 without noise; docs/theory.md; Megretski & Rantzer 1997 (multipliers).

Example. `x+ = 0.5 x + u`, `K = -0.25`, `L = -0.5`: y answers n as `-0.125 / (z (z - 0.25))`, at
most 1/6 at z = 1.

>>> import numpy as np
>>> from ssm_study.certificates.theorems.tolerance import largest_tolerance
>>> from ssm_study.systems import Balls, JacobianBall, StateSpace
>>> one, unit = np.ones((1, 1)), JacobianBall(alpha=1.0, beta=0.0)
>>> loop = StateSpace(a=0.5 * one, b=one, c=one, d=0 * one)
>>> gains, balls = {"k": -0.25 * one, "l": -0.5 * one}, Balls(input=unit, output=unit)
>>> known = VerificationContext(system=loop, controlled=loop, balls=balls, gains=gains)
>>> found = largest_tolerance(known, weight=one, theorem=NoiseGain)
>>> print(f"{1 / found.s:.3f} = 1/6 / 0.999, certified: {found.certified}")
0.167 = 1/6 / 0.999, certified: True
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.tolerance import Tolerance


@dataclass(frozen=True, kw_only=True)
class NoiseGain(Tolerance):
    """The fields of `tolerance`; `weight` is the identity and filters nothing."""

    part: ClassVar[str] = "noise"

    @staticmethod
    def seen(of: Any) -> Any:
        return of.alpha_out * (of.c @ np.eye(of.c.shape[1], of.a.shape[0] + of.c.shape[1]))

    def given(self, known: VerificationContext) -> dict[str, Any]:
        direct = {"alpha_out": np.nan} if known.system.d.any() else {}
        return super().given(known) | {"weight": np.eye(len(self.k))} | direct
