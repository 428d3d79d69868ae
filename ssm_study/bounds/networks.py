"""Bounds on networks in any dimension: interval arithmetic, and the paper's spectral-norm figure beside it."""

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.slopes import SlopeBound, ball_around_identity, bound_from_ball
from ssm_study.models.network import Network
from ssm_study.refusal import require

# Interval bounds are computed in floats and widened by this share: a thousand additions err by less than 1e-12.
ROUNDING_SHARE = 1e-12


def interval_jacobians(network: Network) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, "k m"]]:
    """`|J(v) - centre| <= radius` entrywise for every `v`: interval products `W_{L+1} Phi_L W_L ... Phi_1 W_1`."""
    centre, radius = np.eye(network.inputs), np.zeros((network.inputs, network.inputs))
    layers = zip(network.weights[:-1], network.negative_slopes, network.positive_slopes, strict=True)
    for weight, negative, positive in layers:
        centre, radius = weight @ centre, np.abs(weight) @ radius
        middle, half = ((positive + negative) / 2)[:, None], (np.abs(positive - negative) / 2)[:, None]
        radius = np.abs(middle) * radius + half * (np.abs(centre) + radius)
        centre = middle * centre
    weight = network.weights[-1]
    return weight @ centre, (np.abs(weight) @ radius) + ROUNDING_SHARE * _magnitude(network)


def _magnitude(network: Network) -> Float[np.ndarray, "k m"]:
    product = np.eye(network.inputs)
    for weight, negative, positive in zip(
        network.weights[:-1], network.negative_slopes, network.positive_slopes, strict=True
    ):
        product = np.maximum(np.abs(positive), np.abs(negative))[:, None] * (np.abs(weight) @ product)
    return np.abs(network.weights[-1]) @ product


def interval_bound(network: Network) -> SlopeBound:
    """`||J - centre||_2 <= || radius ||_2`: sound on both sides, cheap, loose where neurons cancel."""
    require(
        network.inputs == network.outputs,
        "scaffold",
        (network.outputs, network.inputs),
        "a ball around alpha I needs as many outputs as inputs",
        "use a square scaffolding",
    )
    centre, radius = interval_jacobians(network)
    ball = ball_around_identity(centre, float(np.linalg.norm(radius, 2)))
    return bound_from_ball(ball, method="interval")


def spectral_norm_bound(network: Network) -> SlopeBound:
    """`prod ||W_l||_2 max|phi'|` above, `prod sigma_min(W_l) min|phi'|` below: [Z26] section IV.

    The upper figure is sound. The lower one is not: `W1 = [1, 1]^T, W2 = [1, -1]` is the zero map, yet the product is
    positive. Neither says where the Jacobians lie, so there is no ball.
    """
    lower = upper = 1.0
    for weight in network.weights:
        values = np.linalg.svd(weight, compute_uv=False)
        lower, upper = lower * float(values[-1]), upper * float(values[0])
    for negative, positive in zip(network.negative_slopes, network.positive_slopes, strict=True):
        slopes = np.abs(np.concatenate([negative, positive]))
        lower, upper = lower * float(slopes.min()), upper * float(slopes.max())
    return SlopeBound(lower=lower, upper=upper, ball=None, method="spectral_norm", sound_lower=False, sound_upper=True)
