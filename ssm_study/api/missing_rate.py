"""Text on the reasons why no contraction rate can be proved for a given gain."""

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.frontier import Frontier
from ssm_study.systems import JacobianBall, spectral_radius

OUT_OF_REACH = "a mode out of reach"  # as `Frontier.decided_by` says it
OF_CONTROLLER = "the input does not reach it, so no gain stabilises it; use another actuator"
OF_OBSERVER = "the output does not show it, so no gain stabilises it; use another sensor"


def describe_uncontrollable_mode(frontier: Frontier, is_observer: bool) -> str:
    """Text on an unstable mode that no gain can stabilise; empty where there is none."""
    if frontier.rate_limit > 0 or frontier.decided_by != OUT_OF_REACH:
        return ""
    cause = OF_OBSERVER if is_observer else OF_CONTROLLER
    return f"a mode of modulus {frontier.contraction_limit:.4g} is not stable and {cause}"


def explain_uncertifiable_gain(
    a: Float[np.ndarray, "n n"], feedback_matrix: Float[np.ndarray, "n n"], ball: JacobianBall
) -> str:
    """Text that explains by closed-loop eigenvalues why no contraction rate can be certified for a
    gain. The eigenvalues are those of `A + s B K` at the slopes s.

    `feedback_matrix` is `B K`, or `(L C)^T` of an observer.
    """
    opposite = spectral_radius(a - ball.alpha * feedback_matrix)
    mean = spectral_radius(a + ball.alpha * feedback_matrix)
    if mean >= 1:
        words = f"not stable at the mean slope (spectral radius {mean:.4g})"
        if opposite < 1:
            words += "; stable with the opposite sign: gains enter as u = K x and L (yh - y)"
        return words
    for slope in (ball.lower, ball.upper):
        radius = spectral_radius(a + slope * feedback_matrix)
        if radius >= 1:
            return f"not stable at slope {slope:.4g} (spectral radius {radius:.4g})"
    return (
        f"stable at the mean slope (spectral radius {mean:.4g}), yet no single constant metric "
        f"proves a rate for every slope from {ball.lower:.4g} to {ball.upper:.4g}"
    )
