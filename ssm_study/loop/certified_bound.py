"""The certified bound of the output feedback, sample by sample: docs/closed_loop.md, "The
experiment".

With `M = P^{-1}`, `d[k] = ||x[k]||_M` and `e[k] = ||xh[k] - x[k]||_Q`, Theorem 1 gives `d[k+1] <=
r_c d[k] + c e[k]` and Theorem 2 `e[k+1] <= r_o e[k]`. With limited inputs the certificate of
`theorems/limited_input.py` takes the state feedback's place. Source: [Z26] Lemma 1 and Theorem 3,
with the constant made explicit (`input_gain`).
"""

from itertools import product

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import Observer, StateFeedback
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.loop.rollout import squared_shrink

ROUNDING = 1e-9  # relative: what float64 may add to a distance over a thousand steps
RESOLUTION = 1e-12  # of the bound's own start: below it both sides are rounding
MOST_NEURONS = 10  # up to so many the corners of their slopes are tried, a thousand small norms
FORGOTTEN = (
    1e-6  # of the estimate's first error: its decay is measured until there, far above rounding
)
States = Float[np.ndarray, "N T n"]
Estimates = Float[np.ndarray, "N T s"]  # integrators are the columns beyond n


def rooted(
    matrix: Float[np.ndarray, "n n"], columns: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "n k"]:
    """`R^{-1} columns` with `R R' = matrix`: column norms are those in the metric `matrix^{-1}`."""
    return scipy.linalg.solve_triangular(np.linalg.cholesky(matrix), columns, lower=True)


def distances(
    x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer
) -> tuple[Float[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """`||x||_M` with `M = P^{-1}` and `||xh - x||_Q`; integrators, the columns of `x_hat` beyond n,
    belong to both."""
    n = x.shape[2]
    e = np.linalg.norm((x_hat[:, :, :n] - x) @ np.linalg.cholesky(observer.q), axis=2)
    return _in_metric(np.concatenate([x, x_hat[:, :, n:]], axis=2), feedback), e


def _in_metric(rows: Estimates, feedback: StateFeedback) -> Float[np.ndarray, "N T"]:
    flat = rooted(feedback.p, rows.reshape(-1, rows.shape[2]).T)
    return np.linalg.norm(flat, axis=0).reshape(rows.shape[:2])


def certified_bound(
    d0: Float[np.ndarray, "N"],
    e0: Float[np.ndarray, "N"],
    samples: int,
    feedback: StateFeedback,
    observer: Observer,
) -> Float[np.ndarray, "N T"]:
    """`r_c^k d[0] + c e[0] sum_{i<k} r_c^(k-1-i) r_o^i` for `k = 0 .. samples - 1`, `r = sqrt(1 -
    rate)`."""
    c = input_gain(feedback, observer)
    bound = np.empty((len(d0), samples))
    error = e0
    bound[:, 0] = d0
    for k in range(1, samples):
        bound[:, k] = feedback.contraction * bound[:, k - 1] + c * error
        error = observer.contraction * error
    return bound


def input_gain(feedback: StateFeedback, observer: Observer) -> float:
    """`c = nu max_S ||M^{1/2} (B + E S G)||_2 ||K_x Q^{-1/2}||_2`, `K_x` the columns of K that act
    on the estimate.

    S runs over the neurons' slopes: the norm is convex in them, so that the corners decide; above
    `MOST_NEURONS` it is bounded by `||M^{1/2} B||_2 + ||M^{1/2} E||_2 ||G||_2`. Source:
    docs/theory.md, "With neurons".
    """
    into = rooted(feedback.p, feedback.b)  # M^{1/2} B
    if not isinstance(feedback, StructuredStateFeedback):
        largest = np.linalg.norm(into, 2)
    elif len(feedback.g) > MOST_NEURONS:
        through = np.linalg.norm(rooted(feedback.p, feedback.e), 2) * np.linalg.norm(feedback.g, 2)
        largest = np.linalg.norm(into, 2) + through
    else:
        inner = rooted(feedback.p, feedback.e)
        corners = product((0.0, 1.0), repeat=len(feedback.g))
        largest = max(np.linalg.norm(into + (inner * slopes) @ feedback.g, 2) for slopes in corners)
    out = rooted(observer.q, feedback.k[:, : len(observer.q)].T)  # (K_x Q^{-1/2})^T
    return float((abs(feedback.alpha) + feedback.beta) * float(largest) * np.linalg.norm(out, 2))


def violations(x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer) -> int:
    """Samples, over all cases, whose measured distance exceeds the bound by more than rounding."""
    d, e = distances(x, x_hat, feedback, observer)
    bound = certified_bound(d[:, 0], e[:, 0], x.shape[1], feedback, observer)
    floor = RESOLUTION * (d[:, :1] + e[:, :1])
    return int((d > bound * (1 + ROUNDING) + floor).sum())


def decay_rate(
    x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer
) -> float | None:
    """`1 - r^2`, r the mean shrink per sample of `e = ||xh - x||_Q` until it is below `FORGOTTEN`
    of its start.

    The slowest case; on the model `e[k+1] <= r_o e[k]`, so it is at least the certified
    `observer.rate`. Cases that do not get there are taken to the end; None if the estimate is exact
    from the start.
    """
    e = distances(x, x_hat, feedback, observer)[1]
    e = e[e[:, 0] > 0]
    return float(1.0 - squared_shrink(e, FORGOTTEN * e[:, :1]).max()) if len(e) else None


def excess(
    x_hat: Estimates, x0: Float[np.ndarray, "N n"], feedback: StateFeedback, observer: Observer
) -> float | None:
    """`max(0, ||xh[k]||_M - b[k]) / b[0]` over cases and samples: how far an estimate leaves what
    is certified.

    `b[k]` is the bound above plus `kappa r_o^k e[0]` (docs/closed_loop.md); on the model from `x0`
    the value is 0. `M` belongs to state and integrators, `Q` to the state. None if all cases start
    at 0.
    """
    d, e = distances(x0[:, None], x_hat[:, :1], feedback, observer)
    samples = x_hat.shape[1]
    into_state = np.eye(len(feedback.p), len(observer.q))
    kappa = float(np.linalg.norm(rooted(observer.q, rooted(feedback.p, into_state).T), 2))
    faded = kappa * e * observer.contraction ** np.arange(samples)
    bound = certified_bound(d[:, 0], e[:, 0], samples, feedback, observer) + faded
    beyond = _in_metric(x_hat, feedback) - bound * (1 + ROUNDING) - RESOLUTION * (d + e)
    moving = bound[:, 0] > 0
    return (
        float(np.maximum(beyond[moving] / bound[moving, :1], 0.0).max()) if moving.any() else None
    )
