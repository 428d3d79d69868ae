"""A record that starts anywhere: the estimated state replays it; a record that starts at rest stays
as it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from ssm_study.models.identified import SSM
from ssm_study.models.metrics import estimate_initial_state, reachability_gramian, simulate_record
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.signals import Scale, Trajectory, fit_percent
from ssm_study.systems import StateSpace


@pytest.fixture
def model() -> SSM:
    a = np.array([[0.95, 0.1], [0.0, 0.8]])
    b = np.array([[0.0], [0.3]])
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    linear_scaffold_gain = np.array([[0.7]])
    gain = LinearScaffold(gain=linear_scaffold_gain)
    input_scale = np.array([2.0])
    output_scale = np.array([3.0])
    scales = {"input_scale": input_scale, "output_scale": output_scale}
    input_equilibrium = np.array([1.0])
    output_equilibrium = np.array([-4.0])
    scale = Scale(
        **scales, input_equilibrium=input_equilibrium, output_equilibrium=output_equilibrium
    )
    return SSM(linear=linear, scaffold_in=gain, scaffold_out=gain, step_s=0.1, scale=scale)


def record(model: SSM, x0: np.ndarray, noise: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(0)
    levels = rng.uniform(-2, 2, (40, 1))
    u = 1.0 + np.repeat(levels, 5, axis=0)
    y = model.simulate(u, x0)
    white_noise = rng.standard_normal(y.shape)
    return Trajectory(u=u, y=y + noise * white_noise, step_s=0.1)


def test_the_state_is_found_from_the_samples_that_are_not_scored(model: SSM) -> None:
    """Without noise what is left of the unknown start after the start-up samples is a few percent
    of it."""
    x0 = np.array([1.5, -0.4])
    seen = record(model, x0)
    simulated = simulate_record(model, seen, 20)
    difference = np.abs(simulated - seen.y)
    left = difference[20:].max()
    response = model.simulate(seen.u)
    difference = np.abs(response - seen.y)
    largest = difference[20:].max()
    upper_limit = 0.05 * largest
    assert left < upper_limit
    first_state = estimate_initial_state(model, seen, 20)[0]
    difference = abs(first_state - 1.5)
    assert difference < 0.1


def test_noise_is_not_taken_for_a_state(model: SSM) -> None:
    x0 = np.array([1.5, -0.4])
    seen = record(model, x0, noise=0.05)
    simulated = simulate_record(model, seen, 20)
    estimated = fit_percent(seen.y, simulated, 20)
    response = model.simulate(seen.u)
    percent = fit_percent(seen.y, response, 20)
    lower_limit = percent + 5
    assert estimated > lower_limit


def test_without_start_up_samples_every_sample_is_predicted_from_rest(model: SSM) -> None:
    x0 = np.array([1.5, -0.4])
    seen = record(model, x0)
    simulated = simulate_record(model, seen, 0)
    assert np.array_equal(simulated, model.simulate(seen.u))


def test_a_state_the_input_never_reaches_is_not_invented(model: SSM) -> None:
    """With no input the reachability Gramian is zero: nothing but rest is believed."""
    u = np.ones((50, 1))
    y = np.full((50, 1), 5.0)
    still = Trajectory(u=u, y=y, step_s=0.1)
    estimated = estimate_initial_state(model, still, 10)
    largest = np.abs(estimated).max()
    assert largest < 1e-12


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_unstable_model_of_which_numbers_overflow_starts_at_rest(model: SSM) -> None:
    x0 = np.array([1.5, -0.4])
    seen = record(model, x0)
    unstable_part = replace(model.linear, a=1e3 * model.linear.a)
    unstable = model.with_linear_part(unstable_part)
    estimated = estimate_initial_state(unstable, seen, 200)
    assert np.array_equal(estimated, np.zeros(2))
    assert estimate_initial_state(model, seen, 200).any()


def test_the_gramian_of_a_record_is_the_sum_over_it() -> None:
    """For a fast system the Lyapunov solution; with a mode on the unit circle still finite, and the
    plain sum."""
    rng = np.random.default_rng(3)
    white_noise = rng.standard_normal((3, 3))
    modes = np.diag([0.8, -0.5, 0.2])
    fast = modes + 0.02 * white_noise
    b = rng.standard_normal((3, 2))
    actual = reachability_gramian(fast, b, 4000)
    expected = solve_discrete_lyapunov(fast, b @ b.T)
    np.testing.assert_allclose(actual, expected, rtol=1e-9)
    slow = np.diag([1.0, 0.99, 0.5])
    total = np.zeros((3, 3))
    reached = b
    for _ in range(128):
        total = total + reached @ reached.T
        reached = slow @ reached
    actual = reachability_gramian(slow, b, 100)
    np.testing.assert_allclose(actual, total, rtol=1e-9)
