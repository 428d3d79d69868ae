"""Settled or not, and when: judged on the true output alone, never on the noisy measurement."""

import numpy as np
from jaxtyping import Float, Int

from ssm_study.loop.rollout import Rollouts

NEVER = -1
"""Settling sample of a case that never settles."""


def last_step(reference: Float[np.ndarray, "T p"]) -> int:
    """The sample at which a reference of steps takes its last value; 0 if it still moves in the second half."""
    changes = np.flatnonzero(np.any(np.diff(reference, axis=0) != 0, axis=1))
    last = int(changes[-1]) + 1 if len(changes) else 0
    return last if last <= len(reference) // 2 else 0


def settling_samples(rollouts: Rollouts, band: float) -> Int[np.ndarray, "N"]:
    """The samples after the last step of the reference from which `|y - reference| <= band` holds to the end.

    `NEVER` if there is none. `band` in the output's unit. A case that left the bound never settles, whatever it did
    before; a case that is within the band throughout settles in 0.
    """
    outside = (np.abs(rollouts.y - rollouts.reference) > band).any(axis=2)
    last_outside = outside.shape[1] - 1 - np.argmax(outside[:, ::-1], axis=1)
    first = np.where(outside.any(axis=1), last_outside + 1, 0)
    settled = rollouts.stayed & (first < outside.shape[1])
    return np.where(settled, np.maximum(first - last_step(rollouts.reference), 0), NEVER)


def settling_times_s(rollouts: Rollouts, band: float) -> tuple[float | None, ...]:
    """Settling times in seconds, None for cases that never settle."""
    return tuple(None if k == NEVER else float(k * rollouts.step_s) for k in settling_samples(rollouts, band))


def overshoots(rollouts: Rollouts, band: float) -> Float[np.ndarray, "N"]:
    """`max(0, excursion beyond the reference, on the far side from the start) / |y - reference| at the start`.

    The start is the last step of the reference; the worst channel counts. Only excursions beyond the band count: within
    it, the measurement noise that the controller passes on decides. Zero for cases that start within the band.
    """
    error = (rollouts.y - rollouts.reference)[:, last_step(rollouts.reference) :]
    start = error[:, :1]
    far = np.maximum(-np.sign(start) * error, 0.0).max(axis=1)
    counts = (np.abs(start[:, 0]) > band) & (far > band)
    return np.where(counts, far / np.where(counts, np.abs(start[:, 0]), 1.0), 0.0).max(axis=1)


def empirical_rate(rollouts: Rollouts, band: float) -> float | None:
    """`1 - r^2`, r the mean shrink per sample of `|y_i - y_j|` from the start until it is within the band.

    The median over all pairs of cases that start more than twice the band apart; in the convention of `rate_controller`
    (distances shrink by `sqrt(1 - rate)`), so the two compare. Pairs that never come within the band are taken to the
    end of the horizon. None without such pairs.
    """
    i, j = np.triu_indices(len(rollouts.y), k=1)
    distance = np.linalg.norm(rollouts.y[i] - rollouts.y[j], axis=2)
    distance = distance[distance[:, 0] > 2 * band]
    if not len(distance):
        return None
    within = distance <= band
    at = np.where(within.any(axis=1), np.argmax(within, axis=1), distance.shape[1] - 1)
    end = np.maximum(distance[np.arange(len(distance)), at], band / 2)  # resolution: an exact zero is not a rate
    return float(1.0 - np.median((end / distance[:, 0]) ** (2.0 / np.maximum(at, 1))))
