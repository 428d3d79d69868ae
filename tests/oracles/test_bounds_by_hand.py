"""Bounds of networks small enough to be worked out on paper."""

from fractions import Fraction

import numpy as np

from ssm_study.bounds.piecewise import slope_values
from ssm_study.models.network import Network


def test_a_bias_of_minus_one_is_negative() -> None:
    """`s1(v - 1) - s1(-1)` is v/4 up to one and `v - 3/4` beyond; the second neuron turns at 1/2, hence at 5/4."""
    one = np.ones((1, 1))
    net = Network(
        weights=(one, one, one),
        biases=(np.array([-1.0]), np.array([-0.5])),
        negative_slopes=(np.array([0.25]), np.array([0.5])),
        positive_slopes=(np.ones(1), np.ones(1)),
    )
    assert slope_values(net) == [Fraction(1, 8), Fraction(1, 2), Fraction(1)]
