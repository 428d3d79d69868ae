"""LQG as the textbook has it: the linear part and the mean slope of the nonlinearity, no
certificate."""

from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import Problem
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.peers.peer import Identified, Peer
from ssm_study.loop.peers.pi import mean_slope
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, JacobianBall

LINEAR = JacobianBall(alpha=1.0, beta=0.0)


def lqg(model: SSM, weights: Synthesis) -> ObserverFeedback:
    """`K = -(R + B^T S B)^{-1} B^T S A` and the predictor's Kalman gain, S_u replaced by its mean
    slope.

    Of `weights` the cost and the noise count, as `Synthesis` has them, not the rates.
    """
    slope = mean_slope(model)
    linear = replace(model.linear, b=model.linear.b @ slope)
    k, dual = (_gain(weights.problem(linear, LINEAR, observes)) for observes in (False, True))
    plain = replace(model, scaffold_in=LinearScaffold(gain=slope))
    return ObserverFeedback(model=plain, gains=Gains(k=k, l=dual.T))


def _gain(problem: Problem) -> Float[np.ndarray, "m n"]:
    a, b, r = problem.a, problem.b, problem.input_weight * np.eye(problem.b.shape[1])
    s = scipy.linalg.solve_discrete_are(a, b, problem.state_weight, r)
    return -np.linalg.solve(r + b.T @ s @ b, b.T @ s @ a)


class LqgPeer(Peer, names=("lqg",)):
    """With the weights of `synthesis=riccati` and the sensor's own noise; one input scale drives
    the states."""

    def build(self, plant: Plant, known: Identified, rate: float) -> ObserverFeedback:
        return lqg(known.without_neurons, weights_of(plant, known, rate))


def weights_of(plant: Plant, known: Identified, rate: float) -> Synthesis:
    """Weights of `synthesis=riccati`, with the sensor's own noise, mean over the outputs; a linear
    design has no rate."""
    noise = max(
        float(np.mean(np.array(plant.noise_variance) / known.model.scale.output_scale**2)), 1e-6
    )
    return RiccatiSynthesis(rate_controller=rate, rate_observer=rate, output_noise=noise)
