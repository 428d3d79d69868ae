"""Set of initial states from which the input never reaches a limit, so that rates proved without
limits hold.

Problem. The input is limited: from which initial states does the loop never reach a limit?

Hypotheses. Those of `state_feedback`; the estimate starts exact (the controller is initialised at
rest), and the set point is the equilibrium.

Statement. Let P prove a rate in (0, 1) for K (the inequality of `state_feedback`), `[l_i, h_i]` be
the limits of input i as scaled deviations from rest, and `v` a level with, for each input and each
start `x_j`,

    l_i < 0 < h_i,    h_i^2 > v K_i P K_i^T,    l_i^2 > v K_i P K_i^T,    [v, x_j^T; x_j, P] > 0.

Then no limit acts from their convex hull and its mirror image: `x^T P^{-1} x < v` there, it falls
as long as none acts, and `|K_i x|^2 <= K_i P K_i^T x^T P^{-1} x` stays below the limits. So every
rate that is proved of the pair holds.

A range of outputs is claimed only of starts at rest at the corners of a box of outputs
(`synthesis.deployed.equilibrium_corners`): their hull and its mirror image then contain every
equilibrium with outputs in the box. For a linear S_y that couples the outputs the corners are those
of the outputs themselves, not of the arguments of S_y; `verify` derives them again and decides the
level set for them.

When not to use it. For an estimate that starts elsewhere (its error adds to the input), or a set
point near a limit.

Reference. [Z26] Theorem 1, eq. (11); level sets: Boyd et al. 1994, section 5.2; docs/theory.md.

Example. `x+ = x + u`, `u = -0.5 x`, `|u| < 1`: no limit acts from within 2.

>>> import numpy as np
>>> from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
>>> one = np.ones((1, 1))
>>> told = dict(rate_limit=1.0, method="", started=0.0, status="")
>>> numbers = dict(a=one, b=one, k=-0.5 * one, p=one, y=one)
>>> numbers |= dict(sigma=0.1, alpha=1.0, beta=0.0, rate=0.5)
>>> limits = np.array([[-1.0, 1.0]])
>>> part = StateFeedbackOfBall.from_numbers(numbers, **told)
>>> found = certify_unlimited_start([part], one, limits)
>>> print(f"{found.starts[0, 0]:.6f}, certified: {found.certified}")
2.000000, certified: True
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.theorem import Blocks
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall

# relative room that exact arithmetic finds between the level and the limits, starts and the level
ROUNDING = 1e-9
FARTHEST = 1e6  # scaled: a gain that hardly moves an input reaches no limit from anywhere near

InputLimits = Float[np.ndarray, "m two"]
Starts = Float[np.ndarray, "n j"]


@dataclass(frozen=True, kw_only=True)
class UnlimitedStart(StateFeedbackOfBall):
    """Certificate of a set of initial outputs from which the closed loop never reaches an input
    limit. Beside the fields of `state_feedback` it has the limits `(m, 2)` and starts `(n, j)`,
    scaled, and the level."""

    limits: InputLimits
    starts: Starts
    level: float

    @classmethod
    def conditions(cls, proof: Any) -> dict[str, Blocks]:  # of the class, to extend its parent's
        """Matrices that must be positive definite for no input limit to be reached from the
        certified initial states."""
        matrices = super().conditions(proof)
        for i in range(proof.limits.shape[0]):
            limits = proof.limits[i : i + 1, :]
            gain = proof.k[i : i + 1, :]
            largest_input = proof.level * (gain @ proof.p @ gain.T)  # squared
            ends = {"lower": -1 * limits[:, 0:1], "upper": limits[:, 1:2]}
            for name, end in ends.items():
                matrices[f"{name} limit {i}"] = [[end]]
                unused = end @ end - largest_input
                matrices[f"{name} limit {i} is not reached"] = [[unused]]
        for j in range(proof.starts.shape[1]):
            start = proof.starts[:, j : j + 1]
            matrices[f"start {j}"] = [[proof.level, start.T], [proof.p]]
        return matrices


def certify_unlimited_start(
    certificates: Sequence[StateFeedbackOfBall], corners: Starts, input_limits: InputLimits
) -> UnlimitedStart | None:
    """Certificate of the largest set of initial outputs from which no input limit is reached; None
    where the proved set is empty. The set is the largest fraction of the `corners` that the metric
    of one part proves."""
    started = time.perf_counter()
    room = np.minimum(-input_limits[:, 0], input_limits[:, 1])
    if not (room > 0).all() or not corners.any():
        return None
    candidates = []
    for part in certificates:
        squared_reach = np.einsum("ij,jk,ik->i", part.k, part.p, part.k)
        divisors = np.maximum(squared_reach, np.finfo(float).tiny)
        highest_level = float((room**2 / divisors).min())
        scaled_corners = scipy.linalg.solve(part.p, corners, assume_a="pos")
        corner_levels = (corners * scaled_corners).sum(axis=0)
        farthest = corner_levels.max()
        level = min(highest_level, float(farthest) * FARTHEST**2)
        share = float(np.sqrt(level / farthest))
        candidates.append((share, level, part))
    share, level, part = max(candidates, key=lambda candidate: candidate[0])
    numbers = dict(part.variables)
    numbers["limits"] = input_limits
    numbers["starts"] = (1 - ROUNDING) * share * corners
    numbers["level"] = level * (1 - ROUNDING)
    information: Any = {
        "rate_limit": certificates[0].rate_limit,
        "method": "limited input",
        "status": "level set",
    }
    proved: UnlimitedStart = UnlimitedStart.from_numbers(numbers, started=started, **information)
    return proved if proved.certified else None
