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
    """States `x0 (N, n)` in which a constant input held the model, let go at sample 0; `horizon` in samples.

    `load (N, k)` is added to `S_u(u)` at every sample: what integral action is there to remove.
    """

    x0: Float[np.ndarray, "N n"]
    load: Float[np.ndarray, "N k"]
    horizon: int


def release(model: SSM, loaded: bool) -> Release:
    """One set of states per input channel, at all `LEVELS`; channels that do not move the output are left out.

    If `loaded`, the same number of cases at rest under the constant load that would have led to these states.
    """
    linear, n = model.linear, model.order
    held = np.linalg.solve(np.eye(n) - linear.a, linear.b).T
    reach = np.linalg.norm(model.read_scaled(held, np.zeros((len(held), linear.b.shape[1]))), axis=1)
    counts = reach > 1e-6 * reach.max()
    moved = np.concatenate([level * held[counts] / reach[counts, None] for level in LEVELS])
    load = np.concatenate([level * np.eye(len(held))[counts] / reach[counts, None] for level in LEVELS])
    slowest = -np.log(min(max(linear.spectral_radius, 1e-6), 1 - 1e-6))
    horizon = int(np.clip(np.ceil(TIME_CONSTANTS / slowest), *SAMPLES))
    if not loaded:
        return Release(x0=moved, load=0 * load, horizon=horizon)
    return Release(x0=np.concatenate([moved, 0 * moved]), load=np.concatenate([0 * load, load]), horizon=horizon)


def relative_areas(
    model: SSM,
    ks: Float[np.ndarray, "C m s"],
    ls: Float[np.ndarray, "O n p"],
    pairs: Int[np.ndarray, "P 2"],
) -> Float[np.ndarray, "P"]:
    """`sum_k ||y[k]|| / sum_k ||y_uncontrolled[k]||`, mean over the released states; observers start from zero.

    `pairs` names controller and observer of each design. Gains of width `s = n + p` act on integrators too, and are
    also judged by how soon they remove constant loads. No noise, scaled units. Below one is faster than no control.
    """
    start = release(model, loaded=ks.shape[2] > model.order)
    none = np.zeros((1, *ks.shape[1:])), np.zeros((1, *ls.shape[1:])), np.zeros((1, 2), dtype=int)
    alone = _areas(model, *none, start)[0]
    return (_areas(model, ks, ls, pairs, start) / np.maximum(alone, np.finfo(float).tiny)).mean(axis=1)


def _areas(
    model: SSM,
    ks: Float[np.ndarray, "C m s"],
    ls: Float[np.ndarray, "O n p"],
    pairs: Int[np.ndarray, "P 2"],
    start: Release,
) -> Float[np.ndarray, "P N"]:
    linear, n = model.linear, model.order
    k, l_ = ks[pairs[:, 0]].transpose(0, 2, 1), ls[pairs[:, 1]].transpose(0, 2, 1)
    x = np.broadcast_to(start.x0, (len(pairs), *start.x0.shape)).copy()
    x_hat, area = np.zeros_like(x), np.zeros(x.shape[:2])
    z = np.zeros((*x.shape[:2], k.shape[1] - n))
    for _ in range(start.horizon):
        u = x_hat @ k[:, :n] + z @ k[:, n:]
        lifted = model.scaffold_in(np.clip(u, -LARGEST, LARGEST))
        y = model.read_scaled(x, lifted + start.load)
        innovation = model.read_scaled(x_hat, lifted) - y
        area += np.linalg.norm(y, axis=2)
        z = np.clip(z + y[..., : z.shape[2]], -LARGEST, LARGEST)
        x = x @ linear.a.T + (lifted + start.load) @ linear.b.T
        x_hat = np.clip(x_hat @ linear.a.T + lifted @ linear.b.T + innovation @ l_, -LARGEST, LARGEST)
    return area
