"""What is proved of a pair of gains once it is chosen: the largest rates, and the mismatch that the loop tolerates.

Both theorems are about the very gains that are deployed: `theorems/deployed_rate.py`, `theorems/tolerance.py`;
THEORY section 8.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ssm_study.models.structured import Model
from ssm_study.synthesis.certificate import Design, Infeasible
from ssm_study.synthesis.mismatch import ANGLES, Mismatch
from ssm_study.synthesis.problem import NoSolution, within_floats
from ssm_study.synthesis.theorem import Known, Theorem
from ssm_study.synthesis.theorems.integral_action import controlled_system
from ssm_study.synthesis.theorems.observer import ObserverOfBall
from ssm_study.synthesis.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis.theorems.tolerance import largest_tolerance
from ssm_study.systems import Balls

# Weights of first order that are tried: gain at the highest frequency over that at rest, and the corner (rad/sample).
RATIOS = np.geomspace(1e-3, 1e3, 61)
CORNERS = np.geomspace(1e-3, 3.0, 40)


def as_deployed(design: Design, model: Model, balls: Balls, shown: Mismatch) -> Design:
    """The design with what is proved of its very gains beside it: rates and tolerances, each exactly verified."""
    beside: dict[str, Theorem] = {}
    for side, part in (("state_feedback", design.state_feedback), ("observer", design.observer)):
        again = None if isinstance(part, Infeasible) or not part.certified else within_reach(part.at_largest_rate)
        if again is not None:
            beside[f"{side}_deployed"] = again
    feedback, observer = design.state_feedback, design.observer
    if isinstance(feedback, StateFeedbackOfBall) and isinstance(observer, ObserverOfBall):
        controlled = controlled_system(model, feedback.k)
        known = Known(system=model.system, controlled=controlled, balls=balls, gains=design.gains)
        weights = {"tolerance": np.eye(len(feedback.k))}
        if shown.rests:  # a plant that does not rest by itself shows no gain that a weight could cover
            gains = np.max([view.by_frequency for view in shown.everywhere], axis=0)
            weights["tolerance_by_frequency"] = covering_weight(ANGLES, gains, channels=len(feedback.k))
        found = {name: within_reach(partial(largest_tolerance, known, weight)) for name, weight in weights.items()}
        beside |= {name: part for name, part in found.items() if part is not None}
    return replace(design, beside=beside)


def within_reach(find: Callable[[], Theorem | None]) -> Theorem | None:
    """What is found; None where floats do not hold what it takes: nothing is claimed then, and the design stands."""
    try:
        with within_floats():
            return find()
    except NoSolution:
        return None


def covering_weight(
    angles: Float[np.ndarray, "F"], gains: Float[np.ndarray, "F"], channels: int
) -> Float[np.ndarray, "v v"]:
    """`[A_W, B_W; C_W, D_W]` of the tightest first-order filter, stable with its inverse, that covers what is shown.

    `w(z) = (g_1 t (z - 1) + g_0 (z + 1)) / (t (z - 1) + z + 1)` has gain `g_0` at rest, `g_1` at the highest frequency,
    and `|w|^2 = (g_0^2 + (g_1 t tan)^2) / (1 + (t tan)^2)` with `tan = tan(angle / 2)`, `t = 1 / tan(corner / 2)`.
    Of a grid of ratios and corners the one that exceeds the shown gain by the least mean logarithm; channels alike.
    """
    known = np.isfinite(gains) & (gains > 0)
    if not known.any():
        return np.eye(channels)
    gains, half = gains[known], np.tan(np.minimum(angles[known], np.pi - 1e-6) / 2)
    turn = 1 / np.tan(CORNERS / 2)
    swept = (turn[:, None] * half) ** 2
    shapes = np.log((1 + RATIOS[:, None, None] ** 2 * swept) / (1 + swept)) / 2
    lacking = (np.log(gains) - shapes).max(axis=2)  # log of the least gain at rest at which each covers
    cost = lacking + (shapes - np.log(gains)).mean(axis=2)
    ratio, corner = np.unravel_index(int(np.argmin(cost)), cost.shape)
    rest, t = float(np.exp(lacking[ratio, corner])), float(turn[corner])
    high = rest * float(RATIOS[ratio])
    pole, direct = (t - 1) / (t + 1), (high * t + rest) / (t + 1)  # w(z) as pole and direct path
    output = (rest - high * t) / (t + 1) + direct * pole
    identity = np.eye(channels)
    return np.block([[pole * identity, identity], [output * identity, direct * identity]])
