"""How fast a design is on the model itself: the area under its response, for hundreds of designs at once.

Used to choose among certified designs (docs/closed_loop.md); the separation it leans on is in docs/theory.md.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import SSM
from ssm_study.signals import Trajectory

CASES = 12
"""States the model is released from, evenly spaced along the validation record."""
LEVELS = (-0.5, -0.25, 0.25, 0.5)
"""Constant loads, in those that hold one output scale."""
TIME_CONSTANTS = 4.0
"""Horizon, in time constants of the model's slowest mode."""
SAMPLES = (50, 150)
"""Shortest and longest horizon: a mode slower than that is not what a loop is judged by."""
FAINT = 0.1
"""States whose uncontrolled response is below this share of the largest are not counted: they rest already."""
LARGEST = 1e6
"""Scaled signals are cut here, so that a design that diverges on the model gets a huge area and not an overflow."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """States `x0 (N, n)` let go at sample 0, with `load (N, k)` added to `S_u(u)` ever after; `horizon` in samples."""

    x0: Float[np.ndarray, "N n"]
    load: Float[np.ndarray, "N k"]
    horizon: int


def release(model: SSM, validation: tuple[Trajectory, ...], loaded: bool) -> Release:
    """`CASES` states that the model passes through in the validation record; if `loaded`, also rest under loads.

    Not states in which a constant input would hold the model: a model may have a mode so slow that no record ever
    filled it, and a design that looks fast from there leaves the estimate of that mode behind on the plant.
    """
    linear, n = model.linear, model.order
    visited = np.concatenate([_states(model, record) for record in validation])
    x0 = visited[np.linspace(0, len(visited) - 1, CASES + 2).astype(int)[1:-1]]
    slowest = -np.log(min(max(linear.spectral_radius, 1e-6), 1 - 1e-6))
    horizon = int(np.clip(np.ceil(TIME_CONSTANTS / slowest), *SAMPLES))
    load = _loads(model) if loaded else np.zeros((0, linear.b.shape[1]))
    return Release(
        x0=np.concatenate([x0, np.zeros((len(load), n))]),
        load=np.concatenate([np.zeros((len(x0), linear.b.shape[1])), load]),
        horizon=horizon,
    )


def _states(model: SSM, record: Trajectory) -> Float[np.ndarray, "T n"]:
    x, visited, lifted = np.zeros(model.order), np.empty((len(record), model.order)), model.lift(record.u)
    for k, ubar in enumerate(lifted):
        visited[k] = x
        x = model.advance(x, ubar)
    return visited


def _loads(model: SSM) -> Float[np.ndarray, "L k"]:
    """`LEVELS` of each channel of `S_u`, scaled so that level one moves the output by one scale; idle ones left out."""
    linear = model.linear
    held = np.linalg.solve(np.eye(model.order) - linear.a, linear.b).T
    reach = np.linalg.norm(model.read_scaled(held, np.zeros((len(held), linear.b.shape[1]))), axis=1)
    counts = reach > 1e-6 * reach.max()
    return np.concatenate([level * np.eye(len(held))[counts] / reach[counts, None] for level in LEVELS])


def relative_areas(
    model: SSM,
    ks: Float[np.ndarray, "C m s"],
    ls: Float[np.ndarray, "O n p"],
    pairs: Int[np.ndarray, "P 2"],
    validation: tuple[Trajectory, ...],
) -> Float[np.ndarray, "P"]:
    """`sum_k ||y[k]|| / sum_k ||y_uncontrolled[k]||`, mean over the released states; observers start from zero.

    `pairs` names controller and observer of each design. Gains of width `s = n + p` act on integrators too, and are
    also judged by how soon they remove constant loads. No noise, scaled units. Below one is faster than no control.
    """
    start = release(model, validation, loaded=ks.shape[2] > model.order)
    none = np.zeros((1, *ks.shape[1:])), np.zeros((1, *ls.shape[1:])), np.zeros((1, 2), dtype=int)
    alone = _areas(model, *none, start)[0]
    counts = alone > FAINT * alone.max()
    return (_areas(model, ks, ls, pairs, start)[:, counts] / alone[counts]).mean(axis=1)


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
