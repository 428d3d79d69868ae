"""Free run over a record whose initial state nobody measured: estimated from the samples that are not scored."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.signals import Trajectory

START_UP_NOISE = 1e-3
"""Variance of the measurement noise assumed while estimating, in scaled output units: a few percent of the signal."""
GAUSS_NEWTON_STEPS = 5  # for a nonlinear S_y; a linear one is solved by the first


def free_run(model: Any, record: Trajectory, start_up_samples: int) -> Float[np.ndarray, "T p"]:
    """The simulated output `(T, p)`, physical: from rest if every sample is scored, else from the estimated state.

    A model that is no `SSM` (a baseline) simulates as it does by itself.
    """
    if start_up_samples == 0 or not isinstance(model, SSM):
        return model.simulate(record.u)
    return model.simulate(record.u, initial_state(model, record, start_up_samples))


def initial_state(model: SSM, record: Trajectory, samples: int) -> Float[np.ndarray, "n"]:
    """`argmin |y - y_hat(x0)|^2 / noise + x0^T W^{-1} x0` over the first `samples`, W the reachability Gramian.

    W is that of the record's own lifted input over the record's length, so a state that the input cannot reach is not
    invented to fit the noise; a mode near the unit circle, whose Gramian over all time is singular, does no harm.
    The current sample's output error is linearised through `S_y` and solved by Gauss-Newton.
    """
    samples = min(samples, len(record))
    lifted = model.lift(record.u)
    drive = model.linear.b * lifted.std(axis=0)
    prior = reachability_gramian(model.linear.a, drive, len(record))
    target = (record.y[:samples] - model.output_equilibrium) / model.output_scale
    powers = [model.linear.c]
    for _ in range(samples - 1):
        powers.append(powers[-1] @ model.linear.a)
    observability = np.stack(powers)
    x0 = np.zeros(model.order)
    for _ in range(GAUSS_NEWTON_STEPS):
        ybar, _ = model.linear.simulate(lifted[:samples], x0)
        slopes = np.stack([model.scaffold_out.jacobian(y) for y in ybar])
        o = (slopes @ observability).reshape(-1, model.order)
        missing = (target - model.scaffold_out(ybar)).ravel() + o @ x0
        x0 = prior @ o.T @ np.linalg.solve(o @ prior @ o.T + START_UP_NOISE * np.eye(len(o)), missing)
    return x0


def reachability_gramian(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"], samples: int
) -> Float[np.ndarray, "n n"]:
    """`sum_k A^k B B^T A^kT` over k below the first power of two that is not less than `samples`: by doubling."""
    gramian, power = b @ b.T, a
    for _ in range((samples - 1).bit_length()):
        gramian, power = gramian + power @ gramian @ power.T, power @ power
    return gramian
