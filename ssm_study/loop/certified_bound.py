"""The certified bound of the output feedback, sample by sample, and what it says when the input is limited.

With `M = P^{-1}`, `d[k] = ||x[k]||_M` and `e[k] = ||xh[k] - x[k]||_Q`, Theorem 1 gives `d[k+1] <= r_c d[k] + c e[k]`
and Theorem 2 `e[k+1] <= r_o e[k]`, so

    d[k] <= r_c^k d[0] + c e[0] sum_{i<k} r_c^(k-1-i) r_o^i,        c = nu ||M^{1/2} B||_2 ||K Q^{-1/2}||_2,

`r = sqrt(1 - rate)` and `nu` the largest slope of `S_u`: the input that the estimate's error adds is at most
`nu ||K (xh - x)||`. With neurons it also acts through them, see `input_gain`. Source: [Z26] Lemma 1 and Theorem 3,
with the constant made explicit.

**Inside, the estimate at the equilibrium.** While `|k_i xh| <= l_i` no limit acts, so all this holds, and

    |k_i xh| <= kappa_i d + eta_i e,      kappa_i = sqrt(k_i P k_i'),  eta_i = sqrt(k_xi Q^{-1} k_xi').

If the right-hand side, along the bound from `(d_0, e_0)`, stays at or below `l_i` for every sample, then by induction
no limit ever acts and the full rates hold. It is linear in the start, so the largest set of starts is a scaled one.
An estimate that starts exact, and every start: `theorems/unlimited_start.py`, `theorems/limited_input.py`.
Source: [Z26] Theorems 1 to 3; THEORY section 8.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.synthesis.certificate import Design, Observer, StateFeedback
from ssm_study.synthesis.deployed import EVERYWHERE, SETS, outputs_of, with_limits
from ssm_study.synthesis.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.synthesis.theorems.structured_state_feedback import StructuredStateFeedback

ROUNDING = 1e-9  # relative: what float64 may add to a distance over a thousand steps
RESOLUTION = 1e-12  # of the bound's own start: below it both sides are rounding
MOST_NEURONS = 10  # up to so many the corners of their slopes are tried, a thousand small norms
FORGOTTEN = 1e-6  # of the estimate's first error: its decay is measured until there, far above rounding
PEAK_PASSED = 1e-9  # of the start: a bound that has shrunk to it stays below its peak
States = Float[np.ndarray, "N T n"]
Estimates = Float[np.ndarray, "N T s"]  # integrators are the columns beyond n


def rooted(matrix: Float[np.ndarray, "n n"], columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """`R^{-1} columns` with `R R' = matrix`: column norms are those in the metric `matrix^{-1}`."""
    return scipy.linalg.solve_triangular(np.linalg.cholesky(matrix), columns, lower=True)


def distances(
    x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer
) -> tuple[Float[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """`||x||_M` with `M = P^{-1}` and `||xh - x||_Q`; integrators, the columns of `x_hat` beyond n, belong to both."""
    n = x.shape[2]
    e = np.linalg.norm((x_hat[:, :, :n] - x) @ np.linalg.cholesky(observer.q), axis=2)
    return _in_metric(np.concatenate([x, x_hat[:, :, n:]], axis=2), feedback), e


def _in_metric(rows: Estimates, feedback: StateFeedback) -> Float[np.ndarray, "N T"]:
    flat = rooted(feedback.p, rows.reshape(-1, rows.shape[2]).T)
    return np.linalg.norm(flat, axis=0).reshape(rows.shape[:2])


def certified_bound(
    d0: Float[np.ndarray, "N"], e0: Float[np.ndarray, "N"], samples: int, feedback: StateFeedback, observer: Observer
) -> Float[np.ndarray, "N T"]:
    """The right-hand side above for `k = 0 .. samples - 1`."""
    c, bound, error = input_gain(feedback, observer), np.empty((len(d0), samples)), e0
    for k in range(samples):
        bound[:, k] = d0 if k == 0 else feedback.contraction * bound[:, k - 1] + c * error
        error = error if k == 0 else observer.contraction * error
    return bound


def input_gain(feedback: StateFeedback, observer: Observer) -> float:
    """`c = nu max_S ||M^{1/2} (B + E S G)||_2 ||K_x Q^{-1/2}||_2`, `K_x` the columns of K that act on the estimate.

    S runs over the neurons' slopes: the norm is convex in them, so that the corners decide; above `MOST_NEURONS` it is
    bounded by `||M^{1/2} B||_2 + ||M^{1/2} E||_2 ||G||_2`. Source: THEORY section 6.
    """
    into = rooted(feedback.p, feedback.b)  # M^{1/2} B
    if not isinstance(feedback, StructuredStateFeedback):
        largest = np.linalg.norm(into, 2)
    elif len(feedback.g) > MOST_NEURONS:
        through = np.linalg.norm(rooted(feedback.p, feedback.e), 2) * np.linalg.norm(feedback.g, 2)
        largest = np.linalg.norm(into, 2) + through
    else:
        inner, corners = rooted(feedback.p, feedback.e), product((0.0, 1.0), repeat=len(feedback.g))
        largest = max(np.linalg.norm(into + (inner * slopes) @ feedback.g, 2) for slopes in corners)
    out = rooted(observer.q, feedback.k[:, : len(observer.q)].T)  # (K_x Q^{-1/2})^T
    return float((abs(feedback.alpha) + feedback.beta) * float(largest) * np.linalg.norm(out, 2))


def violations(x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer) -> int:
    """Samples, over all cases, whose measured distance exceeds the bound by more than rounding."""
    d, e = distances(x, x_hat, feedback, observer)
    bound = certified_bound(d[:, 0], e[:, 0], x.shape[1], feedback, observer)
    floor = RESOLUTION * (d[:, :1] + e[:, :1])
    return int((d > bound * (1 + ROUNDING) + floor).sum())


def decay_rate(x: States, x_hat: Estimates, feedback: StateFeedback, observer: Observer) -> float | None:
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


def excess(x_hat: Estimates, x0: Float[np.ndarray, "N n"], feedback: StateFeedback, observer: Observer) -> float | None:
    """`max(0, ||xh[k]||_M - b[k]) / b[0]` over cases and samples: how far an estimate leaves what is certified.

    On the model from `x0`, `||xh||_M <= ||x||_M + kappa ||xh - x||_Q <= b[k] = d[k] + kappa r_o^k e[0]` with `d` the
    bound above and `kappa = ||M^{1/2} Q^{-1/2}||_2`, so the value is 0 there; `M` belongs to state and integrators,
    `Q` to the state. On a plant, whose state is not the model's, nothing is certified: the value says, as a share of
    the bound's start, how far noise and model error push the loop beyond the certificate. None if all cases start at 0.
    """
    d, e = distances(x0[:, None], x_hat[:, :1], feedback, observer)
    samples, into_state = x_hat.shape[1], np.eye(len(feedback.p), len(observer.q))
    kappa = float(np.linalg.norm(rooted(observer.q, rooted(feedback.p, into_state).T), 2))
    faded = kappa * e * observer.contraction ** np.arange(samples)
    bound = certified_bound(d[:, 0], e[:, 0], samples, feedback, observer) + faded
    beyond = _in_metric(x_hat, feedback) - bound * (1 + ROUNDING) - RESOLUTION * (d + e)
    moving = bound[:, 0] > 0
    return float(np.maximum(beyond[moving] / bound[moving, :1], 0.0).max()) if moving.any() else None


@dataclass(frozen=True, kw_only=True)
class WithinLimits:
    """`lower, upper (p,)`: plants at rest at outputs between them start inside the set, physical units.

    `everywhere` is the certificate of the saturated state feedback from any start, None where none is proved.
    """

    lower: Float[np.ndarray, "p"]
    upper: Float[np.ndarray, "p"]
    everywhere: StateFeedbackOfBall | None


def within_limits(
    model: SSM, design: Design, lower: Float[np.ndarray, "m"], upper: Float[np.ndarray, "m"], *, informed: bool
) -> WithinLimits:
    """Both statements for input limits in physical units; `informed`: the estimate starts at rest at the measurement.

    Otherwise it starts at the equilibrium. Raises `BadRequest` where the equilibrium's input is not inside the limits,
    for an infeasible design, for neurons, or for several outputs behind a nonlinear S_y.
    """
    (feedback, observer), scale, outward = design.parts(), model.scale, model.scaffold_out
    room = np.minimum(upper - scale.input_equilibrium, scale.input_equilibrium - lower)
    limits, problem = (lower.tolist(), upper.tolist()), "do not enclose the input at rest"
    require(bool((room > 0).all()), "input limits", limits, problem, "widen them or choose another operating point")
    single, told = outward.inputs == 1 or outward.kind == "linear", "the range of several outputs needs a linear map"
    require(single, "model.scaffold_out", outward.kind, told, "use scaffold@model.scaffold_out=linear")
    parts = with_limits(model, design, lower, upper)
    problem = "no metric proves a range within the limits"
    require(SETS in parts, "input limits", limits, problem, "use model=ssm, or another synthesis")
    starts = parts[SETS].starts
    if not informed:
        corners = starts / np.abs(model.linear.c @ starts[: model.order]).max()
        starts = corners * float((room / scale.input_scale / _peaks(model, corners, feedback, observer)).min())
        starts /= 1 + ROUNDING
    low, high = outputs_of(model, starts)
    return WithinLimits(lower=low, upper=high, everywhere=parts.get(EVERYWHERE))


def _peaks(
    model: SSM, corners: Float[np.ndarray, "s j"], feedback: StateFeedback, observer: Observer
) -> Float[np.ndarray, "m"]:
    """The largest `kappa_i d + eta_i e` along the bound, from the corners and an estimate at the equilibrium."""
    n = model.order
    d0 = np.linalg.norm(rooted(feedback.p, corners), axis=0)
    e0 = np.linalg.norm(corners[:n].T @ np.linalg.cholesky(observer.q), axis=1)
    samples = 2 + int(np.ceil(np.log(PEAK_PASSED) / np.log(max(feedback.contraction, observer.contraction))))
    d = certified_bound(np.array([d0.max()]), np.array([e0.max()]), samples, feedback, observer)[0]
    e = e0.max() * observer.contraction ** np.arange(samples)
    kappa = np.sqrt(np.einsum("ij,jk,ik->i", feedback.k, feedback.p, feedback.k))  # |k_i x| <= kappa_i ||x||_M
    eta = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(observer.q), feedback.k[:, :n].T), axis=0)
    return (kappa[:, None] * d + eta[:, None] * e).max(axis=1)
