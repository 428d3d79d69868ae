"""How fast a design is on the model itself: the area under its response, for hundreds of designs at once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import SSM

LEVELS = (-1.0, -0.5, -0.25, 0.25, 0.5, 1.0)
"""Outputs from which the model is released, in output scales: where the training record moved it."""
TIME_CONSTANTS = 5.0
"""Horizon, in time constants of the model's slowest mode: the uncontrolled response has decayed to 0.7 % by then."""
SAMPLES = (50, 500)
"""Shortest and longest horizon."""
LARGEST = 1e6
"""Scaled signals are cut here, so that a design that diverges on the model gets a huge area and not an overflow."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """States `x0 (N, n)` in which a constant input held the model, let go at sample 0; `horizon` in samples."""

    x0: Float[np.ndarray, "N n"]
    horizon: int


def release(model: SSM) -> Release:
    """One set of states per input channel, at all `LEVELS`; channels that do not move the output are left out."""
    linear, n = model.linear, model.order
    held = np.linalg.solve(np.eye(n) - linear.a, linear.b).T
    reach = np.linalg.norm(model.read_scaled(held, np.zeros((len(held), linear.b.shape[1]))), axis=1)
    moved = held[reach > 1e-6 * reach.max()] / reach[reach > 1e-6 * reach.max(), None]
    slowest = -np.log(min(max(linear.spectral_radius, 1e-6), 1 - 1e-6))
    horizon = int(np.clip(np.ceil(TIME_CONSTANTS / slowest), *SAMPLES))
    return Release(x0=np.concatenate([level * moved for level in LEVELS]), horizon=horizon)


def relative_areas(
    model: SSM,
    ks: Float[np.ndarray, "C m n"],
    ls: Float[np.ndarray, "O n p"],
    pairs: Int[np.ndarray, "P 2"],
) -> Float[np.ndarray, "P"]:
    """`sum_k ||y[k]|| / sum_k ||y_uncontrolled[k]||`, mean over the released states; observers start from zero.

    `pairs` names controller and observer of each design. No noise, scaled units. Below one is faster than no control.
    """
    start = release(model)
    none = np.zeros((1, *ks.shape[1:])), np.zeros((1, *ls.shape[1:])), np.zeros((1, 2), dtype=int)
    alone = _areas(model, *none, start)[0]
    return (_areas(model, ks, ls, pairs, start) / np.maximum(alone, np.finfo(float).tiny)).mean(axis=1)


def _areas(
    model: SSM,
    ks: Float[np.ndarray, "C m n"],
    ls: Float[np.ndarray, "O n p"],
    pairs: Int[np.ndarray, "P 2"],
    start: Release,
) -> Float[np.ndarray, "P N"]:
    linear = model.linear
    k, l_ = ks[pairs[:, 0]].transpose(0, 2, 1), ls[pairs[:, 1]].transpose(0, 2, 1)
    x = np.broadcast_to(start.x0, (len(pairs), *start.x0.shape)).copy()
    x_hat, area = np.zeros_like(x), np.zeros(x.shape[:2])
    for _ in range(start.horizon):
        lifted = model.scaffold_in(np.clip(x_hat @ k, -LARGEST, LARGEST))
        y = model.read_scaled(x, lifted)
        innovation = model.read_scaled(x_hat, lifted) - y
        area += np.linalg.norm(y, axis=2)
        x = x @ linear.a.T + lifted @ linear.b.T
        x_hat = np.clip(x_hat @ linear.a.T + lifted @ linear.b.T + innovation @ l_, -LARGEST, LARGEST)
    return area
