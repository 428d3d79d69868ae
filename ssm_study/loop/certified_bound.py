"""The certified bound of the output feedback, sample by sample: what the model may never exceed.

With `M = P^{-1}`, `d[k] = ||x[k]||_M` and `e[k] = ||xh[k] - x[k]||_Q`, Theorem 1 gives `d[k+1] <= r_c d[k] + c e[k]`
and Theorem 2 `e[k+1] <= r_o e[k]`, so

    d[k] <= r_c^k d[0] + c e[0] sum_{i<k} r_c^(k-1-i) r_o^i,        c = nu ||M^{1/2} B||_2 ||K Q^{-1/2}||_2,

`r = sqrt(1 - rate)` and `nu` the largest slope of `S_u`: the input that the estimate's error adds is at most
`nu ||K (xh - x)||`. Source: [Z26] Lemma 1 and Theorem 3, with the constant made explicit.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from ssm_study.synthesis.certificate import Observer, StateFeedback

ROUNDING = 1e-9
"""Relative: what float64 may add to a distance over a thousand steps."""
RESOLUTION = 1e-12
"""Of the bound's own start: below it both sides are rounding."""


def distances(
    x: Float[np.ndarray, "N T n"], x_hat: Float[np.ndarray, "N T s"], feedback: StateFeedback, observer: Observer
) -> tuple[Float[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """`||x||_M` with `M = P^{-1}` and `||xh - x||_Q`; integrators, the columns of `x_hat` beyond n, belong to both."""
    n, lower = x.shape[2], np.linalg.cholesky(feedback.p)
    whole = np.concatenate([x, x_hat[:, :, n:]], axis=2)
    d = np.linalg.norm(solve_triangular(lower, whole.reshape(-1, whole.shape[2]).T, lower=True), axis=0)
    e = np.linalg.norm((x_hat[:, :, :n] - x) @ np.linalg.cholesky(observer.q), axis=2)
    return d.reshape(x.shape[:2]), e


def certified_bound(
    d0: Float[np.ndarray, "N"], e0: Float[np.ndarray, "N"], samples: int, feedback: StateFeedback, observer: Observer
) -> Float[np.ndarray, "N T"]:
    """The right-hand side above for `k = 0 .. samples - 1`."""
    r_c, r_o, c = np.sqrt(1 - feedback.rate), np.sqrt(1 - observer.rate), input_gain(feedback, observer)
    bound, error = np.empty((len(d0), samples)), e0
    for k in range(samples):
        bound[:, k] = d0 if k == 0 else r_c * bound[:, k - 1] + c * error
        error = error if k == 0 else r_o * error
    return bound


def input_gain(feedback: StateFeedback, observer: Observer) -> float:
    """`c = nu ||M^{1/2} B||_2 ||K_x Q^{-1/2}||_2`, `K_x` the columns of K that act on the estimate."""
    on_state = feedback.k[:, : len(observer.q)]
    into = solve_triangular(np.linalg.cholesky(feedback.p), feedback.b, lower=True)
    out = solve_triangular(np.linalg.cholesky(observer.q), on_state.T, lower=True)
    return float((abs(feedback.alpha) + feedback.beta) * np.linalg.norm(into, 2) * np.linalg.norm(out, 2))


def violations(
    x: Float[np.ndarray, "N T n"], x_hat: Float[np.ndarray, "N T s"], feedback: StateFeedback, observer: Observer
) -> int:
    """Samples, over all cases, whose measured distance exceeds the bound by more than rounding."""
    d, e = distances(x, x_hat, feedback, observer)
    bound = certified_bound(d[:, 0], e[:, 0], x.shape[1], feedback, observer)
    floor = RESOLUTION * (d[:, :1] + e[:, :1])
    return int((d > bound * (1 + ROUNDING) + floor).sum())
