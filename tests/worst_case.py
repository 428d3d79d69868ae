"""How tight a bound is: the Jacobian farthest from the centre that a search can find, against the
certified radius.

The other route to the bounds of docs/theory.md: from below."""

from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Float

from ssm_study.bounds.network import Network
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.systems import JacobianBall

# Slopes of a piecewise-linear network have no gradient; the search climbs a smoothed copy, sharper
# in each round.
TEMPERATURES = (1.0, 0.3, 0.1, 0.03)


@dataclass(frozen=True, kw_only=True)
class Worst:
    """The input `v (m,)` whose Jacobian is farthest from `alpha I`, and that distance: a bound from
    below."""

    v: Float[np.ndarray, "m"]
    distance: float

    def tightness(self, ball: JacobianBall) -> float:
        """Found over certified: one when the bound is exact, never above."""
        return self.distance / ball.beta if ball.beta > 0 else 1.0


def worst_jacobian(
    scaffold: Scaffold, ball: JacobianBall, *, starts: int, seed: int = 0, span: float = 5.0
) -> Worst:
    """`max_v |J(v) - alpha I|_2` by sampling and, for networks, ascent from the best `starts` on a
    smoothed copy."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-span, span, size=(64 * starts, scaffold.inputs))
    jacobians = [scaffold.jacobian(v) for v in points]
    distances = [_distance(jacobian, ball.alpha) for jacobian in jacobians]
    order = np.argsort(distances)
    best_first = order[::-1]
    best = best_first[:starts]
    candidates = [(distances[i], points[i]) for i in best]
    network = getattr(scaffold, "network", None)
    if isinstance(network, Network):
        for i in best:
            alpha = _own_centre(scaffold, ball)
            v = _climb(network, alpha, points[i])
            jacobian = scaffold.jacobian(v)
            distance_after = _distance(jacobian, ball.alpha)
            candidates.append((distance_after, v))
    distance, v = max(candidates, key=lambda pair: pair[0])
    return Worst(v=v, distance=distance)


def _own_centre(scaffold: Scaffold, ball: JacobianBall) -> float:
    """The centre as the inner network sees it: a residual scaffolding is `alpha I + beta G`."""
    return 0.0 if hasattr(scaffold, "multipliers") else ball.alpha


def _distance(jacobian: Float[np.ndarray, "m m"], alpha: float) -> float:
    identity = np.eye(len(jacobian))
    centre = alpha * identity
    difference = jacobian - centre
    norm = np.linalg.norm(difference, 2)
    return float(norm)


def _climb(network: Network, alpha: float, start: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    v = start
    for temperature in TEMPERATURES:
        arguments = (network, alpha, temperature)
        search = scipy.optimize.minimize(_nearness, v, args=arguments, method="L-BFGS-B")
        v = np.asarray(search.x)
    return v


def _nearness(
    v: Float[np.ndarray, "m"], network: Network, alpha: float, temperature: float
) -> float:
    jacobian = _smooth_jacobian(network, v, temperature)
    return -_distance(jacobian, alpha)


def _smooth_jacobian(
    network: Network, v: Float[np.ndarray, "m"], temperature: float
) -> Float[np.ndarray, "k m"]:
    d = v
    product = np.eye(network.input_count)
    layers = zip(
        network.weights,
        network.biases,
        network.negative_slopes,
        network.positive_slopes,
        strict=False,
    )
    for w, b, low, high in layers:
        z = w @ d + b
        share = scipy.special.expit(z / temperature)
        slope = low + (high - low) * share
        slopes = slope[:, None]
        product = slopes * (w @ product)
        slope_at_z = np.where(z >= 0, high, low)
        slope_at_rest = np.where(b >= 0, high, low)
        d = slope_at_z * z - slope_at_rest * b
    return network.weights[-1] @ product
