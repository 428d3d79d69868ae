"""Measured distance never exceeds the certified bound on the model; on a claim that is false, it
does."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import random_model

from ssm_study.certificates.certificate import Observer, StateFeedback
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.loop.certified_bound import (
    count_bound_violations,
    distance_bound,
    estimation_decay_rate,
    metric_distances,
    relative_bound_excess,
)
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant
from ssm_study.loop.rollout import Rollouts, simulate_closed_loop
from ssm_study.models.identified import SSM
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, JacobianBall

IDENTITY = JacobianBall(alpha=1.0, beta=0.0)


def certified(model: SSM) -> tuple[StateFeedback, Observer]:
    smallest = model.scaffold_in.slopes.min()
    lower = float(smallest)
    largest = model.scaffold_in.slopes.max()
    upper = float(largest)
    ball = JacobianBall.from_slopes(lower, upper)
    frontier = controller_frontier(model.linear, ball)
    limit = frontier.rate_limit
    rate = 0.9 * limit
    synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=0.5, input_weight=0.1)
    feedback = synthesis.state_feedback(model.linear, ball)
    observer = synthesis.observer(model.linear, IDENTITY)
    assert feedback.certified
    assert observer.certified
    return feedback, observer


def rollouts(model: SSM, feedback: StateFeedback, observer: Observer, seed: int) -> Rollouts:
    m = model.scale.inputs
    p = model.scale.outputs
    plant = IdentifiedPlant.from_model(model)
    gains = Gains(k=feedback.k, l=observer.l)
    controller = ObserverFeedback(model=model, gains=gains)
    rng = np.random.default_rng(seed)
    x0 = rng.standard_normal((20, model.order))
    output_equilibrium = model.scale.output_equilibrium
    reference = np.tile(output_equilibrium, (120, 1))
    noise = np.zeros((20, 120, p))
    disturbance = np.zeros((20, 120, m))
    bound = np.full(p, 1e6)
    return simulate_closed_loop(
        plant,
        controller,
        initial_states=x0,
        reference=reference,
        noise=noise,
        disturbance=disturbance,
        bound=bound,
    )


@pytest.mark.parametrize("seed", range(4))
def test_measured_is_within_certified(seed):
    inputs = 1 + seed % 2
    outputs = 1 + seed // 2 % 2
    order = 3 + seed % 4
    model = random_model(seed, inputs=inputs, outputs=outputs, order=order)
    feedback, observer = certified(model)
    run = rollouts(model, feedback, observer, seed)
    bound_violations = count_bound_violations(run.states, run.estimate, feedback, observer)
    assert bound_violations == 0
    d, e = metric_distances(run.states, run.estimate, feedback, observer)
    floor = 1e-12 * e[:, :1]  # of the start: below it, differences of two states are rounding
    decayed = observer.contraction_factor * e[:, :-1]
    upper_limit = decayed * (1 + 1e-9) + floor
    assert (e[:, 1:] <= upper_limit).all()
    largest = d[:, -1].max()
    upper_limit = 1e-3 * d[:, 0].max()
    assert largest < upper_limit


@pytest.mark.parametrize("seed", range(4))
def test_the_estimate_decays_at_least_as_certified_and_stays_within_its_bound(seed):
    inputs = 1 + seed % 2
    outputs = 1 + seed // 2 % 2
    order = 3 + seed % 4
    model = random_model(seed, inputs=inputs, outputs=outputs, order=order)
    feedback, observer = certified(model)
    run = rollouts(model, feedback, observer, seed)
    measured = estimation_decay_rate(run.states, run.estimate, feedback, observer)
    assert observer.rate * (1 - 1e-9) <= measured <= 1.0
    x0 = run.states[:, 0]
    assert relative_bound_excess(run.estimate, x0, feedback, observer) == 0.0


def test_decay_of_a_known_error_is_that_decay():
    """The error shrinks by 0.8 and 0.7 per sample, so the slowest case decays at `1 - 0.8^2`."""
    feedback, observer = certified(random_model(1))
    x = np.zeros((2, 200, 4))
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(4)
    factors = np.array([[0.8], [0.7]])
    shrink = factors ** np.arange(200)
    x_hat = shrink[:, :, None] * direction
    decay_rate = estimation_decay_rate(x, x_hat, feedback, observer)
    assert decay_rate == pytest.approx(1 - 0.64, rel=1e-9)
    assert estimation_decay_rate(x, x, feedback, observer) is None


def test_an_estimate_beyond_its_bound_is_measured_as_a_share_of_the_start():
    """The estimate's distance at sample 40 set to the bound there plus 0.3 of the bound's start."""
    model = random_model(3)
    feedback, observer = certified(model)
    run = rollouts(model, feedback, observer, 3)
    pushed = np.zeros_like(run.estimate)
    x0 = run.states[:, 0]
    x_hat = pushed[:, :1]
    start = run.states[:, :1]
    d, e = metric_distances(start, x_hat, feedback, observer)
    matrices = (feedback.p, observer.q)
    root_p, root_q = (np.linalg.cholesky(matrix) for matrix in matrices)
    inverse = np.linalg.inv(root_p)
    inverse_root = np.linalg.inv(root_q)
    kappa = np.linalg.norm(inverse @ inverse_root.T, 2)
    d0 = d[:, 0]
    e0 = e[:, 0]
    bound = distance_bound(d0, e0, 120, feedback, observer)
    decay = observer.contraction_factor ** np.arange(120)
    bound = bound + kappa * e * decay
    distance = bound[7, 40] + 0.3 * bound[7, 0]
    pushed[7, 40] = root_p[:, 0] * distance
    excess = relative_bound_excess(pushed, x0, feedback, observer)
    assert excess == pytest.approx(0.3, rel=1e-6)
    excess_from_rest = relative_bound_excess(pushed, np.zeros_like(x0), feedback, observer)
    assert excess_from_rest is None


def test_a_rate_that_is_not_certified_is_caught():
    model = random_model(2)
    feedback, observer = certified(model)
    run = rollouts(model, feedback, observer, 0)
    boast = replace(feedback, rate=0.9)
    boast_observer = replace(observer, rate=0.99)
    bound_violations = count_bound_violations(run.states, run.estimate, boast, boast_observer)
    assert bound_violations > 0
    decay_rate = estimation_decay_rate(run.states, run.estimate, feedback, observer)
    assert decay_rate < boast_observer.rate


def test_the_bound_is_the_sum_it_says():
    model = random_model(5)
    feedback, observer = certified(model)
    d0 = np.array([2.0])
    e0 = np.array([3.0])
    r_c = feedback.contraction_factor
    r_o = observer.contraction_factor
    inverse = np.linalg.inv(feedback.p)
    linear_b = model.linear.b
    root = np.linalg.cholesky(inverse)
    into = np.linalg.norm(root.T @ linear_b, 2)
    root_of_observer = np.linalg.cholesky(observer.q)
    inverse = np.linalg.inv(root_of_observer.T)
    out = np.linalg.norm(feedback.k @ inverse, 2)
    slopes = model.scaffold_in.slopes
    largest = float(slopes.max())
    c = largest * into * out
    k = 7
    injected = [r_c ** (k - 1 - i) * r_o**i for i in range(k)]
    expected = r_c**k * 2.0 + c * 3.0 * sum(injected)
    distances = distance_bound(d0, e0, 10, feedback, observer)
    assert distances[0, k] == pytest.approx(expected, rel=1e-9)
