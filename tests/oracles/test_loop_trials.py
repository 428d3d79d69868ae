"""The mismatch that a trial in closed loop shows: the gain that sustains its motion, nothing of one
that rests."""

from dataclasses import replace

import numpy as np
import pytest
from test_loop_prediction import ONES, linear_model

from ssm_study.certificates.certificate import Design
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.sensitivity import control_sensitivity_peak
from ssm_study.signals import Trajectory
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import StateSpace

SAMPLES = 900


def looped(
    model: SSM, design: Design, relay: float, noise: float = 0.0, samples: int = SAMPLES
) -> Trajectory:
    """The model under its own controller, its output moved by `relay tanh(50 y)`: a gain that peaks
    at rest."""
    controller = ObserverFeedback.from_design(model, design)
    rng = np.random.default_rng(0)
    shape = (samples, 1)
    reference = np.zeros(shape)
    plan = controller.target_trajectory(reference)
    memory = controller.initial_memory(1)
    x = np.ones(model.order)
    u = np.zeros(shape)
    y = np.zeros(shape)
    for k in range(samples):
        output = model.linear.c @ x
        white_noise = rng.standard_normal(1)
        relay_output = np.tanh(50 * output)
        friction = relay * relay_output
        y[k] = output + friction + noise * white_noise
        output_now = y[k : k + 1]
        inputs = controller.input(memory, output_now, plan[k])
        u[k] = inputs[0]
        input_now = u[k : k + 1]
        memory = controller.next_memory(memory, input_now, output_now, plan[k])
        linear_a = model.linear.a
        linear_b = model.linear.b
        driven = linear_b @ u[k]
        x = linear_a @ x + driven
    return Trajectory(u=u, y=y, step_s=model.step_s, closed_loop=True)


def slow_model() -> SSM:
    """Three lags, read before the input acts."""
    rows_of_a = [[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.0, 0.0, 0.7]]
    a = np.array(rows_of_a)
    column_of_b = [[0.0], [0.0], [0.3]]
    b = np.array(column_of_b)
    row_of_c = [1.0, 0.0, 0.0]
    c = np.array([row_of_c])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    return replace(linear_model(0), linear=linear)


MODEL = slow_model()
FAST_METHOD = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.5, input_weight=1e-3)
FAST = FAST_METHOD.design(MODEL, ONES)
CALM_METHOD = RiccatiSynthesis(rate_controller=0.25, rate_observer=0.3, input_weight=100.0)
CALM = CALM_METHOD.design(MODEL, ONES)


def recorded(noise: float = 0.01) -> Trajectory:
    """White input at full amplitude, twice: the model is exact on it, but for noise."""
    rng = np.random.default_rng(1)
    white_noise = rng.standard_normal((1024, 1))
    twice = (2, 1)
    u = np.tile(3 * white_noise, twice)
    response = MODEL.simulate(u)
    white_noise = rng.standard_normal(u.shape)
    y = response + noise * white_noise
    return Trajectory(u=u, y=y, step_s=MODEL.step_s)


NOISES = [0.0, 0.01]


@pytest.mark.parametrize("noise", NOISES)
def test_a_loop_that_oscillates_refutes_its_own_design(noise):
    """Harmonic balance: the gain in the loop times |T_ue| is one at the cycle, so the margin falls
    below one."""
    trial = looped(MODEL, FAST, 0.3, noise)
    record = recorded(noise)
    mismatch_of_record = measure_model_error(MODEL, (record,))
    mismatch = measure_model_error(MODEL, (record,), 0, (trial,))
    margins = predict_margins(MODEL, FAST.gain_pair, ONES, mismatch_of_record)
    resolved_margin = margins.resolved_margin
    assert resolved_margin > 1
    margins = predict_margins(MODEL, FAST.gain_pair, ONES, mismatch)
    resolved_margin = margins.resolved_margin
    assert resolved_margin < 1
    assert mismatch.loop is not None
    expected = mismatch.loop.gain
    assert mismatch.largest_recorded_gain == expected > 5 * mismatch_of_record.largest_recorded_gain
    peak = control_sensitivity_peak(MODEL.linear, FAST.gain_pair, ONES)
    assert mismatch.loop.gain > 0.9 / peak
    margins = predict_margins(MODEL, CALM.gain_pair, ONES, mismatch)
    resolved_margin = margins.resolved_margin
    assert resolved_margin > 1


@pytest.mark.parametrize("repeats", [True, False])
def test_noise_that_the_loop_feeds_back_is_no_mismatch(repeats):
    """In closed loop e of noise alone is n and u = T_ue n: taken as it stands, g |T_ue| would be
    one everywhere."""
    record = recorded()
    trial = looped(MODEL, FAST, 0.0, noise=0.3)
    record = record if repeats else record[:1500]
    mismatch = measure_model_error(MODEL, (record,), 0, (trial,))
    loop = mismatch.loop
    assert loop is None


def test_a_motion_asked_of_a_good_loop_shows_little():
    """A trial with a moving set point counts, and what it shows is what the noise leaves, not 1 /
    |T_ue|."""
    trial = looped(MODEL, FAST, 0.0, noise=0.05)
    angles = np.arange(SAMPLES)
    sine = np.sin(angles / 7)
    moved = 2 * sine[:, None]
    u = trial.u + moved
    response = MODEL.simulate(moved)
    y = trial.y + response
    changed_trial = replace(trial, u=u, y=y)
    records = (recorded(0.05),)
    mismatch = measure_model_error(MODEL, records, 0, (changed_trial,))
    assert mismatch.loop is not None
    assert mismatch.loop.gain < 0.05


SIZES = [0.0, 0.008]


@pytest.mark.parametrize("size", SIZES)
def test_of_a_moving_loop_the_noise_goes_in_every_band(size):
    """At its ends, 0 and pi, Welch's density has half of white noise: no more is taken there, and
    an offset stays."""
    trial = looped(MODEL, FAST, 0.0, noise=0.05)
    samples = np.arange(SAMPLES)
    k = samples[:, None]
    sine = np.sin(k / 7)
    moved = 2 * sine
    response = MODEL.simulate(moved)
    cosine = np.cos(np.pi * k)
    swing = size * (1 + cosine)
    y = trial.y + response + swing
    u = trial.u + moved
    changed_trial = replace(trial, u=u, y=y)
    mismatch = measure_model_error(MODEL, (recorded(0.05),), 0, (changed_trial,))
    loop_mismatch = mismatch.loop
    assert loop_mismatch is not None
    actual = loop_mismatch.by_frequency > 0
    bands = np.arange(33)
    ends = [0, 32]
    ends_of_the_band = np.isin(bands, ends)
    expected = (size > 0) & ends_of_the_band
    np.testing.assert_array_equal(actual, expected)


def test_where_no_record_measured_the_noise_the_quietest_bands_do():
    """The loop's e holds a cycle at one frequency and white noise: the cycle stays, the noise
    goes."""
    trial = looped(MODEL, FAST, 0.3, noise=0.02)
    record = recorded()[:1500]
    records = (recorded(0.02),)
    mismatch = measure_model_error(MODEL, records, 0, (trial,))
    measured = mismatch.loop
    mismatch = measure_model_error(MODEL, (record,), 0, (trial,))
    guessed = mismatch.loop
    expected_gain = pytest.approx(measured.gain, rel=0.05)
    assert guessed.gain == expected_gain


def test_the_start_of_a_loop_is_no_mismatch():
    """From far out, at rest before the end: the model explains the whole of it by its initial
    state."""
    quiet = looped(MODEL, CALM, 0.0)
    records = (recorded(),)
    mismatch = measure_model_error(MODEL, records, 0, (quiet,))
    loop = mismatch.loop
    assert loop is None
    short = looped(MODEL, CALM, 0.0, samples=30)  # still on its way at the end
    later_mismatch = measure_model_error(MODEL, records, 0, (short,))
    assert later_mismatch.loop is None or later_mismatch.loop.gain < 0.02


def test_the_records_about_the_loop_stay_as_they_are():
    record = recorded()
    trial = looped(MODEL, FAST, 0.3)
    alone = measure_model_error(MODEL, (record,))
    beside = measure_model_error(MODEL, (record,), 0, (trial,))
    assert alone.gain == beside.gain
    assert alone.spread == beside.spread
    expected = len(beside.views)
    assert len(alone.views) == expected
    assert alone.left_at_rest == beside.left_at_rest


def test_the_record_with_the_most_power_is_the_largest():
    """Also where its input is negative: its scatter and its bands are those that are told."""
    rng = np.random.default_rng(0)
    angles = np.arange(900)
    sine = np.sin(angles / 300)
    size = np.abs(sine)[:, None]
    falling = -1 - size
    white_noise = rng.standard_normal((900, 1))
    rising = 1 + 0.1 * white_noise
    outputs = []
    for u in (rising, falling):
        noise = 0.01 * rng.standard_normal((900, 1))
        outputs.append(MODEL.simulate(u) + noise)
    weak = Trajectory(u=rising, y=outputs[0], step_s=0.01)
    strong = Trajectory(u=falling, y=outputs[1], step_s=0.01)
    both = measure_model_error(MODEL, (weak, strong))
    alone = measure_model_error(MODEL, (strong,))
    other = measure_model_error(MODEL, (weak,))
    assert both.spread == alone.spread != other.spread
    assert both.unexcited == alone.unexcited
