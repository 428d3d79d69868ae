"""The mismatch margin by two routes, and the H-infinity norm against what is known exactly."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import BALLS, INPUT_BALL, flat, motor_design, motor_model, motor_record

from ssm_study.bounds.frequency import hinf_norm, largest_gains
from ssm_study.refusal import BadRequest
from ssm_study.robustness.bands import ANGLES as BANDS
from ssm_study.robustness.bands import band_means, line_powers, safe_ratio
from ssm_study.robustness.mismatch import Mismatch, measure_model_error
from ssm_study.robustness.prediction import Prediction, predict_margins
from ssm_study.robustness.sensitivity import (
    control_sensitivity_peak,
    error_to_input_response,
    gain_peaks_on_grid,
)
from ssm_study.signals import Trajectory
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StateSpace

# A mode of radius 0.999 is 0.001 wide: half a step of 0.0004 beside its peak, the gain is 2 %
# lower.
EVEN_ANGLES = np.linspace(0, np.pi, 8001)
LOW_ANGLES = np.geomspace(1e-5, np.pi, 2000)
ANGLES = np.concatenate([EVEN_ANGLES, LOW_ANGLES])


def test_a_band_without_any_power_has_an_unbounded_gain() -> None:
    half_period = np.ones(32)
    square_wave = np.tile(np.concatenate([half_period, -half_period]), 8)[:, None]
    power = band_means(line_powers(np.fft.rfft(square_wave, axis=0)))
    assert (power == 0.0).any(), "an exact square wave has no even harmonics, not even rounding"
    gains = np.sqrt(safe_ratio(np.full(len(power), 1e-6), power))
    assert gains.max() > 1e149
    assert gains[power > 0].max() < 1.0


def one_mode(pole: float) -> StateSpace:
    """`x+ = pole x + u`, `y = x`."""
    one = np.ones((1, 1))
    a = pole * one
    no_feedthrough = 0.0 * one
    return StateSpace(a=a, b=one, c=one, d=no_feedthrough)


POLE = st.floats(-0.999, 0.999)


@given(POLE)
def test_first_order_peak_is_known(pole):
    system = one_mode(pole)
    expected = 1 / (1 - abs(pole))
    norm = hinf_norm(system)
    assert norm == pytest.approx(expected, rel=1e-7)


def make_single_output(a: np.ndarray, b: list[float], c: list[float]) -> StateSpace:
    """One input and one output, without feedthrough."""
    column = np.array(b)[:, None]
    row = np.array([c])
    return StateSpace(a=a, b=column, c=row, d=np.zeros((1, 1)))


def draw_state_matrix(rng: np.random.Generator, order: int) -> np.ndarray:
    """A random matrix of spectral radius one."""
    a = rng.standard_normal((order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    return a / spectral_radius


@given(st.floats(0.5, 0.9999), st.floats(0.05, 3.0))
def test_resonance_is_found(radius, angle):
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = [cosine, sine]
    second_row = [-sine, cosine]
    turn = radius * np.array([first_row, second_row])
    system = make_single_output(turn, [1.0, 0.3], [0.5, 1.0])
    around = np.linspace(-1, 1, 20001)
    width = 20 * (1 - radius)
    angles = np.concatenate([angle + width * around, ANGLES])
    reference = largest_gains(system, angles).max()
    norm = hinf_norm(system)
    assert norm == pytest.approx(reference, rel=1e-6)


SEED = st.integers(0, 10_000)
ORDER = st.integers(1, 10)
CHANNELS = st.integers(1, 3)


@given(SEED, ORDER, CHANNELS, CHANNELS, st.booleans())
def test_no_frequency_exceeds_the_norm(seed, n, m, p, feedthrough):
    rng = np.random.default_rng(seed)
    a = draw_state_matrix(rng, n)
    a *= rng.choice([0.3, 0.9, 0.99, 0.999])
    b = rng.standard_normal((n, m))
    c = rng.standard_normal((p, n))
    d = np.zeros((p, m))
    if feedthrough:
        d = rng.standard_normal((p, m))
    system = StateSpace(a=a, b=b, c=c, d=d)
    on_grid = largest_gains(system, ANGLES).max()
    norm = hinf_norm(system)
    assert on_grid <= norm * (1 + 1e-9)
    assert norm <= on_grid * 1.05


def test_the_norm_agrees_with_python_control():
    control = pytest.importorskip("control")
    rng = np.random.default_rng(1)
    for _ in range(10):
        a = 0.95 * draw_state_matrix(rng, 5)
        b = rng.standard_normal((5, 2))
        c = rng.standard_normal((2, 5))
        d = np.zeros((2, 2))
        system_of_control = control.ss(a, b, c, d, True)
        theirs = control.system_norm(system_of_control, "inf", tol=1e-8)
        norm = hinf_norm(StateSpace(a=a, b=b, c=c, d=d))
        assert norm == pytest.approx(theirs, rel=1e-5)


def test_an_unstable_system_has_no_finite_norm():
    system = one_mode(1.01)
    assert hinf_norm(system) == np.inf


def test_the_peak_by_state_space_and_by_factors():
    design = motor_design()
    model = motor_model()
    k = design.state_feedback.k
    gain = design.observer.l
    pair = Gains(k=k, l=gain)
    exact = control_sensitivity_peak(model.linear, pair, BALLS)
    even_angles = np.linspace(1e-4, np.pi, 5000)
    angles = np.concatenate([ANGLES[1:], even_angles])
    peaks = gain_peaks_on_grid(model.linear, k[None], gain[None], BALLS, angles)
    grid = peaks[0, 0]
    assert grid <= exact * (1 + 1e-9)
    assert grid == pytest.approx(exact, rel=1e-4)


def test_the_factors_agree_with_the_state_space_for_several_channels():
    rng = np.random.default_rng(2)
    a = 0.5 * draw_state_matrix(rng, 4)
    b = rng.standard_normal((4, 2))
    c = rng.standard_normal((3, 4))
    d = np.zeros((3, 2))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    white_noise = rng.standard_normal((2, 4))
    k = 0.05 * white_noise
    white_noise = rng.standard_normal((4, 3))
    gain = 0.05 * white_noise
    jacobian_ball = JacobianBall.from_slopes(0.4, 1.0)
    output = JacobianBall.from_slopes(0.8, 1.1)
    balls = JacobianBalls(input=jacobian_ball, output=output)
    angles = np.linspace(0.01, np.pi, 50)
    pair = Gains(k=k, l=gain)
    gains = []
    for input_slope, output_slope in product((0.4, 0.7, 1.0), (0.8, 0.95, 1.1)):
        loop = error_to_input_response(linear, pair, input_slope, output_slope)
        gains.append(largest_gains(loop, angles).max())
    by_space = max(gains)
    peaks = gain_peaks_on_grid(linear, k[None], gain[None], balls, angles)
    peak = peaks[0, 0]
    assert peak == pytest.approx(by_space, rel=1e-9)


def test_the_sensitivity_is_the_loops_own_response_to_output_error():
    """Time domain: the loop written out with a sine added to the output answers with the gain of
    T_ue."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    angle = 0.4
    linear = model.linear
    driven = linear.b[:, 0] * INPUT_BALL.alpha
    x = np.zeros(2)
    x_hat = np.zeros(2)
    inputs = []
    for sample in range(3000):
        u = float((k @ x_hat)[0])
        inputs.append(u)
        sine = np.sin(angle * sample)
        y = linear.c @ x + sine
        applied = driven * u
        x = linear.a @ x + applied
        difference = linear.c @ x_hat - y
        x_hat = linear.a @ x_hat + applied + gain @ difference
    phases = angle * np.arange(1500)
    rotation = np.exp(-1j * phases)
    last_inputs = np.array(inputs[-1500:])
    component = last_inputs @ rotation
    amplitude = np.abs(component) * 2 / 1500
    pair = Gains(k=k, l=gain)
    state_space = error_to_input_response(linear, pair, INPUT_BALL.alpha, 1.0)
    angles = np.array([angle])
    expected = largest_gains(state_space, angles)[0]
    assert amplitude == pytest.approx(expected, rel=0.01)


def test_the_gain_is_the_ratio_of_what_the_record_shows():
    model = motor_model()
    record = motor_record()
    response = model.simulate(record.u)
    difference = record.y - response
    error = difference / 5.0
    mismatch = measure_model_error(model, (record,))
    gain = mismatch.gain
    error_norm = np.linalg.norm(error)
    input_norm = np.linalg.norm(record.u / 1.7)
    expected = error_norm / input_norm
    assert gain == pytest.approx(expected)
    mismatch = measure_model_error(model, (record, record))
    gain = mismatch.gain
    mismatch = measure_model_error(model, (record,))
    expected = mismatch.gain
    assert gain == pytest.approx(expected)
    y = model.simulate(record.u)
    own = Trajectory(u=record.u, y=y, step_s=0.01)
    mismatch = measure_model_error(model, (own,))
    gain = mismatch.gain
    assert gain == 0.0


def test_a_loop_that_is_unstable_at_one_slope_has_no_margin():
    model = motor_model()
    design = motor_design()
    record = motor_record()
    mismatch = measure_model_error(model, (record,))
    k = 50 * design.state_feedback.k
    observer_l = design.observer.l
    unstable = Gains(k=k, l=observer_l)
    prediction = predict_margins(model, unstable, BALLS, mismatch)
    assert prediction.mismatch_margin == 0.0
    assert prediction.resolved_margin == 0.0
    own = predict_margins(model, design.gain_pair, BALLS, mismatch)
    peak = control_sensitivity_peak(model.linear, design.gain_pair, BALLS)
    expected = 1 / (mismatch.gain * peak)
    assert own.mismatch_margin == pytest.approx(expected)
    by_frequency = np.zeros(len(BANDS))
    none = flat(by_frequency, 0.0)
    prediction = predict_margins(model, design.gain_pair, BALLS, none)
    assert prediction.mismatch_margin == np.inf


def shown_by(filtered, samples: int = 4000, records: int = 1, start_up: int = 0) -> Mismatch:
    """The mismatch of white inputs whose output is the model's plus `filtered` of the scaled input,
    both scaled."""
    model = motor_model()
    trajectories = []
    for seed in range(records):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((samples, 1))
        error = 5.0 * filtered(u / 1.7)
        y = model.simulate(u) + error
        trajectory = Trajectory(u=u, y=y, step_s=0.01)
        trajectories.append(trajectory)
    return measure_model_error(model, tuple(trajectories), start_up)


def test_a_mismatch_of_constant_gain_has_it_at_every_frequency():
    shown = shown_by(lambda u: 0.3 * u)
    assert shown.gain == pytest.approx(0.3)
    np.testing.assert_allclose(shown.gain_by_frequency, 0.3)
    assert BANDS[0] == 0.0
    assert BANDS[-1] == np.pi
    actual = np.diff(BANDS)
    expected = np.pi / 32
    np.testing.assert_allclose(actual, expected)  # 64 samples a segment


@pytest.mark.parametrize("records", [1, 3])
def test_a_mismatch_that_hangs_on_the_frequency_is_resolved(records):
    """`e[k] = (u[k] - u[k-1]) / 2` has gain `|sin(w/2)|`, and `1/sqrt(2)` in total for white
    inputs."""
    shown = shown_by(lambda u: np.diff(u, axis=0, prepend=0.0) / 2, records=records)
    expected = np.sqrt(0.5)
    assert shown.gain == pytest.approx(expected, rel=0.05)
    sine = np.sin(BANDS / 2)
    expected = np.abs(sine)
    np.testing.assert_allclose(shown.gain_by_frequency, expected, atol=0.06)
    between = (BANDS[3] + BANDS[4]) / 2
    expected = shown.gain_by_frequency[3:5].mean()
    (gain_between,) = shown.gain_at(np.array([between]))
    assert gain_between == pytest.approx(expected)


PERIODS = {"once": 64.0731, "repeated": 2000 / 31}


@pytest.mark.parametrize("period", PERIODS.values(), ids=PERIODS)
def test_where_the_input_hardly_moves_nothing_stands_in_for_what_is_measured(period):
    """A slow sine under white noise, whether it repeats or not: without input the noise counts, and
    it is said."""
    model = motor_model()
    k = np.arange(4000)
    sine = np.sin(2 * np.pi * k / period)
    u = sine[:, None]
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(u.shape)
    y = model.simulate(u) + noise
    trajectory = Trajectory(u=u, y=y, step_s=0.01)
    shown = measure_model_error(model, (trajectory,))
    lower_limit = 10 * shown.gain
    assert shown.gain_by_frequency[8:].min() > lower_limit
    assert (
        shown.gain_by_frequency[1] < shown.gain
    )  # where it is excited, the noise is small beside it
    lowest, *_, highest = shown.unexcited
    assert lowest < BANDS[8] < highest
    linear_parts = [view.linear[8:] for view in shown.views]
    assert not np.any(linear_parts)  # nor is a phase known there


def test_samples_that_start_the_state_do_not_count():
    def late(u):
        error = 0.3 * u
        error[:40] *= 100.0
        return error

    mismatch = shown_by(lambda u: 0.3 * u, start_up=40)
    gain = mismatch.gain
    assert gain == pytest.approx(0.3, rel=0.05)
    model = motor_model()
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 1))
    is_at_rest = np.arange(400)[:, None] < 40
    still = np.where(is_at_rest, u, 0.0)
    y = model.simulate(still)
    trajectory = Trajectory(u=still, y=y, step_s=0.01)
    with pytest.raises(BadRequest, match="validation"):
        measure_model_error(model, (trajectory,), 40)
    assert shown_by(late).gain > 1.0


@pytest.mark.parametrize("samples", [9, 30, 31, 63])
def test_a_record_shorter_than_a_segment_is_one_segment(samples):
    shown = shown_by(lambda u: 0.3 * u, samples=samples)
    np.testing.assert_allclose(shown.gain_by_frequency, 0.3)


def test_a_design_keeps_the_plant_strictly_inside_both_bounds():
    def keeps(resolved, radius, *margin):
        margins = {"mismatch_margin": 9.0, "resolved_margin": resolved}
        prediction = Prediction(controller_radius=radius, **margins)
        return prediction.predicts_stability(*margin)

    assert keeps(1.0 + 1e-9, 1.0 - 1e-9)
    assert not keeps(1.0, 0.5)
    assert not keeps(2.0, 1.0)
    assert not keeps(2.0, 0.5, 2.0)
    assert keeps(2.0, 0.5, 1.9)


def test_the_norm_of_constants_and_of_nothing():
    a = np.array([[0.5]])
    b = np.zeros((1, 2))
    c = np.ones((1, 1))
    d = np.zeros((1, 2))
    nothing = StateSpace(a=a, b=b, c=c, d=d)
    assert hinf_norm(nothing) == 0.0
    d = np.array([[3.0, 4.0]])
    constant = StateSpace(a=a, b=b, c=c, d=d)
    norm = hinf_norm(constant)
    assert norm == pytest.approx(5.0, rel=1e-7)


def test_a_system_on_the_circle_has_no_finite_norm():
    system = one_mode(1.0)
    assert hinf_norm(system) == np.inf


def test_what_sticks_is_compared_with_five_percent_of_the_farthest_start():
    """One offset may be a twentieth of the worst, the largest of two a root of that."""
    views = shown_by(lambda u: 0.1 * u).views
    assert Mismatch(views=views).largest_offset == 0.0
    alone = Mismatch(views=views, stuck=(0.01,))
    assert alone.scaled_settling_band == pytest.approx(0.05)
    assert alone.largest_offset == pytest.approx(0.01 * 20 / 0.05)
    farther = Mismatch(views=views, stuck=(0.01, 0.02), farthest=4.0)
    assert farther.largest_offset == pytest.approx(0.02 * np.sqrt(20) / 0.2)
