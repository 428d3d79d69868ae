"""Textbook LQG controller, without a certificate, for comparison."""

from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.problem import Problem
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.peers.peer import ComparisonMethod, IdentificationResult
from ssm_study.loop.peers.pi import mean_input_slope
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, JacobianBall

LINEAR = JacobianBall(alpha=1.0, beta=0.0)


def lqg_controller(model: SSM, weights: Synthesis) -> ObserverFeedback:
    """LQG controller of a model whose input nonlinearity is replaced by its mean slope.

    `K = -(R + B^T S B)^{-1} B^T S A` and the predictor's Kalman gain. The cost and the noise are
    those of `weights`; its rates do not count.
    """
    slope = mean_input_slope(model)
    b = model.linear.b @ slope
    linear = replace(model.linear, b=b)
    problem = weights.problem(linear, LINEAR, False)
    k = _riccati_gain(problem)
    dual_problem = weights.problem(linear, LINEAR, True)
    dual = _riccati_gain(dual_problem)
    scaffold_in = LinearScaffold(gain=slope)
    plain = replace(model, scaffold_in=scaffold_in)
    gains = Gains(k=k, l=dual.T)
    return ObserverFeedback(model=plain, gains=gains)


def _riccati_gain(problem: Problem) -> Float[np.ndarray, "m n"]:
    """State-feedback gain that minimises a quadratic cost, from the Riccati equation."""
    a = problem.a
    b = problem.b
    input_count = b.shape[1]
    r = problem.input_weight * np.eye(input_count)
    s = scipy.linalg.solve_discrete_are(a, b, problem.state_weight, r)
    curvature = r + b.T @ s @ b
    coupling = b.T @ s @ a
    return -np.linalg.solve(curvature, coupling)


class LqgMethod(ComparisonMethod, names=("lqg",)):
    """Comparison method that uses a textbook LQG controller."""

    def build_controller(
        self, plant: Plant, identified: IdentificationResult, rate: float
    ) -> ObserverFeedback:
        """LQG controller for the identified model."""
        weights = lqg_settings(plant, identified, rate)
        return lqg_controller(identified.linear_model, weights)


def lqg_settings(plant: Plant, identified: IdentificationResult, rate: float) -> Synthesis:
    """Settings of the LQG design: cost weights (the defaults of `synthesis=riccati`) and the
    variance of the sensor noise in scaled units.

    One input scale drives the states; a linear design has no rate.
    """
    output_scale = identified.model.scale.output_scale
    noise_variance = np.array(plant.noise_variance)
    scaled_variance = noise_variance / output_scale**2
    mean_variance = np.mean(scaled_variance)
    noise = max(float(mean_variance), 1e-6)
    return RiccatiSynthesis(rate_controller=rate, rate_observer=rate, output_noise=noise)
