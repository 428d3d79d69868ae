"""LQG as the textbook has it: the linear part and the mean slope of the nonlinearity, no certificate."""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.peers.peer import Identified, Peer, sensor_variance
from ssm_study.loop.peers.pi import mean_slope
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.plants.plant import Plant
from ssm_study.systems import Pair


@dataclass(frozen=True, kw_only=True)
class LQGWeights:
    """Cost `|y|^2 + input_weight |u|^2`; noise `input_noise` through the input, `state_noise`, `output_noise`; scaled.

    The defaults are those of `synthesis=riccati`; the comparison sets `output_noise` to the sensor's own.
    """

    input_weight: float = 0.01
    state_weight: float = 1e-4
    input_noise: float = 1.0
    state_noise: float = 1e-4
    output_noise: float = 1.0


def linearised(model: SSM) -> SSM:
    """The model as a linear design sees it: S_u replaced by its mean slope."""
    return replace(model, scaffold_in=LinearScaffold(gain=mean_slope(model)))


def lqg(model: SSM, weights: LQGWeights) -> ObserverFeedback:
    """`K = -(R + B^T S B)^{-1} B^T S A` and the predictor's Kalman gain, both for the linearised model."""
    plain = linearised(model)
    a, b, c = model.linear.a, model.linear.b @ mean_slope(model), model.linear.c
    state = c.T @ c + weights.state_weight * np.eye(len(a))
    noise = weights.input_noise * b @ b.T + weights.state_noise * np.eye(len(a))
    k = _gain(a, b, state, weights.input_weight)
    l_ = _gain(a.T, c.T, noise, weights.output_noise).T  # the Kalman predictor is the dual problem
    return ObserverFeedback(model=plain, gains=Pair(k=k, l=l_))


def _gain(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], state: Float[np.ndarray, "n n"], weight: float
) -> Float[np.ndarray, "m n"]:
    r = weight * np.eye(b.shape[1])
    s = scipy.linalg.solve_discrete_are(a, b, state, r)
    return -np.linalg.solve(r + b.T @ s @ b, b.T @ s @ a)


class LqgPeer(Peer, names=("lqg",)):
    """On the linear part and the mean slope, with the sensor's own noise; one input scale drives the states."""

    def build(self, plant: Plant, known: Identified, rate: float) -> ObserverFeedback:  # noqa: ARG002
        return lqg(known.model, LQGWeights(output_noise=sensor_variance(plant, known)))
