"""Predictions of a design on the plant: the margin by frequency, and the controller by itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_cases import BALLS, flat, motor_design, motor_model

from ssm_study.bounds.frequency import frequency_response
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import BAND, Mismatch, measure_model_error
from ssm_study.robustness.prediction import (
    PEAK,
    output_peak_from_noise,
    predict_margins,
    worst_case_loop_gain,
)
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    ResponseCache,
    controller_spectral_radius,
    error_to_input_response,
    largest_singular_values,
    systems_at_constant_slopes,
)
from ssm_study.signals import Scale, Trajectory
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StateSpace

STEEP = JacobianBall(alpha=1.0, beta=0.0)
FLAT = JacobianBall(alpha=0.1, beta=0.0)
STEEP_AND_FLAT = (STEEP, FLAT)


UNIT_SLOPE = JacobianBall(alpha=1.0, beta=0.0)
ONES = JacobianBalls(input=UNIT_SLOPE, output=UNIT_SLOPE)


def linear_model(seed: int, order: int = 3) -> SSM:
    """A stable linear model in its own units: every statement below is exact for it."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    a *= rng.uniform(0.6, 0.95) / spectral_radius
    b = rng.standard_normal((order, 1))
    c = rng.standard_normal((1, order))
    d = rng.standard_normal((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    gain = np.eye(1)
    identity = LinearScaffold(gain=gain)
    return replace(
        motor_model(),
        linear=linear,
        scaffold_in=identity,
        scaffold_out=identity,
        scale=Scale.identity(1, 1),
        step_s=0.01,
    )


def recorded(model: SSM, taps: np.ndarray, samples: int = 4_000) -> Trajectory:
    """White input, and an output that misses the model by the finite impulse response `taps`."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((samples, 1))
    response = model.simulate(u)
    filtered_signal = scipy.signal.lfilter(taps, [1.0], u[:, 0])
    y = response + filtered_signal[:, None]
    return Trajectory(u=u, y=y, step_s=0.01)


def closed(model: SSM, k: np.ndarray, gain: np.ndarray, taps: np.ndarray) -> float:
    """Spectral radius of the loop of plant = model + taps, written out: states (x, past inputs,
    estimate)."""
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    d = model.linear.d
    n = len(a)
    t = len(taps) - 1
    shift = np.eye(t, k=-1)
    first = np.eye(t, 1)
    with_feedthrough = c + d @ k
    first_tap = d + taps[:1, None]
    injected = gain @ (with_feedthrough) - gain @ (first_tap) @ k
    plant_rows = [a, np.zeros((n, t)), b @ k]
    delay_rows = [np.zeros((t, n)), shift, first @ k]
    observer_rows = [-gain @ c, -gain @ taps[None, 1:], a + b @ k + injected]
    block_matrix = np.block([plant_rows, delay_rows, observer_rows])
    eigenvalues = np.linalg.eigvals(block_matrix)
    spectral_radius = np.abs(eigenvalues).max()
    return float(spectral_radius)


@settings(max_examples=8)
@given(st.integers(0, 10_000), st.floats(0.01, 3.0), st.integers(1, 6))
def test_a_linear_mismatch_with_resolved_margin_above_one_never_loses_the_loop(seed, size, length):
    """Small gain by frequency: `g(w) sigma_max(T_ue(w)) < 1` at all w keeps every linear mismatch
    of gain g(w)."""
    model = linear_model(seed)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    design = riccati_synthesis.design(model, ONES)
    k = design.state_feedback.k
    gain = design.observer.l
    rng = np.random.default_rng(seed)
    white_noise = rng.standard_normal(length + 1)
    taps = size * white_noise
    gains = Gains(k=k, l=gain)
    mismatch = measure_model_error(model, (recorded(model, taps),))
    found = predict_margins(model, gains, ONES, mismatch)
    if found.resolved_margin > 1.2:  # Welch's estimate is within some percent
        assert closed(model, k, gain, taps) < 1


@pytest.mark.parametrize("seed", range(5))
def test_a_flat_mismatch_has_the_same_margin_either_way(seed):
    model = linear_model(seed)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    design = riccati_synthesis.design(model, ONES)
    taps = np.array([0.0, 0.3])
    record = recorded(model, taps)
    mismatch = measure_model_error(model, (record,))
    found = predict_margins(model, design.gain_pair, ONES, mismatch)
    expected = pytest.approx(found.mismatch_margin, rel=0.1)
    assert found.resolved_margin == expected


@pytest.mark.parametrize("seed", range(3))
def test_what_pairs_share_changes_no_number(seed):
    """Two pairs one after the other, each with slopes and modes of its own, against each by
    itself."""
    model = linear_model(seed)
    shared = ResponseCache(angles=FINE_ANGLES)
    record = recorded(model, np.array([0.2, 0.3]))
    shown = measure_model_error(model, (record,))
    for rate in (0.1, 0.3):
        riccati_synthesis = RiccatiSynthesis(rate_controller=rate, rate_observer=rate)
        pair = riccati_synthesis.design(model, BALLS).gain_pair
        alone = worst_case_loop_gain(model, pair, BALLS, shown)
        shared_measure = worst_case_loop_gain(model, pair, BALLS, shown, shared)
        expected = pytest.approx(alone, rel=1e-9)
        assert shared_measure == expected
        half = alone / 2
        from_half = worst_case_loop_gain(model, pair, BALLS, shown, shared, stop_value=half)
        assert half <= from_half <= alone * (1 + 1e-9)
        assert 0 < alone < np.inf


def test_a_resonance_that_the_total_gain_averages_away_is_seen():
    """The record's mismatch sits in a tenth of the band, where the loop is most sensitive."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    angles = ANGLES
    pair = Gains(k=k, l=gain)
    ends = systems_at_constant_slopes(model.linear, pair, BALLS)
    loops = [error_to_input_response(*end) for end in ends]
    responses = [largest_singular_values(frequency_response(loop, FINE_ANGLES)) for loop in loops]
    largest = np.max(responses, axis=0)
    largests = [(near(w)(FINE_ANGLES) * largest).max() for w in angles]
    sensitive = np.array(largests)
    most_sensitive = angles[sensitive.argmax()]
    by_frequency = 0.1 + 0.9 * near(most_sensitive)(angles)
    shown = flat(by_frequency, 0.1)
    gains = Gains(k=k, l=gain)
    found = predict_margins(model, gains, BALLS, shown)
    expected = 0.1 * found.mismatch_margin
    assert found.resolved_margin == pytest.approx(expected, rel=0.05)


def near(centre: float):
    return lambda angles: np.clip(1 - np.abs(angles - centre) / 0.1, 0, 1)


@settings(max_examples=10)
@given(st.integers(0, 10_000))
def test_the_radius_is_the_growth_of_the_controller_alone(seed):
    """The plant held still: the controller's own memory grows or shrinks by the radius per
    sample."""
    model = linear_model(seed)
    rng = np.random.default_rng(seed)
    k = rng.standard_normal((1, 3))
    gain = rng.standard_normal((3, 1))
    gains = Gains(k=k, l=gain)
    law = ObserverFeedback(model=model, gains=gains)
    white_noise = rng.standard_normal((1, 3))
    memory = 1e-8 * white_noise
    still = np.zeros((1, 1))
    target = law.target_trajectory(still)[0]
    grown = []
    for _ in range(200):
        inputs = law.input(memory, still, target)
        following = law.next_memory(memory, inputs, still, target)
        norm = np.linalg.norm(following)
        growth = norm / np.linalg.norm(memory)
        grown.append(np.log(growth))
        norm = np.linalg.norm(memory)
        memory = following * norm / np.linalg.norm(following)
    pair = Gains(k=k, l=gain)
    radius = controller_spectral_radius(model.linear, pair, ONES)
    mean = np.mean(grown[100:])
    expected = np.log(radius)
    assert mean == pytest.approx(expected, abs=0.05)


def test_the_integrator_does_not_count():
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k[None]
    gain = design.observer.l[None]
    integral = np.full((1, 1, 1), 0.3)
    with_integral = np.concatenate([k, integral], axis=2)
    pair = Gains(k=with_integral, l=gain)
    gains = Gains(k=k, l=gain)
    with_integrator = controller_spectral_radius(model.linear, pair, BALLS)
    without_integrator = controller_spectral_radius(model.linear, gains, BALLS)
    assert with_integrator == without_integrator


def test_an_integrator_holds_where_the_plant_does():
    """Held by friction, the plant gives it no error: the view says nothing of it. A plant that
    answers does."""
    model = motor_model()
    state_feedback_k = motor_design().state_feedback.k
    integral_gain = [[-0.02]]
    k = np.hstack([state_feedback_k, integral_gain])
    observer_l = motor_design().observer.l
    pair = Gains(k=k, l=observer_l)
    ones = np.ones(len(ANGLES))
    large = ModelErrorAtAmplitude(
        amplitude=1.0, gain=0.01, by_frequency=0.01 * ones, linear=0j * ones, rest=0.01 * ones
    )
    linear = -1.02 * ones + 0j
    held = ModelErrorAtAmplitude(
        amplitude=0.1, gain=0.5, by_frequency=9 * ones, linear=linear, rest=0 * ones, response=0.01
    )
    mismatch = Mismatch(views=(large,))
    alone = worst_case_loop_gain(model, pair, BALLS, mismatch)
    views = Mismatch(views=(held, held, large))
    measure = worst_case_loop_gain(model, pair, BALLS, views)
    assert 0 < alone <= measure < 1
    answers = replace(held, response=0.5)
    views = (answers, large)
    mismatch = Mismatch(views=views)
    assert worst_case_loop_gain(model, pair, BALLS, mismatch) > 1


@pytest.mark.parametrize(("knee", "passes"), [(1.0, True), (0.3, False)])
def test_a_small_swing_does_not_meet_the_slope_at_the_limit(knee, passes):
    """Small records pass at slope 1 and not at 0.1, where S_u bends beyond or within half the
    amplitude."""
    breakpoints = np.array([[-knee, knee]])
    slopes = np.array([[0.1, 1.0, 0.1]])
    limit = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    model = replace(motor_model(), scaffold_in=limit)
    ball = limit.slope_bound().ball
    balls = replace(ONES, input=ball)
    pair = motor_design().gain_pair
    ones = np.ones(len(ANGLES))

    def seen(amplitude: float, gain: float) -> ModelErrorAtAmplitude:
        parts = {"by_frequency": gain * ones, "linear": 0j * ones, "rest": gain * ones}
        return ModelErrorAtAmplitude(amplitude=amplitude, gain=gain, **parts)

    alone = [
        worst_case_loop_gain(
            model, pair, replace(ONES, input=one), Mismatch(views=(seen(1.0, 1.0),))
        )
        for one in STEEP_AND_FLAT
    ]
    assert 1.2 * alone[0] < alone[1] < np.inf
    gain = 2 / sum(alone)  # between what the two slopes tolerate
    small = (seen(0.1, gain), seen(0.5, 0.0), seen(1.0, 0.0))
    mismatch = Mismatch(views=small)
    measure = worst_case_loop_gain(model, pair, balls, mismatch)
    assert (measure < 1) == passes
    large = (
        seen(0.1, 0.0),
        seen(0.5, gain),
        seen(1.0, 0.0),
    )  # the two largest count at every slope
    views = (seen(0.1, 0.0), seen(0.5, 0.0), seen(1.0, 0.0))
    loop = seen(0.1, gain)
    trial = Mismatch(views=views, loop=loop)
    views = (seen(0.1, gain), seen(1.0, 0.0))
    pair_alone = Mismatch(views=views)
    mismatches = (Mismatch(views=large), trial, pair_alone)
    smallest = min(worst_case_loop_gain(model, pair, balls, one) for one in mismatches)
    assert smallest > 1


@pytest.mark.parametrize(
    ("sigma", "held_up_to", "passes"),
    [(0.9, 0.0, True), (1.1, 0.0, False), (1.1, 2.0, False), (1.1, 4.0, True)],
)
def test_noise_beyond_the_band_refuses_a_loop(sigma, held_up_to, passes):
    """Input and output simulated: the loop's own equations, white noise. The plant holds still up
    to an amplitude.

    It is given in standard deviations of the input; a sinusoid with the peak of the noise has 4.5 /
    sqrt(2) of them.
    """
    model, pair, shown = noisy_loop(sigma, held_up_to)
    found = predict_margins(model, pair, ONES, shown)
    expected = 0.0 if held_up_to > 3 else sigma
    assert found.noise_peak == pytest.approx(expected, rel=0.02)
    assert found.predicts_stability() == passes
    assert np.isinf(found.resolved_margin)
    mismatch = replace(shown, farthest=1.2)
    assert output_peak_from_noise(model, pair, ONES, mismatch) < 1


@cache
def deviations_under_noise() -> tuple[float, float]:
    """Standard deviations of the input and the output of the loop under white noise of unit
    variance."""
    model = linear_model(3)
    moderate = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    pair = moderate.design(model, ONES).gain_pair
    loop = error_to_input_response(model.linear, pair, 1.0, 1.0)
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((200_000, 1))
    driven = loop.simulate(noise)[0]
    response = model.linear.simulate(driven)[0]
    return float(np.std(driven)), float(np.std(response))


def noisy_loop(sigma: float, held_up_to: float) -> tuple[SSM, Gains, Mismatch]:
    """A loop whose noise has `sigma` times the peak of the band, and a plant that holds still below
    `held_up_to` standard deviations of the input."""
    model = linear_model(3)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    pair = riccati_synthesis.design(model, ONES).gain_pair
    driving, moved = deviations_under_noise()
    strength = sigma * BAND / PEAK / moved
    spectrum = np.full(len(ANGLES), strength**2)
    noise = tuple(spectrum.tolist())
    none = 0 * ANGLES
    held, free = (held_up_to + more for more in (0.0, 0.5))
    views = [
        ModelErrorAtAmplitude(
            amplitude=at * strength * driving,
            gain=0.0,
            by_frequency=none,
            linear=0j * none,
            rest=none,
            response=r,
        )
        for at, r in ((held, 0.0), (free, 1.0))
    ]
    mismatch = Mismatch(views=tuple(views), noise=noise)
    return model, pair, mismatch


@pytest.mark.parametrize("held_up_to", [0.0, 4.0])
def test_the_noise_peak_counts_the_slope_of_the_input_map_once(held_up_to):
    model, pair, shown = noisy_loop(1.1, held_up_to)
    own = output_peak_from_noise(model, pair, ONES, shown)
    # twice the slope of S_u behind half of B and D is the same loop
    b = model.linear.b / 2
    d = model.linear.d / 2
    halved = replace(model.linear, b=b, d=d)
    gain = 2 * np.eye(1)
    scaffold_in = LinearScaffold(gain=gain)
    same = replace(model, linear=halved, scaffold_in=scaffold_in)
    jacobian_ball = JacobianBall(alpha=2.0, beta=0.0)
    steeper = replace(ONES, input=jacobian_ball)
    peak = output_peak_from_noise(same, pair, steeper, shown)
    assert peak == pytest.approx(own)
    gain = -0.5 * np.eye(1)
    scaffold_in = LinearScaffold(gain=gain)
    falling = replace(model, scaffold_in=scaffold_in)
    gain = 0.5 * np.eye(1)
    scaffold_in = LinearScaffold(gain=gain)
    rising = replace(model, scaffold_in=scaffold_in)
    alphas = (-0.5, 0.5)
    balls = [replace(ONES, input=JacobianBall(alpha=alpha, beta=0.4)) for alpha in alphas]
    turned = replace(pair, k=-pair.k)  # the same loop
    of_falling = output_peak_from_noise(falling, turned, balls[0], shown)
    of_rising = output_peak_from_noise(rising, pair, balls[1], shown)
    assert of_falling == of_rising
    # of a ball the slope at rest alone counts
    jacobian_ball = JacobianBall(alpha=0.5, beta=0.0)
    point = replace(ONES, input=jacobian_ball)
    of_ball = output_peak_from_noise(rising, pair, balls[1], shown)
    of_point = output_peak_from_noise(rising, pair, point, shown)
    assert of_ball == of_point
