"""Rotations and gains of a multi-channel scaffolding, moved into the linear part, so that what is left is near `I`.

`B S_u(v) = (B M) (M^{-1} S_u(v))` and `S_y(C x) = (S_y M^{-1})(M C x)`: the same model, whose scaffoldings now have
Jacobians around the identity. The theorems speak of a ball around `alpha I`; a rotation or a sign per channel lies
outside it and would be refused, although the model is as controllable as any. What cannot be absorbed stays refused.
Derivation: docs/theory.md, "The ball of Jacobians".
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.lipsdp import lipsdp_ball
from ssm_study.bounds.scaffolds import jacobian_ball
from ssm_study.models.identified import SSM
from ssm_study.models.scaffold import Scaffold
from ssm_study.models.scaffold_linear import LinearScaffold
from ssm_study.models.scaffold_mlp import MlpScaffold
from ssm_study.models.scaffold_monotone import MonotoneScaffold
from ssm_study.systems import StateSpace


def absorbed(model: SSM) -> SSM:
    """The same input-output map, `M` moved from each square multi-channel scaffolding where that narrows its ball."""
    linear, mixing = model.linear, _mixing(model.scaffold_in)
    if mixing is not None:
        candidate = _after(model.scaffold_in, np.linalg.inv(mixing))
        if candidate is not None and _narrower(candidate, model.scaffold_in):
            linear = StateSpace(a=linear.a, b=linear.b @ mixing, c=linear.c, d=linear.d @ mixing)
            model = replace(model, linear=linear, scaffold_in=candidate)
    mixing = _mixing(model.scaffold_out)
    if mixing is not None:
        candidate = _before(model.scaffold_out, np.linalg.inv(mixing))
        if candidate is not None and _narrower(candidate, model.scaffold_out):
            linear = StateSpace(a=linear.a, b=linear.b, c=mixing @ linear.c, d=mixing @ linear.d)
            model = replace(model, linear=linear, scaffold_out=candidate)
    return model


def _mixing(scaffold: Scaffold) -> Float[np.ndarray, "m m"] | None:
    """The centre of the Jacobians, if it is a square invertible matrix of more than one channel."""
    if scaffold.inputs != scaffold.outputs or scaffold.inputs == 1:
        return None
    match scaffold:
        case LinearScaffold():
            centre = scaffold.gain
        case MonotoneScaffold():
            centre = np.diag((scaffold.slopes.max(axis=1) + scaffold.slopes.min(axis=1)) / 2)
        case MlpScaffold():
            centre = lipsdp_ball(scaffold.network).centre
        case _:
            return None
    return centre if np.linalg.cond(centre) < 1e8 else None


def _narrower(candidate: Scaffold, present: Scaffold) -> bool:
    new, old = jacobian_ball(candidate).ball, jacobian_ball(present).ball
    return new is not None and old is not None and new.relative_radius < old.relative_radius


def _after(scaffold: Scaffold, m: Float[np.ndarray, "m m"]) -> Scaffold | None:
    """`v -> m S(v)`."""
    match scaffold:
        case LinearScaffold():
            return LinearScaffold(gain=np.eye(len(m)))
        case MonotoneScaffold():
            return replace(scaffold, slopes=np.diagonal(m)[:, None] * scaffold.slopes)
        case MlpScaffold():
            network = scaffold.network
            weights = (*network.weights[:-1], m @ network.weights[-1])
            return MlpScaffold(network=replace(network, weights=weights))
    return None


def _before(scaffold: Scaffold, m: Float[np.ndarray, "m m"]) -> Scaffold | None:
    """`v -> S(m v)`."""
    match scaffold:
        case LinearScaffold():
            return LinearScaffold(gain=np.eye(len(m)))
        case MonotoneScaffold():
            gains = np.diagonal(m)[:, None]
            breakpoints, slopes = scaffold.breakpoints / gains, gains * scaffold.slopes
            turned = gains < 0  # a negative gain runs through the pieces from the other end
            return MonotoneScaffold(
                breakpoints=np.where(turned, breakpoints[:, ::-1], breakpoints),
                slopes=np.where(turned, slopes[:, ::-1], slopes),
            )
        case MlpScaffold():
            network = scaffold.network
            weights = (network.weights[0] @ m, *network.weights[1:])
            return MlpScaffold(network=replace(network, weights=weights))
    return None
