"""What is provable of a scaffolding: its ball of Jacobians (docs/theory.md), and how each bound earned its trust."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import JacobianBall


@dataclass(frozen=True, kw_only=True)
class SlopeBound:
    """`lower <= slope <= upper`, and the ball `J = alpha I + beta Delta` that holds every Jacobian.

    For a scalar map the numbers are slopes with sign; in several dimensions they are the ends `alpha -+ beta` of the
    ball (singular values for the norm bounds). `sound_lower, sound_upper` say which side is proved, `exact` whether
    both ends are attained. `ball` is None when the bound says nothing about where in the plane the Jacobians lie (norm
    bounds): such a figure may be printed, never certified with.
    """

    lower: float
    upper: float
    ball: JacobianBall | None
    method: str
    sound_lower: bool
    sound_upper: bool
    exact: bool = False

    @property
    def sound(self) -> bool:
        return self.sound_lower and self.sound_upper


def bound_from_interval(lower: Fraction, upper: Fraction, method: str, exact: bool) -> SlopeBound:
    """Both ends rounded outwards to floats; the ball encloses the rational interval, not its rounded picture."""
    return SlopeBound(
        lower=_rounded_down(lower),
        upper=-_rounded_down(-upper),
        ball=enclosing_ball(lower, upper),
        method=method,
        sound_lower=True,
        sound_upper=True,
        exact=exact,
    )


def bound_from_ball(ball: JacobianBall, method: str, exact: bool = False) -> SlopeBound:
    """`lower, upper = alpha -+ beta`, with sign: `alpha < 0` is a decreasing map."""
    ends = {"lower": ball.lower, "upper": ball.upper}
    return SlopeBound(**ends, ball=ball, method=method, sound_lower=True, sound_upper=True, exact=exact)


def enclosing_ball(lower: Fraction, upper: Fraction) -> JacobianBall:
    """The smallest ball of floats with `alpha - beta <= lower` and `upper <= alpha + beta` in exact arithmetic."""
    require(lower <= upper, "slopes", (float(lower), float(upper)), "lower exceeds upper", "swap them")
    alpha = float((lower + upper) / 2)
    radius = max(upper - Fraction(alpha), Fraction(alpha) - lower)
    return JacobianBall(alpha=alpha, beta=-_rounded_down(-radius))


def _rounded_down(value: Fraction) -> float:
    nearest = float(value)
    return nearest if Fraction(nearest) <= value else float(np.nextafter(nearest, -np.inf))


def ball_around_identity(centre: Float[np.ndarray, "m m"], radius: float) -> JacobianBall:
    """A ball around `alpha I` that holds the ball around `centre`: the distance between the centres is paid for.

    `alpha = trace(centre)/m`; a rotation far from the identity yields a ball that contains zero, which synthesis
    refuses, never a wrong certificate.
    """
    alpha = float(np.trace(centre)) / len(centre)
    distance = float(np.linalg.norm(centre - alpha * np.eye(len(centre)), 2)) if len(centre) > 1 else 0.0
    return JacobianBall(alpha=alpha, beta=distance + radius)
