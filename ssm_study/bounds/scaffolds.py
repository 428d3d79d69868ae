"""`jacobian_ball(scaffold)`: the one question synthesis asks of a scaffolding, answered by the best sound method.

Why a ball, and why with sign: docs/theory.md, "The ball of Jacobians"."""

from fractions import Fraction
from typing import Protocol, runtime_checkable

import numpy as np

from ssm_study.bounds.lipsdp import lipsdp_bound
from ssm_study.bounds.networks import interval_bound, spectral_norm_bound
from ssm_study.bounds.piecewise import slope_interval
from ssm_study.bounds.slopes import SlopeBound, ball_around_identity, bound_from_ball, bound_from_interval
from ssm_study.models.network import Network
from ssm_study.models.scaffold import Scaffold
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.scaffold_monotone import MonotoneScaffold
from ssm_study.models.scaffold_residual import ResidualScaffold
from ssm_study.refusal import BadRequest, require
from ssm_study.systems import JacobianBall

METHODS = ("best", "exact", "interval", "lipsdp", "spectral")


def jacobian_ball(scaffold: Scaffold, method: str = "best") -> SlopeBound:
    """A ball `alpha I + beta Delta` that holds every Jacobian of the scaffolding, with sign.

    `best` is the exact interval where there is one (scalar networks of any depth, monotone and linear scaffoldings),
    the construction for residual ones, and otherwise the narrower of LipSDP and interval
    arithmetic. `spectral` is the paper's figure for
    comparison: without a ball, its lower end unsound. Raises `BadRequest` for a scaffolding
    that is not square, an unknown method, or one that does not apply.
    """
    require(method in METHODS, "bound_method", method, "unknown", f"use one of {', '.join(METHODS)}")
    shape = (scaffold.outputs, scaffold.inputs)
    require(shape[0] == shape[1], "scaffold", shape, "the theorems need a square scaffolding", "lift to m channels")
    match scaffold:
        case LinearScaffold():
            return _linear(scaffold)
        case MonotoneScaffold():
            values = [Fraction(float(s)) for s in scaffold.slopes.ravel()]
            return bound_from_interval(min(values), max(values), "construction", exact=True)
        case ResidualScaffold():
            return bound_from_ball(JacobianBall(alpha=scaffold.alpha, beta=scaffold.beta), "construction")
        case MlpScaffold():
            return _network(scaffold.network, method)
    raise BadRequest(
        "scaffold", scaffold.kind, "no bound is known for this kind", "use linear, mlp, monotone, residual"
    )


def _linear(scaffold: LinearScaffold) -> SlopeBound:
    if scaffold.gain.shape == (1, 1):
        gain = Fraction(float(scaffold.gain[0, 0]))
        return bound_from_interval(gain, gain, "construction", exact=True)
    ball = ball_around_identity(scaffold.gain, 0.0)
    return bound_from_ball(
        ball, "construction", exact=bool(np.all(scaffold.gain == ball.alpha * np.eye(len(scaffold.gain))))
    )


def _network(network: Network, method: str) -> SlopeBound:
    if method == "spectral":
        return spectral_norm_bound(network)
    if method == "exact" or (method == "best" and network.inputs == 1):
        lower, upper = slope_interval(network)
        return bound_from_interval(lower, upper, "break_points", exact=True)
    if method == "interval":
        return interval_bound(network)
    if method == "lipsdp":
        return lipsdp_bound(network)
    interval = interval_bound(network)
    try:
        return min(interval, lipsdp_bound(network), key=_width)
    except BadRequest:  # the solver failed: what it was to improve on stands
        return interval


def _width(bound: SlopeBound) -> tuple[float, float]:
    """Balls that exclude zero by their relative radius, as the frontier sees them; the others by their radius."""
    if bound.ball is None:
        return float("inf"), float("inf")
    return min(bound.ball.relative_radius, 1.0), bound.ball.beta


@runtime_checkable
class HasScaffolds(Protocol):
    """Any model with an input and an output scaffolding."""

    @property
    def scaffold_in(self) -> Scaffold: ...

    @property
    def scaffold_out(self) -> Scaffold: ...


def certified_balls(model: HasScaffolds) -> tuple[JacobianBall, JacobianBall]:
    """The balls the theorems are applied with, of `S_u` and `S_y`: sound on both sides, or `BadRequest`."""
    balls = []
    for name, scaffold in (("scaffold_in", model.scaffold_in), ("scaffold_out", model.scaffold_out)):
        bound = jacobian_ball(scaffold)
        if bound.ball is None or not bound.sound:
            raise BadRequest(name, bound.method, "no sound ball of Jacobians is known", "choose another scaffold")
        balls.append(bound.ball)
    return balls[0], balls[1]
