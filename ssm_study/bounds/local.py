"""Local controllability and observability of the model along any trajectory: [Z26] Propositions 1 and 2."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.gramians import controllability_gramian, observability_gramian
from ssm_study.systems import JacobianBall, StateSpace

# Rank decisions: a matrix counts as rank deficient when its smallest singular value is below this share of the
# largest, a hundred times the rounding of its entries.
RANK_FLOOR = 1e-14


@dataclass(frozen=True, kw_only=True)
class LocalProperty:
    """`mu^2 W' <= W <= nu^2 W'` for the Gramian W of the variational dynamics along any trajectory of `horizon` steps.

    `lower = mu^2 lambda_min(W')` and `upper = nu^2 lambda_max(W')` bound every eigenvalue of W; W' is the Gramian of
    the linear part over as many steps as it has states. `distance` is the least `sigma_min([A - lambda I, B])`
    over the modes (Popov-Belevitch-Hautus). `holds` is True when that is not zero within rounding and `mu > 0`; a
    Gramian of a high-order model may underflow to a `lower` of zero although the property holds.
    """

    holds: bool
    horizon: int
    distance: float
    mu: float
    nu: float
    lower: float
    upper: float


def local_controllability(linear: StateSpace, ball: JacobianBall) -> LocalProperty:
    """Along any input the states can be steered both ways, if `(A, B)` is controllable and `mu_u > 0`."""
    gramian = controllability_gramian(linear, horizon=linear.order)
    return _local(linear.a, linear.b, gramian, ball)


def local_observability(linear: StateSpace, ball: JacobianBall) -> LocalProperty:
    """Along any trajectory nearby states can be told apart, if `(A, C)` is observable and `mu_y > 0`."""
    gramian = observability_gramian(linear, horizon=linear.order)
    return _local(linear.a.T, linear.c.T, gramian, ball)


def _local(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], gramian: Float[np.ndarray, "n n"], ball: JacobianBall
) -> LocalProperty:
    values = np.linalg.eigvalsh(gramian)
    mu, nu = abs(ball.alpha) - ball.beta, abs(ball.alpha) + ball.beta
    distance = hautus_distance(a, b)
    return LocalProperty(
        holds=bool(mu > 0 and distance > RANK_FLOOR * np.linalg.norm(np.hstack([a, b]), 2)),
        horizon=len(a),
        distance=distance,
        mu=mu,
        nu=nu,
        lower=float(max(mu, 0.0) ** 2 * max(values[0], 0.0)),
        upper=float(nu**2 * values[-1]),
    )


def hautus_distance(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> float:
    """`min over the eigenvalues lambda of A of sigma_min([A - lambda I, B])`: zero iff some mode is out of reach."""
    values = np.linalg.eigvals(a)
    return min(float(np.linalg.svd(np.hstack([a - v * np.eye(len(a)), b]), compute_uv=False)[-1]) for v in values)
