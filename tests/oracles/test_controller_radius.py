"""The spectral radius of the controller alone, against the equation written out."""

from itertools import product

import numpy as np
from loop_cases import random_model

from ssm_study.robustness.sensitivity import controller_spectral_radius
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StateSpace


def several_channels():
    rng = np.random.default_rng(2)
    model = random_model(2, inputs=2, outputs=3)
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    d = rng.standard_normal((3, 2))
    linear = StateSpace(a=0.7 * a, b=b, c=c, d=d)
    white_noise = rng.standard_normal((3, 2, 4))
    ks = 0.1 * white_noise
    white_noise = rng.standard_normal((3, 4, 3))
    ls = 0.1 * white_noise
    jacobian_ball = JacobianBall.from_slopes(0.4, 1.0)
    output = JacobianBall.from_slopes(0.8, 1.1)
    balls = JacobianBalls(input=jacobian_ball, output=output)
    return linear, Gains(k=ks, l=ls), balls


def test_the_controller_alone_is_the_equation_written_out():
    """Centre and both ends of either ball; integrators are left out."""
    linear, pairs, balls = several_channels()
    expected = []
    for k, gain in zip(pairs.k, pairs.l, strict=True):
        radii = []
        for input_slope, output_slope in product((0.4, 0.7, 1.0), (0.8, 0.95, 1.1)):
            predicted = linear.a + input_slope * linear.b @ k
            predicted_output = linear.c + input_slope * linear.d @ k
            estimate = predicted + output_slope * gain @ predicted_output
            eigenvalues = np.linalg.eigvals(estimate)
            radii.append(np.abs(eigenvalues).max())
        expected.append(max(radii))
    actual = controller_spectral_radius(linear, pairs, balls)
    np.testing.assert_allclose(actual, expected)
    of_integrators = np.ones((3, 2, 2))
    with_integrators = np.concatenate([pairs.k, of_integrators], axis=2)
    wider = Gains(k=with_integrators, l=pairs.l)
    actual = controller_spectral_radius(linear, wider, balls)
    np.testing.assert_allclose(actual, expected)
    known = JacobianBall(alpha=0.7, beta=0.0)
    narrow = JacobianBalls(input=known, output=known)
    wide = JacobianBalls(input=balls.input, output=known)
    of_narrow = controller_spectral_radius(linear, pairs, narrow)
    of_wide = controller_spectral_radius(linear, pairs, wide)
    assert (of_narrow <= of_wide).all()
