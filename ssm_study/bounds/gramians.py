"""How strongly inputs reach states and states reach outputs: Gramians, Hankel singular values,
balanced truncation."""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.systems import JacobianBall, StateSpace

Square = Float[np.ndarray, "n n"]
InputMatrix = Float[np.ndarray, "n m"]

# Hankel singular values below this share of the largest are rounding: they are square roots of what
# is known to 1e-16.
BALANCING_FLOOR = 1e-8
RANK_FLOOR = (
    1e-14  # share of the norm below which a smallest singular value is zero: a hundred roundings
)


def controllability_gramian(a: Square, b: InputMatrix, horizon: int | None = None) -> Square:
    """Controllability Gramian of a linear system `(A, B)`, over a finite or infinite horizon. `W =
    sum_k A^k B B^T (A^T)^k`, over `horizon` samples or, for a stable model, over all: `W = A W A^T
    + B B^T`.

    The observability Gramian is that of `(A^T, C^T)`. Raises `BadRequest` for an infinite horizon
    on a model that is not stable. Source: [Z26] eq. (9), without the scaffolding.
    """
    if horizon is None:
        eigenvalues = np.linalg.eigvals(a)
        radius = float(np.abs(eigenvalues).max())
        problem = "the infinite-horizon Gramian of a model that is not stable does not exist"
        remedy = "use a finite horizon, or identify a stable model"
        require(radius < 1, "spectral_radius", radius, problem, remedy)
        w = scipy.linalg.solve_discrete_lyapunov(a, b @ b.T)
    else:
        w = np.zeros_like(a)
        power = b
        for _ in range(horizon):
            w = w + power @ power.T
            power = a @ power
    return (w + w.T) / 2


def hankel_singular_values(linear: StateSpace) -> Float[np.ndarray, "n"]:
    """Hankel singular values of a discrete-time linear system, in descending order. `sqrt(eig(W_c
    W_o))`, descending: how much each balanced state carries from past input to future output."""
    root_c, root_o = _gramian_factors(linear)
    return np.asarray(scipy.linalg.svdvals(root_o.T @ root_c))


def balanced_realization(linear: StateSpace, order: int | None = None) -> StateSpace:
    """Balanced realisation of a linear system, truncated to fewer states if requested. `z = T^+ x`
    by square roots (Laub et al. 1987): both Gramians are diagonal with the Hankel singular values.

    Keeps the first `order` states (default: all); twice the sum of the values dropped bounds the
    H-infinity norm of what truncation changes (Enns 1984; Glover 1984). Raises `BadRequest` for a
    model that is not stable, an order outside `1 .. n`, or kept states whose Hankel singular value
    lies below `BALANCING_FLOOR` of the largest: such coordinates would be rounding noise.
    """
    order = linear.order if order is None else order
    problem = f"the model has order {linear.order}"
    require(1 <= order <= linear.order, "truncate_to", order, problem, "choose 1 .. order")
    root_c, root_o = _gramian_factors(linear)
    left, hankel, right_t = np.linalg.svd(root_o.T @ root_c)  # R_o^T R_c = U Sigma V^T
    largest = hankel[0]
    is_well_conditioned = hankel > BALANCING_FLOOR * largest
    least = float(hankel[order - 1])
    problem = (
        f"below {BALANCING_FLOOR:g} of the largest ({largest:.3g}), so balanced coordinates "
        "are ill-conditioned"
    )
    remedy = f"set reduction.truncate_to to at most {is_well_conditioned.sum()}"
    require(is_well_conditioned[order - 1], "hankel_smallest", least, problem, remedy)
    scale = 1 / np.sqrt(hankel[:order])
    right = right_t[:order].T
    left_t = left[:, :order].T
    t = root_c @ right * scale  # T = R_c V Sigma^{-1/2}
    t_inverse = scale[:, None] * (left_t @ root_o.T)  # Sigma^{-1/2} U^T R_o^T
    a = t_inverse @ linear.a @ t
    b = t_inverse @ linear.b
    c = linear.c @ t
    return StateSpace(a=a, b=b, c=c, d=linear.d)


def _gramian_factors(linear: StateSpace) -> tuple[Square, Square]:
    """Square-root factors of a linear system's controllability and observability Gramians."""
    controllability_factor = _square_root_factor(controllability_gramian(linear.a, linear.b))
    observability_factor = _square_root_factor(controllability_gramian(linear.a.T, linear.c.T))
    return controllability_factor, observability_factor


def _square_root_factor(gramian: Square) -> Square:
    """Square-root factor `R`, with `R R^T = W`, of a Gramian `W` that may be singular."""
    values, vectors = np.linalg.eigh(gramian)
    roots = np.sqrt(np.maximum(values, 0.0))
    return vectors * roots


@dataclass(frozen=True, kw_only=True)
class LocalGramianBounds:
    """Lower and upper bound on local controllability or observability of a nonlinear model along
    any trajectory. `mu^2 W' <= W <= nu^2 W'` for the Gramian W of the variational dynamics along
    any trajectory of n steps.

    `lower = mu^2 lambda_min(W')` and `upper = nu^2 lambda_max(W')`, W' the Gramian of the linear
    part over as many steps as it has states. `holds`: no mode is out of reach, within rounding, and
    `mu > 0`; of a high-order model `lower` may underflow to zero although the property holds.
    Source: [Z26] Propositions 1 and 2.
    """

    holds: bool
    lower: float
    upper: float


def bound_local_controllability(
    a: Square, b: InputMatrix, ball: JacobianBall
) -> LocalGramianBounds:
    """Lower and upper bound on how strongly inputs move the states of a nonlinear model along any
    trajectory. The states can be steered in both directions along any input if `(A, B)` is
    controllable and `mu_u > 0`.

    For `(A^T, C^T)` this is observability: along any trajectory nearby states can be distinguished,
    if `(A, C)` is observable and `mu_y > 0`.
    """
    order = len(a)
    gramian = controllability_gramian(a, b, order)
    values = np.linalg.eigvalsh(gramian)
    least_gain = abs(ball.alpha) - ball.beta  # mu: of a Jacobian in the ball
    largest_gain = abs(ball.alpha) + ball.beta  # nu
    size = np.linalg.norm(np.hstack([a, b]), 2)
    is_reached = _distance_to_uncontrollable(a, b) > RANK_FLOOR * size
    holds = bool(least_gain > 0 and is_reached)
    lower = max(least_gain, 0.0) ** 2 * max(values[0], 0.0)
    upper = largest_gain**2 * values[-1]
    return LocalGramianBounds(holds=holds, lower=float(lower), upper=float(upper))


def _distance_to_uncontrollable(a: Square, b: InputMatrix) -> float:
    """Distance of a pair `(A, B)` to an uncontrollable one, from the Popov-Belevitch-Hautus test at
    the eigenvalues of A. By Popov, Belevitch and Hautus a mode is out of reach iff this matrix
    loses rank."""
    identity = np.eye(len(a))
    smallest_values = []
    for mode in np.linalg.eigvals(a):
        reachability_test = np.hstack([a - mode * identity, b])
        singular_values = np.linalg.svd(reachability_test, compute_uv=False)
        smallest_values.append(float(singular_values[-1]))
    return min(smallest_values)
