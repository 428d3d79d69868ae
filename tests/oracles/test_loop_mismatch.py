"""The mismatch margin by two routes, and the H-infinity norm against what is known exactly."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import INPUT_BALL, OUTPUT_BALL, motor_design, motor_model, motor_record

from ssm_study.signals import Trajectory
from ssm_study.synthesis.hinf_norm import gains, hinf_norm
from ssm_study.synthesis.mismatch import Mismatch, mismatch, predict
from ssm_study.synthesis.sensitivity import peaks_on_grid, sensitivity, sensitivity_peak
from ssm_study.systems import JacobianBall, StateSpace

ANGLES = np.concatenate([np.linspace(0, np.pi, 4001), np.geomspace(1e-5, np.pi, 2000)])


@given(st.floats(-0.999, 0.999))
def test_first_order_peak_is_known(pole):
    system = StateSpace(a=np.array([[pole]]), b=np.ones((1, 1)), c=np.ones((1, 1)), d=np.zeros((1, 1)))
    assert hinf_norm(system) == pytest.approx(1 / (1 - abs(pole)), rel=1e-7)


@given(st.floats(0.5, 0.9999), st.floats(0.05, 3.0))
def test_resonance_is_found(radius, angle):
    turn = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    system = StateSpace(a=turn, b=np.array([[1.0], [0.3]]), c=np.array([[0.5, 1.0]]), d=np.zeros((1, 1)))
    near = angle + np.linspace(-1, 1, 20001) * 20 * (1 - radius)
    reference = gains(system, np.concatenate([near, ANGLES])).max()
    assert hinf_norm(system) == pytest.approx(reference, rel=1e-6)


@given(st.integers(0, 10_000), st.integers(1, 10), st.integers(1, 3), st.integers(1, 3), st.booleans())
def test_no_frequency_exceeds_the_norm(seed, n, m, p, feedthrough):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    a *= rng.choice([0.3, 0.9, 0.99, 0.999]) / np.abs(np.linalg.eigvals(a)).max()
    system = StateSpace(
        a=a,
        b=rng.standard_normal((n, m)),
        c=rng.standard_normal((p, n)),
        d=rng.standard_normal((p, m)) if feedthrough else np.zeros((p, m)),
    )
    on_grid = gains(system, ANGLES).max()
    assert on_grid <= hinf_norm(system) * (1 + 1e-9)
    assert hinf_norm(system) <= on_grid * 1.05


def test_the_norm_agrees_with_python_control():
    control = pytest.importorskip("control")
    rng = np.random.default_rng(1)
    for _ in range(10):
        a = rng.standard_normal((5, 5))
        a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
        b, c = rng.standard_normal((5, 2)), rng.standard_normal((2, 5))
        theirs = control.system_norm(control.ss(a, b, c, np.zeros((2, 2)), True), "inf", tol=1e-8)
        assert hinf_norm(StateSpace(a=a, b=b, c=c, d=np.zeros((2, 2)))) == pytest.approx(theirs, rel=1e-5)


def test_an_unstable_system_has_no_finite_norm():
    system = StateSpace(a=np.array([[1.01]]), b=np.ones((1, 1)), c=np.ones((1, 1)), d=np.zeros((1, 1)))
    assert hinf_norm(system) == np.inf


def test_the_peak_by_state_space_and_by_factors():
    design, model = motor_design(), motor_model()
    k, gain = design.state_feedback.k, design.observer.l
    exact = sensitivity_peak(model.linear, k, gain, INPUT_BALL, OUTPUT_BALL)
    angles = np.concatenate([ANGLES[1:], np.linspace(1e-4, np.pi, 5000)])
    grid = peaks_on_grid(model.linear, k[None], gain[None], INPUT_BALL, OUTPUT_BALL, angles)[0, 0]
    assert grid <= exact * (1 + 1e-9)
    assert grid == pytest.approx(exact, rel=1e-4)


def test_the_factors_agree_with_the_state_space_for_several_channels():
    rng = np.random.default_rng(2)
    a = rng.standard_normal((4, 4))
    a *= 0.5 / np.abs(np.linalg.eigvals(a)).max()
    linear = StateSpace(a=a, b=rng.standard_normal((4, 2)), c=rng.standard_normal((3, 4)), d=np.zeros((3, 2)))
    k, gain = 0.05 * rng.standard_normal((2, 4)), 0.05 * rng.standard_normal((4, 3))
    balls = JacobianBall.from_slopes(0.4, 1.0), JacobianBall.from_slopes(0.8, 1.1)
    angles = np.linspace(0.01, np.pi, 50)
    by_space = max(
        gains(sensitivity(linear, k, gain, i, o), angles).max() for i in (0.4, 0.7, 1.0) for o in (0.8, 0.95, 1.1)
    )
    assert peaks_on_grid(linear, k[None], gain[None], *balls, angles)[0, 0] == pytest.approx(by_space, rel=1e-9)


def test_the_sensitivity_is_the_loops_own_response_to_output_error():
    """Time domain: the loop written out with a sine added to the output answers with the gain of T_ue."""
    model, design = motor_model(), motor_design()
    k, gain, angle = design.state_feedback.k, design.observer.l, 0.4
    a, b, c, slope = model.linear.a, model.linear.b, model.linear.c, INPUT_BALL.alpha
    x, x_hat, u = np.zeros(2), np.zeros(2), []
    for sample in range(3000):
        u.append(float((k @ x_hat)[0]))
        y = c @ x + np.sin(angle * sample)
        x, x_hat = a @ x + b[:, 0] * slope * u[-1], a @ x_hat + b[:, 0] * slope * u[-1] + gain @ (c @ x_hat - y)
    amplitude = np.abs(np.array(u[-1500:]) @ np.exp(-1j * angle * np.arange(1500))) * 2 / 1500
    expected = gains(sensitivity(model.linear, k, gain, slope, 1.0), np.array([angle]))[0]
    assert amplitude == pytest.approx(expected, rel=0.01)


def test_the_gain_is_the_ratio_of_what_the_record_shows():
    model, record = motor_model(), motor_record()
    error = (record.y - model.simulate(record.u)) / 5.0
    assert mismatch(model, (record,)).gain == pytest.approx(np.linalg.norm(error) / np.linalg.norm(record.u / 1.7))
    assert mismatch(model, (record, record)).gain == pytest.approx(mismatch(model, (record,)).gain)
    own = Trajectory(u=record.u, y=model.simulate(record.u), step_s=0.01)
    assert mismatch(model, (own,)).gain == 0.0


def test_a_loop_that_is_unstable_at_one_slope_has_no_margin():
    model, design = motor_model(), motor_design()
    balls, shown = (INPUT_BALL, OUTPUT_BALL), mismatch(model, (motor_record(),))
    found = predict(model, 50 * design.state_feedback.k, design.observer.l, *balls, shown)
    assert (found.margin, found.resolved_margin) == (0.0, 0.0)
    own = predict(model, design.state_feedback.k, design.observer.l, *balls, shown)
    peak = sensitivity_peak(model.linear, design.state_feedback.k, design.observer.l, *balls)
    assert own.margin == pytest.approx(1 / (shown.gain * peak))
    none = Mismatch(gain=0.0, angles=np.array([0.0, np.pi]), by_frequency=np.zeros(2))
    assert predict(model, design.state_feedback.k, design.observer.l, *balls, none).margin == np.inf
