"""Checks that an observer knows the static maps on which the certificates of a design rely.

The observer `xh+ = A xh + B S_u(u) + L (S_y(C xh) - y)` of [Z26] computes S_u and S_y themselves.
Of a linear system only the slopes of its maps are given: the certificates then hold for every such
map that the observer knows, and an exported observer with another map is not covered. Example: `A =
[[1.3, 1], [0, 1.17]], B = [0, 1]', C = [1, 0]`, slopes (0.8, 1.2), rate 0.3: an observer with slope
1 does not stabilise the plant with slope 1.2: the spectral radius is 1.065.
"""

import warnings
from typing import Any

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import SIDES
from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.refusal import require

SAME_SLOPE = 1e-9  # two slopes that differ by no larger share are one
ARGUMENTS = {"state_feedback": "slopes", "observer": "output_slopes"}
MAPS = {"slopes": "input map", "output_slopes": "output map"}


class UnknownMapWarning(UserWarning):
    """Warning that a simulation uses a constant gain for a static map that is known only by its
    slopes."""


def unknown_map_ranges(model: Any, certificate: Certificates) -> dict[str, str]:
    """Text with the slope range of each static map of which a design knows nothing else. Keyed by
    the argument of `control` that gives the range."""
    balls = certified_balls(model)
    computed = {"state_feedback": balls.input, "observer": balls.output}
    unknown = {}
    for side in SIDES:
        part: Any = certificate.certificates_by_name[side]
        ball = computed[side]
        centre_difference = part.alpha - ball.alpha
        radius_difference = part.beta - ball.beta
        difference = abs(centre_difference) + abs(radius_difference)
        if difference > SAME_SLOPE * abs(part.alpha):
            argument = ARGUMENTS[side]
            lower = part.alpha - part.beta
            upper = part.alpha + part.beta
            unknown[argument] = describe_slope_range(argument, lower, upper)
    return unknown


def describe_slope_range(argument: str, lower: float, upper: float) -> str:
    """Text that names a static map together with its range of slopes."""
    return f"{MAPS[argument]} with slopes {lower:.4g} to {upper:.4g}"


def refuse_unknown_maps(unknown: dict[str, str]) -> None:
    """Raise `BadRequest` for an export if the observer's static map would differ from the
    plant's."""
    maps = " and ".join(unknown.values())
    problem = (
        f"the observer has to compute the {maps}, of which only the slopes are given; with another "
        "map nothing is proved of the loop"
    )
    same = " and ".join(f"{argument}=(g, g)" for argument in unknown)
    remedy = f"give {same} for a map that is the known gain g, or identify the map with st.fit"
    require(not unknown, "design", "maps known by their slopes", problem, remedy)


def warn_of_unknown_maps(unknown: dict[str, str]) -> None:
    """Warn that a simulation uses the mean slope for each static map that is known only by its
    slopes."""
    if not unknown:
        return
    maps = " and the ".join(unknown.values())
    message = (
        f"the {maps}: plant and observer take the gain in the middle for it, and nothing is "
        "certified of the loop with another map"
    )
    warnings.warn(message, UnknownMapWarning, stacklevel=3)
