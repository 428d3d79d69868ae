"""The mismatch margin: how much model error the closed loop tolerates, over how much the validation record shows.

Write the true output as `y = y_model + e`. With `u = K xh` the closed loop maps `e` to `u` through

    x+ = (A + B J_u K) x + B J_u K eps,     eps+ = (A + L J_y C) eps - L e,     u = K (x + eps),

`J_u`, `J_y` in the balls of Jacobians (D cancels). With integral action `u = K_x (x + eps) + K_z z` and
`z+ = z + J_y C x + e`, the measured output being what is integrated (here D is taken as zero). By the small-gain
theorem the loop survives any mismatch operator `u -> e` of gain below `1 / ||T_ue||_inf`; that gain is estimated on the
validation record as `g = ||e||_2 / ||u||_2`. A predictor, not a certificate: g is one record's gain, and the Jacobians
are taken constant. Source: THEORY section 5.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.models.free_run import free_run
from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis.hinf_norm import frequency_response, hinf_norm
from ssm_study.systems import JacobianBall, StateSpace


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """`margin = 1 / (gain peak)`; both factors in scaled units. Above one, the loop is predicted to hold."""

    gain: float
    peak: float

    @property
    def margin(self) -> float:
        """Zero when the linearised loop is unstable at one of the slopes; infinite when the record shows no error."""
        if np.isinf(self.peak):
            return 0.0
        product = self.gain * self.peak
        return float("inf") if product == 0.0 else 1.0 / product


def mismatch(
    model: SSM,
    k: Float[np.ndarray, "m s"],
    l: Float[np.ndarray, "n p"],  # noqa: E741 - the paper's letter
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    validation: tuple[Trajectory, ...],
    start_up_samples: int = 0,
) -> Mismatch:
    """The margin of one controller and observer of this model."""
    gain = mismatch_gain(model, validation, start_up_samples)
    return Mismatch(gain=gain, peak=sensitivity_peak(model.linear, k, l, input_ball, output_ball))


def mismatch_gain(model: SSM, validation: tuple[Trajectory, ...], start_up_samples: int = 0) -> float:
    """`g = ||e||_2 / ||u||_2` over all validation records, `e = y - y_model` in free run, both in scaled units.

    With `start_up_samples` the initial state is estimated from them (`models.free_run`), and they do not count.
    Measurement noise in the record counts as mismatch. Raises `BadRequest` without a record that moves the input.
    """
    error, drive = 0.0, 0.0
    for record in validation:
        missed = (record.y - free_run(model, record, start_up_samples)) / model.output_scale
        moved = (record.u - model.input_equilibrium) / model.input_scale
        error += float((missed[start_up_samples:] ** 2).sum())
        drive += float((moved[start_up_samples:] ** 2).sum())
    require(
        drive > 0,
        "validation",
        f"{len(validation)} record(s)",
        "the input never leaves its equilibrium, so no mismatch can be measured",
        "give a validation record that excites the plant",
    )
    return float(np.sqrt(error / drive))


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
    pairs = [(i, o) for i in slopes(input_ball) for o in slopes(output_ball)]
    return max(hinf_norm(sensitivity(linear, k, l, *pair)) for pair in pairs)


def peaks_on_grid(
    linear: StateSpace,
    ks: Float[np.ndarray, "C m s"],
    ls: Float[np.ndarray, "O n p"],
    input_ball: JacobianBall,
    output_ball: JacobianBall,
    angles: Float[np.ndarray, "F"],
) -> Float[np.ndarray, "C O"]:
    """The largest `sigma_max(T_ue)` on a grid of frequencies, for every pair of controller and observer at once.

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
            peak = np.maximum(peak, _largest(np.einsum("cfmk,cofkp->cofmp", inverse, through)))
    return peak


def _with_output(linear: StateSpace, a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> StateSpace:
    return StateSpace(a=a, b=b, c=np.eye(linear.order), d=np.zeros_like(b))


def _largest(response: np.ndarray) -> Float[np.ndarray, "C O"]:
    if response.shape[-1] == response.shape[-2] == 1:
        return np.abs(response[..., 0, 0]).max(axis=2)
    return np.linalg.norm(response, ord=2, axis=(-2, -1)).max(axis=2)
