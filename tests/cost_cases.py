"""A guaranteed-cost problem of fourth order, for the tests of its Riccati equations."""

import sys
from pathlib import Path

import numpy as np

from ssm_study.certificates.problem import Problem
from ssm_study.systems import JacobianBall

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from synthesis_instances import random_model


def cost_problem(rate: float = 0.1, ball: JacobianBall | None = None) -> Problem:
    """Mixed stable modes, an output weight, and slopes from 0.4 to 1 unless others are given."""
    rng = np.random.default_rng(2)
    linear = random_model(rng, 4, "stable", mixed=True)
    output_weight = linear.c.T
    identity = np.eye(4)
    state_cost = 1e-2 * identity
    state_weight = output_weight @ linear.c + state_cost
    ball = ball or JacobianBall.from_slopes(0.4, 1.0)
    return Problem(
        a=linear.a, b=linear.b, ball=ball, rate=rate, state_weight=state_weight, input_weight=0.5
    )
