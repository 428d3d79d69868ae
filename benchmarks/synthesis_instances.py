"""Random models and requests at a stated distance from the exact frontier: what the synthesis
benchmarks run on.

A model is drawn as the recurrent unit would be: real modes and rotations of 2 x 2, moduli uniform
in [0.2, 1] of the largest, which is below one (stable), one (marginal) or up to 1.3 (unstable); B
and C normal. A slope floor is drawn log-uniform from [0.01, 0.9] (slopes in [floor, 1]); the asked
rate is the one at which beta/alpha lies `gap` inside (gap < 0: beyond) the exact frontier.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.systems import JacobianBall, StateSpace

KINDS = {"stable": 0.99, "marginal": 1.0, "unstable": 1.3}


@dataclass(frozen=True, kw_only=True)
class Instance:
    """A model, the ball of its input scaffolding, and a rate `gap` inside the frontier."""

    linear: StateSpace
    ball: JacobianBall
    rate: float
    kind: str


def random_model(
    rng: np.random.Generator, order: int, kind: str, mixed: bool = False, inputs: int = 1
) -> StateSpace:
    """`mixed`: dense random coordinates (condition about ten to a hundred) instead of modal
    ones."""
    blocks = []
    left = order
    while left:
        modulus = KINDS[kind] * (1.0 if left == order else rng.uniform(0.2, 1))
        if left >= 2 and rng.random() < 0.5:
            angle = rng.uniform(0, np.pi)
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            blocks.append(modulus * turn)
            left -= 2
        else:
            blocks.append(np.array([[modulus * rng.choice([-1, 1])]]))
            left -= 1
    a = scipy.linalg.block_diag(*blocks)
    b = rng.normal(size=(order, inputs))
    c = rng.normal(size=(1, order))
    if mixed:
        t = rng.normal(size=(order, order)) / np.sqrt(order) + np.eye(order)
        a = t @ a @ np.linalg.inv(t)
        b = t @ b
        c = c @ np.linalg.inv(t)
    return StateSpace(a=a, b=b, c=c, d=np.zeros((1, inputs)))


def random_instance(
    rng: np.random.Generator,
    orders: tuple[int, int],
    gap: float,
    mixed: bool = False,
    inputs: int = 1,
) -> Instance | None:
    """None when the model, the ball and the gap leave no rate in (0, 1)."""
    kind = str(rng.choice(list(KINDS)))
    linear = random_model(rng, int(rng.integers(orders[0], orders[1] + 1)), kind, mixed, inputs)
    floor = float(np.exp(rng.uniform(np.log(0.01), np.log(0.9))))
    ball = JacobianBall.from_slopes(floor, 1.0)
    wider = JacobianBall(alpha=ball.alpha, beta=ball.beta / (1 - gap))
    contraction = contraction_frontier(linear.a, linear.b, wider).contraction_limit
    if not 0 < contraction < 1 or wider.relative_radius >= 1:
        return None
    return Instance(linear=linear, ball=ball, rate=1 - contraction**2, kind=kind)
