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
FORGOTTEN = 1e-6
"""Of the estimate's first error: its decay is measured until there, far above rounding."""


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


def decay_rate(
    x: Float[np.ndarray, "N T n"], x_hat: Float[np.ndarray, "N T s"], feedback: StateFeedback, observer: Observer
) -> float | None:
    """`1 - r^2`, r the mean shrink per sample of `e = ||xh - x||_Q` until it is below `FORGOTTEN` of its start.

    The slowest case; on the model `e[k+1] <= r_o e[k]`, so it is at least the certified `observer.rate`. Cases that do
    not get there are taken to the end; None if the estimate is exact from the start.
    """
    e = distances(x, x_hat, feedback, observer)[1]
    e = e[e[:, 0] > 0]
    if not len(e):
        return None
    gone = e <= FORGOTTEN * e[:, :1]
    at = np.where(gone.any(axis=1), np.argmax(gone, axis=1), e.shape[1] - 1)
    shrink = e[np.arange(len(e)), at] / e[:, 0]
    return float((1.0 - shrink ** (2.0 / np.maximum(at, 1))).min())


def excess(
    x_hat: Float[np.ndarray, "N T s"], x0: Float[np.ndarray, "N n"], feedback: StateFeedback, observer: Observer
) -> float | None:
    """`max(0, ||xh[k]||_M - b[k]) / b[0]` over cases and samples: how far an estimate leaves what is certified.

    On the model from `x0`, `||xh||_M <= ||x||_M + kappa ||xh - x||_Q <= b[k] = d[k] + kappa r_o^k e[0]` with `d` the
    bound above and `kappa = ||M^{1/2} Q^{-1/2}||_2`, so the value is 0 there; `M` belongs to state and integrators,
    `Q` to the state. On a plant, whose state is not the model's, nothing is certified: the value says, as a share of
    the bound's start, how far noise and model error push the loop beyond the certificate. None if all cases start at 0.
    """
    d, e = distances(x0[:, None], x_hat[:, :1], feedback, observer)
    samples, factor = x_hat.shape[1], np.linalg.cholesky(feedback.p)
    decay = np.sqrt(1 - observer.rate) ** np.arange(samples)
    bound = certified_bound(d[:, 0], e[:, 0], samples, feedback, observer) + _kappa(feedback, observer) * e * decay
    measured = np.linalg.norm(solve_triangular(factor, x_hat.reshape(-1, len(factor)).T, lower=True), axis=0)
    beyond = measured.reshape(bound.shape) - bound * (1 + ROUNDING) - RESOLUTION * (d + e)
    moving = bound[:, 0] > 0
    return float(np.maximum(beyond[moving] / bound[moving, :1], 0.0).max()) if moving.any() else None


def _kappa(feedback: StateFeedback, observer: Observer) -> float:
    into_state = np.eye(len(feedback.p), len(observer.q))
    scaled = solve_triangular(np.linalg.cholesky(feedback.p), into_state, lower=True)
    return float(np.linalg.norm(solve_triangular(np.linalg.cholesky(observer.q), scaled.T, lower=True), 2))
