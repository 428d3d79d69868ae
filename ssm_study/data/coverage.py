"""What a data set's inputs can identify: amplitudes visited, spectrum, order of persistency of excitation."""

import warnings

import numpy as np
from jaxtyping import Float

from ssm_study.signals import DataSet

BINS = 20
RANK_TOLERANCE = 4e-13  # samples x machine epsilon, of the largest singular value: below it all is rounding
SAMPLES_FOR_ORDER = 2000
HIGHEST_ORDER = 50  # looked no further: a model of order 24 is identifiable by then


class SlopesNotIdentifiable(UserWarning):
    """The training inputs visit so few amplitudes that the slopes of S_u between them come from initialisation."""


def input_coverage(data: DataSet) -> float:
    """The share of `BINS` equal bins of the amplitude range that the training inputs visit, worst input channel.

    The range of a channel is that of all its records, so a two-level signal scores 2 / `BINS`. In [0, 1].
    """
    training = np.concatenate([r.u for r in data.training])
    everything = np.concatenate([r.u for r in (*data.training, *data.validation, *data.test)])
    shares = [_share(training[:, j], everything[:, j]) for j in range(training.shape[1])]
    return float(min(shares))


def _share(visited: Float[np.ndarray, "T"], everything: Float[np.ndarray, "T2"]) -> float:
    low, high = everything.min(), everything.max()
    if high == low:
        return 0.0
    bins = np.minimum((BINS * (visited - low) / (high - low)).astype(int), BINS - 1)
    return len(np.unique(bins)) / BINS


def warn_if_two_level(data: DataSet) -> str | None:
    """The warning's sentence if some input takes two levels at most over the training records, else None."""
    training = np.concatenate([r.u for r in data.training])
    for j, channel in enumerate(data.inputs):
        levels = len(np.unique(training[:, j]))
        if levels <= 2:
            sentence = (
                f"excitation of {channel.name}: {levels} levels only, so the slopes of a nonlinear S_u between them "
                "are not identifiable; train on a multilevel signal (excitation=aprbs)."
            )
            warnings.warn(sentence, SlopesNotIdentifiable, stacklevel=2)
            return sentence
    return None


def persistency_order(u: Float[np.ndarray, "T m"], highest: int = HIGHEST_ORDER) -> int:
    """The largest L <= `highest` for which the block Hankel matrix of L rows of u has full row rank `m L`.

    A linear system of order n is identifiable from such data if `L >= n + its lag + 1` (Willems et al. 2005). Judged on
    the first 2000 samples.
    """
    u = u[:SAMPLES_FOR_ORDER] - u.mean(axis=0)
    order, too_deep = 0, min(highest, (len(u) + 1) // (u.shape[1] + 1)) + 1
    while too_deep - order > 1:  # the ranks are nested, so halving finds the last full one
        middle = (order + too_deep) // 2
        order, too_deep = (middle, too_deep) if _full_rank(u, middle) else (order, middle)
    return order


def _full_rank(u: Float[np.ndarray, "T m"], depth: int) -> bool:
    columns = len(u) - depth + 1
    hankel = np.concatenate([u[k : k + columns].T for k in range(depth)])
    values = np.linalg.svd(hankel, compute_uv=False)
    return bool(values[-1] > RANK_TOLERANCE * values[0])
