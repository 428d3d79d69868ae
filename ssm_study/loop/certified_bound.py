"""Certified bound on the state of a closed loop with an observer, and its comparison with simulated
runs.

The experiment is that of docs/closed_loop.md. With `M = P^{-1}`, `d[k] = ||x[k]||_M` and `e[k] =
||xh[k] - x[k]||_Q`, Theorem 1 gives `d[k+1] <=
r_c d[k] + c e[k]` and Theorem 2 `e[k+1] <= r_o e[k]`. With limited inputs the certificate of
`theorems/limited_input.py` takes the state feedback's place. Source: [Z26] Lemma 1 and Theorem 3,
with the constant made explicit (`estimation_error_gain`).
"""

from itertools import product

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import Observer, StateFeedback
from ssm_study.certificates.theorems.structured_state_feedback import StructuredStateFeedback
from ssm_study.loop.motion import mean_squared_contraction

ROUNDING = 1e-9  # relative: what float64 may add to a distance over a thousand steps
RESOLUTION = 1e-12  # of the bound's own start: below it both sides are rounding
MOST_NEURONS = 10  # up to so many the corners of their slopes are tried, a thousand small norms
# of the estimate's first error: its decay is measured until there, far above rounding
FORGOTTEN = 1e-6
States = Float[np.ndarray, "N T n"]
Estimates = Float[np.ndarray, "N T s"]  # integrators are the columns beyond n
Distances = Float[np.ndarray, "N T"]
PerCase = Float[np.ndarray, "N"]
Columns = Float[np.ndarray, "n k"]


def transform_to_inverse_metric(
    inverse_metric: Float[np.ndarray, "n n"], vectors: Columns
) -> Columns:
    """Transform vectors so that the Euclidean norm of each equals the vector's norm in the inverse
    of a given metric.

    `R^{-1} columns` with `R R' = matrix`.
    """
    root = np.linalg.cholesky(inverse_metric)
    return scipy.linalg.solve_triangular(root, vectors, lower=True)


def metric_distances(
    states: States, estimates: Estimates, feedback: StateFeedback, observer: Observer
) -> tuple[Distances, Distances]:
    """Distance of the state from the equilibrium, and of the estimate from the state, in the
    metrics of the certificates.

    `||x||_M` with `M = P^{-1}` and `||xh - x||_Q`; integrators, the columns of `estimates` beyond
    n, belong to the first.
    """
    n = states.shape[2]
    estimated_states = estimates[:, :, :n]
    error = estimated_states - states
    root = np.linalg.cholesky(observer.q)
    e = np.linalg.norm(error @ root, axis=2)
    integrator_states = estimates[:, :, n:]
    states_and_integrators = [states, integrator_states]
    with_integrators = np.concatenate(states_and_integrators, axis=2)
    return _feedback_distances(with_integrators, feedback), e


def _feedback_distances(states: Estimates, feedback: StateFeedback) -> Distances:
    """Distances of states from the equilibrium in the metric of the state feedback, `P^{-1}`."""
    cases, samples, width = states.shape
    flat_rows = states.reshape(-1, width)
    columns = flat_rows.T
    transformed = transform_to_inverse_metric(feedback.p, columns)
    norms = np.linalg.norm(transformed, axis=0)
    return norms.reshape(cases, samples)


def distance_bound(
    initial_distances: PerCase,
    initial_errors: PerCase,
    sample_count: int,
    feedback: StateFeedback,
    observer: Observer,
) -> Distances:
    """Certified upper bound on the distance of the closed loop's state from the equilibrium at each
    sample.

    `r_c^k d[0] + c e[0] sum_{i<k} r_c^(k-1-i) r_o^i` for `k = 0 .. samples - 1`, with
    `r = sqrt(1 - rate)`.
    """
    c = estimation_error_gain(feedback, observer)
    cases = len(initial_distances)
    bound = np.empty((cases, sample_count))
    error = initial_errors
    bound[:, 0] = initial_distances
    for k in range(1, sample_count):
        previous_bound = bound[:, k - 1]
        contracted = feedback.contraction_factor * previous_bound
        bound[:, k] = contracted + c * error
        error = observer.contraction_factor * error
    return bound


def estimation_error_gain(feedback: StateFeedback, observer: Observer) -> float:
    """Gain from the estimation error to the distance of the next state from the equilibrium, in the
    metrics of the certificates.

    `c = nu max_S ||M^{1/2} (B + E S G)||_2 ||K_x Q^{-1/2}||_2`, `K_x` the columns of K that act on
    the estimate. S runs over the neurons' slopes: the norm is convex in them, so that the corners
    decide; above `MOST_NEURONS` it is bounded by `||M^{1/2} B||_2 + ||M^{1/2} E||_2 ||G||_2`.
    Source: docs/theory.md, "With neurons".
    """
    into = transform_to_inverse_metric(feedback.p, feedback.b)  # M^{1/2} B
    if not isinstance(feedback, StructuredStateFeedback):
        largest = np.linalg.norm(into, 2)
    elif len(feedback.g) > MOST_NEURONS:
        inner = transform_to_inverse_metric(feedback.p, feedback.e)
        into_neurons = np.linalg.norm(inner, 2)
        out_of_neurons = np.linalg.norm(feedback.g, 2)
        through_neurons = into_neurons * out_of_neurons
        direct_gain = np.linalg.norm(into, 2)
        largest = direct_gain + through_neurons
    else:
        inner = transform_to_inverse_metric(feedback.p, feedback.e)
        norms = []
        neuron_count = len(feedback.g)
        for slopes in product((0.0, 1.0), repeat=neuron_count):
            neuron_path = (inner * slopes) @ feedback.g
            at_corner = into + neuron_path
            norm = np.linalg.norm(at_corner, 2)
            norms.append(norm)
        largest = max(norms)
    order = len(observer.q)
    gain_on_estimate = feedback.k[:, :order]
    out = transform_to_inverse_metric(observer.q, gain_on_estimate.T)  # (K_x Q^{-1/2})^T
    slope = abs(feedback.alpha) + feedback.beta
    output_norm = np.linalg.norm(out, 2)
    gain = slope * float(largest) * output_norm
    return float(gain)


def count_bound_violations(
    states: States, estimates: Estimates, feedback: StateFeedback, observer: Observer
) -> int:
    """Number of samples at which the state's distance from the equilibrium exceeds its certified
    bound."""
    d, e = metric_distances(states, estimates, feedback, observer)
    samples = states.shape[1]
    first_distances = d[:, 0]
    first_errors = e[:, 0]
    bound = distance_bound(first_distances, first_errors, samples, feedback, observer)
    first_distance_column = d[:, :1]
    first_error_column = e[:, :1]
    floor = RESOLUTION * (first_distance_column + first_error_column)
    rounded_up = bound * (1 + ROUNDING) + floor
    is_violated = d > rounded_up
    return int(is_violated.sum())


def estimation_decay_rate(
    states: States, estimates: Estimates, feedback: StateFeedback, observer: Observer
) -> float | None:
    """Measured contraction rate `1 - r^2` of the observer's estimation error, in the simulation
    where the error decays most slowly.

    r is the mean shrink per sample of `e = ||xh - x||_Q` until it is below `FORGOTTEN` of its
    start; on the model `e[k+1] <= r_o e[k]`, so the rate is at least the certified
    `observer.rate`. Cases that do not get there are taken to the end; None if the estimate is exact
    from the start.
    """
    _, all_errors = metric_distances(states, estimates, feedback, observer)
    starts_wrong = all_errors[:, 0] > 0
    errors = all_errors[starts_wrong]
    if not len(errors):
        return None
    until = FORGOTTEN * errors[:, :1]
    shrinks = mean_squared_contraction(errors, until)
    return float(1.0 - shrinks.max())


def relative_bound_excess(
    estimates: Estimates,
    initial_states: Float[np.ndarray, "N n"],
    feedback: StateFeedback,
    observer: Observer,
) -> float | None:
    """Largest amount by which the estimated state's distance from the equilibrium exceeds its
    certified bound, relative to the initial bound.

    `max(0, ||xh[k]||_M - b[k]) / b[0]` over cases and samples. `b[k]` is the bound above plus
    `kappa r_o^k e[0]` (docs/closed_loop.md); on the model from `initial_states` the value is 0. `M`
    belongs to state and integrators, `Q` to the state. None if all cases start at 0.
    """
    first_state = initial_states[:, None]
    first_estimate = estimates[:, :1]
    d, e = metric_distances(first_state, first_estimate, feedback, observer)
    samples = estimates.shape[1]
    state_count = len(feedback.p)
    estimate_count = len(observer.q)
    into_state = np.eye(state_count, estimate_count)
    state_columns = transform_to_inverse_metric(feedback.p, into_state)
    error_to_state = transform_to_inverse_metric(observer.q, state_columns.T)
    largest_gain = np.linalg.norm(error_to_state, 2)
    kappa = float(largest_gain)
    exponents = np.arange(samples)
    decay = observer.contraction_factor**exponents
    fading_error = kappa * e * decay
    first_distances = d[:, 0]
    first_errors = e[:, 0]
    state_bound = distance_bound(first_distances, first_errors, samples, feedback, observer)
    bound = state_bound + fading_error
    distance = _feedback_distances(estimates, feedback)
    floor = RESOLUTION * (d + e)
    rounded_bound = bound * (1 + ROUNDING)
    beyond = distance - rounded_bound - floor
    is_moving = bound[:, 0] > 0
    if not is_moving.any():
        return None
    first_bounds = bound[is_moving, :1]
    shares = beyond[is_moving] / first_bounds
    positive_shares = np.maximum(shares, 0.0)
    return float(positive_shares.max())
