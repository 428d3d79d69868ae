"""Proved bounds on the slopes of a model's static maps: balls that contain all Jacobians of a map,
and how each was proved. The maps are S_u and S_y of docs/theory.md."""

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, slope_interval
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import JacobianBall, JacobianBalls

# What is computed in floats is widened by this share: a thousand additions err by less than 1e-12,
# a norm by less.
ROUNDING_SHARE = 1e-12


@dataclass(frozen=True, kw_only=True)
class SlopeBound:
    """Ball of matrices that provably contains every Jacobian of a static map, with the method of
    proof. `J = alpha I + beta Delta` contains every Jacobian; the smallest and the largest slope
    have a sign.

    In several dimensions these are the ends `alpha -+ beta` of the ball.
    """

    lower: float
    upper: float
    ball: JacobianBall
    method: str


def bound_from_interval(lower: Fraction, upper: Fraction, method: str) -> SlopeBound:
    """Slope bound of a static map from an interval that contains all its slopes. Both ends are
    rounded outwards to floats, so that the ball contains the exact interval."""
    least = _round_down(lower)
    most = -_round_down(-upper)
    ball = enclosing_ball(lower, upper)
    return SlopeBound(lower=least, upper=most, ball=ball, method=method)


def bound_from_ball(ball: JacobianBall, method: str) -> SlopeBound:
    """Slope bound of a static map from a ball that contains all its Jacobians. `lower, upper =
    alpha -+ beta`, with sign: `alpha < 0` is a decreasing map."""
    return SlopeBound(lower=ball.lower, upper=ball.upper, ball=ball, method=method)


def enclosing_ball(lower: Fraction, upper: Fraction) -> JacobianBall:
    """Smallest ball of Jacobians, in floating-point numbers, that contains an exact interval of
    slopes. `alpha - beta <= lower` and `upper <= alpha + beta` in exact arithmetic."""
    ends = (float(lower), float(upper))
    require(lower <= upper, "slopes", ends, "lower exceeds upper", "swap them")
    middle = (lower + upper) / 2
    alpha = float(middle)  # rounded; the radius covers it
    centre = Fraction(alpha)
    radius = max(upper - centre, centre - lower)
    beta = -_round_down(-radius)
    return JacobianBall(alpha=alpha, beta=beta)


def _round_down(value: Fraction) -> float:
    """Largest floating-point number that does not exceed a rational number."""
    nearest = float(value)
    if Fraction(nearest) <= value:
        return nearest
    return float(np.nextafter(nearest, -np.inf))


def ball_around_scaled_identity(centre: Float[np.ndarray, "m m"], radius: float) -> JacobianBall:
    """Ball of matrices around a multiple of the identity that contains a given ball of matrices.
    Its radius grows by the distance between the centres.

    `alpha = trace(centre)/m`; of a rotation far from the identity the ball contains zero, which
    synthesis refuses.
    """
    alpha = float(np.trace(centre)) / len(centre)
    distance = 0.0
    if len(centre) > 1:
        deviation = centre - alpha * np.eye(len(centre))
        distance = float(np.linalg.norm(deviation, 2))
    beta = distance * (1 + ROUNDING_SHARE) + radius
    return JacobianBall(alpha=alpha, beta=beta)


def network_slope_bound(network: Network) -> SlopeBound:
    """Tightest bound on a network's slopes among those that several methods prove. Exact for one
    channel, otherwise the narrower of LipSDP and interval arithmetic."""
    if network.input_count == 1:
        return bound_from_interval(*slope_interval(network), "break_points")
    interval = interval_bound(network)
    try:
        lipsdp = lipsdp_bound(network)
    except BadRequest:  # the solver failed: what it was to improve on stands
        return interval
    return min(interval, lipsdp, key=tightness_sort_key)


def tightness_sort_key(bound: SlopeBound) -> tuple[float, float]:
    """Sort key of slope bounds, smallest for the tightest bound. Balls that exclude zero compare by
    their relative radius, as the frontier sees them; the others by their radius."""
    relative_radius = min(bound.ball.relative_radius, 1.0)
    return relative_radius, bound.ball.beta


def lipsdp_bound(network: Network) -> SlopeBound:
    """Slope bound of a network, proved by semidefinite programming (LipSDP). Raises `BadRequest` if
    the solver fails."""
    from ssm_study.bounds.lipsdp import lipsdp_ball  # CVXPY takes a second to import

    centre, radius = lipsdp_ball(network, scalar_centre=True)
    alpha = float(centre[0, 0])
    ball = JacobianBall(alpha=alpha, beta=radius)
    return bound_from_ball(ball, method="lipsdp")


def interval_bound(network: Network) -> SlopeBound:
    """Slope bound of a network, proved by interval arithmetic. `|J(v) - centre| <= radius`
    entrywise for every v, by interval products `W_{L+1} Phi_L W_L ... Phi_1 W_1`.

    So `||J - centre||_2 <= || radius ||_2`: sound on both sides, cheap, loose where neurons cancel.
    Refuses a network that is not square. Source: Moore 1966 (interval arithmetic).
    """
    shape = (network.output_count, network.input_count)
    problem = "a ball around alpha I needs as many outputs as inputs"
    require(shape[0] == shape[1], "scaffold", shape, problem, "use a square scaffolding")
    centre = np.eye(network.input_count)
    size = np.eye(network.input_count)  # size: what rounding errors are a share of
    radius = np.zeros_like(centre)
    for weight, _, negative, positive in network.hidden_layers():
        centre = weight @ centre
        radius = np.abs(weight) @ radius
        size = np.abs(weight) @ size
        middle = ((positive + negative) / 2)[:, None]
        half_width = (np.abs(positive - negative) / 2)[:, None]
        largest_slopes = np.maximum(np.abs(positive), np.abs(negative))
        # interval product, entry by entry
        radius = np.abs(middle) * radius + half_width * (np.abs(centre) + radius)
        centre = middle * centre
        size = largest_slopes[:, None] * size
    last = network.weights[-1]
    rounding = ROUNDING_SHARE * (np.abs(last) @ size)
    radius = np.abs(last) @ radius + rounding
    norm_of_radius = float(np.linalg.norm(radius, 2))
    ball = ball_around_scaled_identity(last @ centre, norm_of_radius)
    return bound_from_ball(ball, method="interval")


def spectral_norm_bound(network: Network) -> tuple[float, float]:
    """Bounds on a network's slopes by products of the singular values of its weights, as in Zakwan
    et al. `prod ||W_l||_2 max|phi'|` above, `prod sigma_min(W_l) min|phi'|` below: the paper's
    figure, [Z26] section IV.

    The upper figure is sound. The lower one is not: `W1 = [1, 1]^T, W2 = [1, -1]` is the zero map,
    yet the product is positive. Neither says where the Jacobians lie: figures to print, never to
    certify with.
    """
    lower = upper = 1.0
    for weight in network.weights:
        values = np.linalg.svd(weight, compute_uv=False)
        lower = lower * float(values[-1])
        upper = upper * float(values[0])
    for _, _, *both in network.hidden_layers():
        slopes = np.abs(np.concatenate(both))
        lower = lower * float(slopes.min())
        upper = upper * float(slopes.max())
    return lower, upper


def jacobian_ball(scaffold: Any) -> SlopeBound:
    """Ball around a multiple of the identity that contains every Jacobian of a static map. Alpha
    carries the sign of the slopes.

    Each kind knows its own: exact (scalar networks, monotone, linear), by construction (residual),
    or the narrower of LipSDP and interval arithmetic. Raises `BadRequest` for a scaffolding that is
    not square.
    """
    shape = (scaffold.outputs, scaffold.inputs)
    problem = "the theorems need a square scaffolding"
    require(shape[0] == shape[1], "scaffold", shape, problem, "use a square scaffolding")
    return scaffold.slope_bound()


def certified_balls(model: Any) -> JacobianBalls:
    """Balls that provably contain all Jacobians of a model's input map and of its output map.
    Raises `BadRequest` where none is proved."""
    input_bound = jacobian_ball(model.scaffold_in)
    output_bound = jacobian_ball(model.scaffold_out)
    return JacobianBalls(input=input_bound.ball, output=output_bound.ball)
