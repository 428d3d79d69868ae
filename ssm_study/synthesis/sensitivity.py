"""How the closed loop answers an output error: the transfer function of the mismatch, its peaks, the controller alone.

With `y = y_model + e` and `u = K xh`, `J_u` and `J_y` in the balls of Jacobians (D cancels),

    x+  = (A + B J_u K) x + B J_u K eps,     eps+ = (A + L J_y C) eps - L e,     u = K (x + eps).

With integral action `u = K_x (x + eps) + K_z z` and `z+ = z + J_y C x + e`, the measured output being what is
integrated (here D is taken as zero). The Jacobians are taken constant, at the ends and the centre of their balls.
Source: THEORY section 5.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Float

from ssm_study.synthesis.hinf_norm import frequency_response, gains, hinf_norm
from ssm_study.systems import JacobianBall, StateSpace

FINE_ANGLES = np.geomspace(1e-4, np.pi, 1000)
"""Frequencies (rad/sample) of the weighted peak, beside those of the loop's own modes."""


def slopes(ball: JacobianBall) -> tuple[float, ...]:
    """The slopes the peak is taken over: both ends of the ball and its centre."""
    return (ball.lower, ball.alpha, ball.upper) if ball.beta > 0 else (ball.alpha,)


def sensitivity(
    linear: StateSpace,
    k: Float[np.ndarray, "m s"],
    l: Float[np.ndarray, "n p"],  # noqa: E741
    slope_in: float,
    slope_out: float,
) -> StateSpace:
    """`T_ue` at constant slopes, from `e (p)` to `u (m)`, state `(x, eps, z)`; `s = n`, or `n + p` with integrators."""
    n, p = l.shape
    on_state, on_integral = k[:, :n], k[:, n:]
    drive, integral = slope_in * linear.b @ on_state, slope_in * linear.b @ on_integral
    seen, count = slope_out * linear.c[: on_integral.shape[1]], on_integral.shape[1]
    return StateSpace(
        a=np.block(
            [
                [linear.a + drive, drive, integral],
                [np.zeros((n, n)), linear.a + slope_out * l @ linear.c, np.zeros((n, count))],
                [seen, np.zeros((count, n)), np.eye(count)],
            ]
        ),
        b=np.vstack([np.zeros((n, p)), -l, np.eye(count, p)]),
        c=np.hstack([on_state, on_state, on_integral]),
        d=np.zeros((len(k), p)),
    )


def sensitivity_peak(
    linear: StateSpace,
    k: Float[np.ndarray, "m s"],
    l: Float[np.ndarray, "n p"],  # noqa: E741
    input_ball: JacobianBall,
    output_ball: JacobianBall,
) -> float:
    """`max ||T_ue||_inf` over the slopes of both balls; infinite if one of these loops is unstable."""
    pairs = product(slopes(input_ball), slopes(output_ball))
    return max(hinf_norm(sensitivity(linear, k, l, *pair)) for pair in pairs)


def weighted_peak(
    linear: StateSpace,
    k: Float[np.ndarray, "m s"],
    l: Float[np.ndarray, "n p"],  # noqa: E741
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    weight: Callable[[Float[np.ndarray, "F"]], Float[np.ndarray, "F"]],
) -> float:
    """`max_w weight(w) sigma_max(T_ue(e^{jw}))` over the slopes; infinite if one of these loops is unstable.

    On `FINE_ANGLES` and at the angles of the loop's own modes, where it is sharpest: from below.
    """
    peak = 0.0
    for slope_in, slope_out in product(slopes(input_ball), slopes(output_ball)):
        loop = sensitivity(linear, k, l, slope_in, slope_out)
        modes = np.linalg.eigvals(loop.a)
        if np.abs(modes).max() >= 1:
            return float("inf")
        angles = np.union1d(FINE_ANGLES, np.maximum(np.abs(np.angle(modes)), FINE_ANGLES[0]))
        peak = max(peak, float((weight(angles) * gains(loop, angles)).max()))
    return peak


def controller_radius(
    linear: StateSpace,
    ks: Float[np.ndarray, "G m s"],
    ls: Float[np.ndarray, "G n p"],
    input_ball: JacobianBall,
    output_ball: JacobianBall,
) -> Float[np.ndarray, "G"]:
    """Spectral radius of each controller by itself, the largest over the slopes, its integrators left out.

    While the plant holds still (friction holds it, its actuator saturates), `y = y*` and the controller runs alone:
    `xh+ = (A + B J_u K_x + L J_y (C + D J_u K_x)) xh`. At or above one, rest is unstable for every plant that holds
    still under small inputs, whatever its certificate says of the model. Field's term: strong stabilisation.
    Source: Youla, Bongiorno & Lu, Automatica 10 (1974) 159-173.
    """
    on_state, largest = ks[:, :, : linear.order], np.zeros(len(ks))
    for slope_in, slope_out in product(slopes(input_ball), slopes(output_ball)):
        driven = slope_in * on_state
        alone = linear.a + linear.b @ driven + slope_out * ls @ (linear.c + linear.d @ driven)
        largest = np.maximum(largest, np.abs(np.linalg.eigvals(alone)).max(axis=1))
    return largest


def peaks_on_grid(
    linear: StateSpace,
    ks: Float[np.ndarray, "C m s"],
    ls: Float[np.ndarray, "O n p"],
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    angles: Float[np.ndarray, "F"],
    weights: Float[np.ndarray, "F"] | float = 1.0,
) -> Float[np.ndarray, "C O"]:
    """The largest `weight sigma_max(T_ue)` on a grid of frequencies, for every pair of controller and observer at once.

    `T_ue = (I - J_u F G)^{-1} (K_z / (z - 1) - K_x (z I - A - L J_y C)^{-1} L)`, `F = K_x + K_z J_y C / (z - 1)`,
    `G = (z I - A)^{-1} B`, separates the pair into two factors, so a hundred controllers and fifty observers cost
    little more than one of each. From below: a peak between two frequencies is missed, an unstable loop is not seen.
    """
    n, peak = linear.order, np.zeros((len(ks), len(ls)))
    on_state, on_integral = ks[:, :, :n], ks[:, :, n:]
    summed = np.einsum("cmq,f->cfmq", on_integral, 1 / (np.exp(1j * angles) - 1))
    to_state = frequency_response(_with_output(linear, linear.a, linear.b), angles)
    for slope_out in slopes(output_ball):
        seen = slope_out * linear.c[: on_integral.shape[2]]
        loops = (on_state[:, None] + summed @ seen) @ to_state
        observed = np.stack(
            [frequency_response(_with_output(linear, linear.a + slope_out * l @ linear.c, l), angles) for l in ls]  # noqa: E741
        )
        through = -np.einsum("cmn,ofnp->cofmp", on_state, observed)
        if on_integral.shape[2]:
            through = through + summed[:, None]
        for slope_in in slopes(input_ball):
            inverse = np.linalg.inv(np.eye(ks.shape[1]) - slope_in * loops)
            size = _sizes(np.einsum("cfmk,cofkp->cofmp", inverse, through))
            peak = np.maximum(peak, (weights * size).max(axis=2))
    return peak


def _with_output(linear: StateSpace, a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> StateSpace:
    return StateSpace(a=a, b=b, c=np.eye(linear.order), d=np.zeros_like(b))


def _sizes(response: np.ndarray) -> Float[np.ndarray, "C O F"]:
    if response.shape[-1] == response.shape[-2] == 1:
        return np.abs(response[..., 0, 0])
    return np.linalg.norm(response, ord=2, axis=(-2, -1))
