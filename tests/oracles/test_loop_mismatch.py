"""The mismatch margin by two routes, and the H-infinity norm against what is known exactly."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import (
    BALLS,
    INPUT_BALL,
    flat,
    motor_design,
    motor_model,
    motor_record,
    random_model,
)

from ssm_study.bounds.frequency import hinf_norm, largest_gains
from ssm_study.refusal import BadRequest
from ssm_study.robustness.bands import ANGLES as BANDS
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.robustness.prediction import Prediction, predict_margins
from ssm_study.robustness.sensitivity import (
    controller_spectral_radius,
    error_to_input_response,
    gain_peaks_on_grid,
    sensitivity_peak,
)
from ssm_study.signals import Trajectory
from ssm_study.systems import Balls, Gains, JacobianBall, StateSpace

# A mode of radius 0.999 is 0.001 wide: half a step of 0.0004 beside its peak, the gain is 2 %
# lower.
EVEN_ANGLES = np.linspace(0, np.pi, 8001)
LOW_ANGLES = np.geomspace(1e-5, np.pi, 2000)
ANGLES = np.concatenate([EVEN_ANGLES, LOW_ANGLES])


def one_mode(pole: float) -> StateSpace:
    """`x+ = pole x + u`, `y = x`."""
    one = np.ones((1, 1))
    return StateSpace(a=pole * one, b=one, c=one, d=0.0 * one)


@given(st.floats(-0.999, 0.999))
def test_first_order_peak_is_known(pole):
    system = one_mode(pole)
    expected = 1 / (1 - abs(pole))
    assert hinf_norm(system) == pytest.approx(expected, rel=1e-7)


@given(st.floats(0.5, 0.9999), st.floats(0.05, 3.0))
def test_resonance_is_found(radius, angle):
    cosine = np.cos(angle)
    sine = np.sin(angle)
    second_row = [-np.sin(angle), np.cos(angle)]
    turn = radius * np.array([[cosine, sine], second_row])
    b = np.array([[1.0], [0.3]])
    c = np.array([[0.5, 1.0]])
    d = np.zeros((1, 1))
    system = StateSpace(a=turn, b=b, c=c, d=d)
    around = np.linspace(-1, 1, 20001)
    near = angle + around * 20 * (1 - radius)
    angles = np.concatenate([near, ANGLES])
    reference = largest_gains(system, angles).max()
    assert hinf_norm(system) == pytest.approx(reference, rel=1e-6)


@given(
    st.integers(0, 10_000), st.integers(1, 10), st.integers(1, 3), st.integers(1, 3), st.booleans()
)
def test_no_frequency_exceeds_the_norm(seed, n, m, p, feedthrough):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    radius = rng.choice([0.3, 0.9, 0.99, 0.999])
    a *= radius / spectral_radius
    b = rng.standard_normal((n, m))
    c = rng.standard_normal((p, n))
    d = rng.standard_normal((p, m)) if feedthrough else np.zeros((p, m))
    system = StateSpace(a=a, b=b, c=c, d=d)
    on_grid = largest_gains(system, ANGLES).max()
    upper_limit = hinf_norm(system) * (1 + 1e-9)
    assert on_grid <= upper_limit
    assert hinf_norm(system) <= on_grid * 1.05


def test_the_norm_agrees_with_python_control():
    control = pytest.importorskip("control")
    rng = np.random.default_rng(1)
    for _ in range(10):
        a = rng.standard_normal((5, 5))
        eigenvalues = np.linalg.eigvals(a)
        spectral_radius = np.abs(eigenvalues).max()
        a *= 0.95 / spectral_radius
        b = rng.standard_normal((5, 2))
        c = rng.standard_normal((2, 5))
        system_of_control = control.ss(a, b, c, np.zeros((2, 2)), True)
        theirs = control.system_norm(system_of_control, "inf", tol=1e-8)
        d = np.zeros((2, 2))
        system = StateSpace(a=a, b=b, c=c, d=d)
        assert hinf_norm(system) == pytest.approx(theirs, rel=1e-5)


def test_an_unstable_system_has_no_finite_norm():
    system = one_mode(1.01)
    assert hinf_norm(system) == np.inf


def test_the_peak_by_state_space_and_by_factors():
    design = motor_design()
    model = motor_model()
    k = design.state_feedback.k
    gain = design.observer.l
    pair = Gains(k=k, l=gain)
    exact = sensitivity_peak(model.linear, pair, BALLS)
    even_angles = np.linspace(1e-4, np.pi, 5000)
    angles = np.concatenate([ANGLES[1:], even_angles])
    peaks = gain_peaks_on_grid(model.linear, k[None], gain[None], BALLS, angles)
    grid = peaks[0, 0]
    assert grid <= exact * (1 + 1e-9)
    assert grid == pytest.approx(exact, rel=1e-4)


def test_the_factors_agree_with_the_state_space_for_several_channels():
    rng = np.random.default_rng(2)
    a = rng.standard_normal((4, 4))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    a *= 0.5 / spectral_radius
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
    balls = Balls(input=jacobian_ball, output=output)
    angles = np.linspace(0.01, np.pi, 50)
    pair = Gains(k=k, l=gain)
    norms = [
        largest_gains(error_to_input_response(linear, pair, i, o), angles).max()
        for i in (0.4, 0.7, 1.0)
        for o in (0.8, 0.95, 1.1)
    ]
    by_space = max(norms)
    peaks = gain_peaks_on_grid(linear, k[None], gain[None], balls, angles)
    assert peaks[0, 0] == pytest.approx(by_space, rel=1e-9)


def test_the_sensitivity_is_the_loops_own_response_to_output_error():
    """Time domain: the loop written out with a sine added to the output answers with the gain of
    T_ue."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    angle = 0.4
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    slope = INPUT_BALL.alpha
    x = np.zeros(2)
    x_hat = np.zeros(2)
    u = []
    for sample in range(3000):
        u.append(float((k @ x_hat)[0]))
        sine = np.sin(angle * sample)
        y = c @ x + sine
        applied = b[:, 0] * slope * u[-1]
        x = a @ x + applied
        difference = c @ x_hat - y
        applied = b[:, 0] * slope * u[-1]
        x_hat = a @ x_hat + applied + gain @ difference
    rotation = np.exp(-1j * angle * np.arange(1500))
    component = np.array(u[-1500:]) @ rotation
    amplitude = np.abs(component) * 2 / 1500
    pair = Gains(k=k, l=gain)
    state_space = error_to_input_response(model.linear, pair, slope, 1.0)
    angles = np.array([angle])
    expected = largest_gains(state_space, angles)[0]
    assert amplitude == pytest.approx(expected, rel=0.01)


def test_the_gain_is_the_ratio_of_what_the_record_shows():
    model = motor_model()
    record = motor_record()
    response = model.simulate(record.u)
    difference = record.y - response
    error = difference / 5.0
    mismatch = measure_mismatch(model, (record,))
    gain = mismatch.gain
    norm = np.linalg.norm(error)
    expected = norm / np.linalg.norm(record.u / 1.7)
    assert gain == pytest.approx(expected)
    mismatch = measure_mismatch(model, (record, record))
    gain = mismatch.gain
    mismatch = measure_mismatch(model, (record,))
    expected = mismatch.gain
    assert gain == pytest.approx(expected)
    y = model.simulate(record.u)
    own = Trajectory(u=record.u, y=y, step_s=0.01)
    mismatch = measure_mismatch(model, (own,))
    gain = mismatch.gain
    assert gain == 0.0


def test_a_loop_that_is_unstable_at_one_slope_has_no_margin():
    model = motor_model()
    design = motor_design()
    shown = measure_mismatch(model, (motor_record(),))
    k = 50 * design.state_feedback.k
    observer_l = design.observer.l
    pair = Gains(k=k, l=observer_l)
    found = predict_margins(model, pair, BALLS, shown)
    assert found.mismatch_margin == 0.0
    assert found.resolved_margin == 0.0
    own = predict_margins(model, design.pair, BALLS, shown)
    peak = sensitivity_peak(model.linear, design.pair, BALLS)
    expected = 1 / (shown.gain * peak)
    assert own.mismatch_margin == pytest.approx(expected)
    by_frequency = np.zeros(len(BANDS))
    none = flat(by_frequency, 0.0)
    mismatch_margin = predict_margins(model, design.pair, BALLS, none).mismatch_margin
    assert mismatch_margin == np.inf


def shown_by(filtered, samples: int = 4000, records: int = 1, start_up: int = 0) -> Mismatch:
    """The mismatch of white inputs whose output is the model's plus `filtered` of the scaled input,
    both scaled."""
    model = motor_model()
    made = []
    for seed in range(records):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((samples, 1))
        response = model.simulate(u)
        y = response + 5.0 * filtered(u / 1.7)
        trajectory = Trajectory(u=u, y=y, step_s=0.01)
        made.append(trajectory)
    return measure_mismatch(model, tuple(made), start_up)


def test_a_mismatch_of_constant_gain_has_it_at_every_frequency():
    shown = shown_by(lambda u: 0.3 * u)
    assert shown.gain == pytest.approx(0.3)
    np.testing.assert_allclose(shown.by_frequency, 0.3)
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
    np.testing.assert_allclose(shown.by_frequency, expected, atol=0.06)
    between = (BANDS[3] + BANDS[4]) / 2
    expected = shown.by_frequency[3:5].mean()
    gain_between = shown.gain_at(np.array([between]))
    assert gain_between[0] == pytest.approx(expected)


@pytest.mark.parametrize("period", [64.0731, 2000 / 31], ids=["once", "repeated"])
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
    shown = measure_mismatch(model, (trajectory,))
    lower_limit = 10 * shown.gain
    assert (shown.by_frequency[8:] > lower_limit).all()
    assert shown.by_frequency[1] < shown.gain  # where it is excited, the noise is small beside it
    assert shown.unexcited[0] < BANDS[8] < shown.unexcited[-1]
    assert not any(np.any(view.linear[8:]) for view in shown.views)  # nor is a phase known there


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
        measure_mismatch(model, (trajectory,), 40)
    assert shown_by(late).gain > 1.0


@pytest.mark.parametrize("samples", [9, 30, 31, 63])
def test_a_record_shorter_than_a_segment_is_one_segment(samples):
    shown = shown_by(lambda u: 0.3 * u, samples=samples)
    np.testing.assert_allclose(shown.by_frequency, 0.3)


def test_a_design_keeps_the_plant_strictly_inside_both_bounds():
    def keeps(resolved, radius, *margin):
        made = Prediction(mismatch_margin=9.0, resolved_margin=resolved, controller_radius=radius)
        return made.predicts_stability(*margin)

    assert keeps(1.0 + 1e-9, 1.0 - 1e-9)
    assert not keeps(1.0, 0.5)
    assert not keeps(2.0, 1.0)
    assert not keeps(2.0, 0.5, 2.0)
    assert keeps(2.0, 0.5, 1.9)


def several_channels():
    rng = np.random.default_rng(2)
    model = random_model(2, inputs=2, outputs=3)
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    d = rng.standard_normal((3, 2))
    linear = StateSpace(a=0.7 * a, b=b, c=c, d=d)
    white_noise = rng.standard_normal((3, 2, 4))
    ks = 0.1 * white_noise
    white_noise = rng.standard_normal((3, 4, 3))
    ls = 0.1 * white_noise
    jacobian_ball = JacobianBall.from_slopes(0.4, 1.0)
    output = JacobianBall.from_slopes(0.8, 1.1)
    balls = Balls(input=jacobian_ball, output=output)
    return linear, Gains(k=ks, l=ls), balls


def test_the_controller_alone_is_the_equation_written_out():
    """Centre and both ends of either ball; integrators are left out."""
    linear, pairs, balls = several_channels()
    expected = [
        max(
            np.abs(
                np.linalg.eigvals(
                    linear.a + i * linear.b @ k + o * gain @ (linear.c + i * linear.d @ k)
                )
            ).max()
            for i, o in product((0.4, 0.7, 1.0), (0.8, 0.95, 1.1))
        )
        for k, gain in zip(pairs.k, pairs.l, strict=True)
    ]
    actual = controller_spectral_radius(linear, pairs, balls)
    np.testing.assert_allclose(actual, expected)
    with_integrators = np.concatenate([pairs.k, np.ones((3, 2, 2))], axis=2)
    wider = Gains(k=with_integrators, l=pairs.l)
    actual = controller_spectral_radius(linear, wider, balls)
    np.testing.assert_allclose(actual, expected)
    known = JacobianBall(alpha=0.7, beta=0.0)
    narrow = Balls(input=known, output=known)
    wide = Balls(input=balls.input, output=known)
    of_narrow = controller_spectral_radius(linear, pairs, narrow)
    of_wide = controller_spectral_radius(linear, pairs, wide)
    assert (of_narrow <= of_wide).all()


def test_the_norm_of_constants_and_of_nothing():
    a = np.array([[0.5]])
    b = np.zeros((1, 2))
    c = np.ones((1, 1))
    d = np.zeros((1, 2))
    nothing = StateSpace(a=a, b=b, c=c, d=d)
    assert hinf_norm(nothing) == 0.0
    a = np.array([[0.5]])
    b = np.zeros((1, 2))
    c = np.ones((1, 1))
    d = np.array([[3.0, 4.0]])
    constant = StateSpace(a=a, b=b, c=c, d=d)
    assert hinf_norm(constant) == pytest.approx(5.0, rel=1e-7)


def test_a_system_on_the_circle_has_no_finite_norm():
    system = one_mode(1.0)
    assert hinf_norm(system) == np.inf
