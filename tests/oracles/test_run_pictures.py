"""Pictures show the numbers that decide: margins, discs and coverage agree with what is computed
elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from report_runs import random_design, random_model

from ssm_study.api.pictures.bode import bode_picture
from ssm_study.api.pictures.free_run import free_run_picture
from ssm_study.api.pictures.input_map import input_map_picture
from ssm_study.api.pictures.margin import margin_picture
from ssm_study.api.pictures.nyquist import nyquist_picture, plant_and_controller_responses
from ssm_study.api.pictures.picture import EmptyPictureError
from ssm_study.bounds.frequency import frequency_response
from ssm_study.bounds.slopes import certified_balls
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.margin_by_frequency import margin_curves
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.robustness.sensitivity import error_to_input_response
from ssm_study.signals import Trajectory

STEP_S = 0.01


def model_and_gains(kind="monotone", seed=0):
    rng = np.random.default_rng(seed)
    model = random_model(rng, kind, 1)
    d = np.zeros((1, 1))
    linear = replace(model.linear, d=d)
    model = replace(model, linear=linear)
    design = random_design(rng, model, False)
    pair = design.gain_pair
    return model, pair


def mismatch_of(size: float, amplitude: float = 1.0) -> Mismatch:
    """A model error that is largest in the middle of the frequencies, without a phase."""
    sine = np.sin(ANGLES)
    by_frequency = size * sine**2
    linear = np.zeros(len(ANGLES), dtype=complex)
    view = ModelErrorAtAmplitude(
        amplitude=amplitude, gain=size, by_frequency=by_frequency, linear=linear, rest=by_frequency
    )
    return Mismatch(views=(view,))


@pytest.mark.parametrize("seed", range(4))
def test_the_smallest_margin_of_the_curves_is_the_margin_that_predicts(seed: int) -> None:
    model, gains = model_and_gains(seed=seed)
    balls = certified_balls(model)
    mismatch = mismatch_of(0.3)
    (curve,) = margin_curves(model, gains, balls, mismatch)
    margin = predict_margins(model, gains, balls, mismatch).resolved_margin
    assert curve.smallest == pytest.approx(margin, rel=1e-12)
    smallest = curve.margin.min()
    assert smallest == pytest.approx(margin, rel=0.02)
    picture = margin_picture([curve], STEP_S, margin)
    assert f"{margin:.3g}" in picture.title
    series = picture.panels[0].series
    dot = series[-1]
    assert dot.y[0] == pytest.approx(margin)
    expected = curve.angle / (2 * np.pi * STEP_S)
    assert dot.x[0] == pytest.approx(expected)


def test_a_margin_that_no_curve_reaches_is_shown_as_a_line_of_its_own() -> None:
    model, gains = model_and_gains()
    curves = margin_curves(model, gains, certified_balls(model), mismatch_of(0.3))
    margin = curves[0].smallest / 2
    picture = margin_picture(curves, STEP_S, margin)
    rules = picture.panels[0].rules
    rules_y = rules[-1].y
    expected = curves[0].smallest / 2
    assert rules_y == expected
    assert "between two amplitudes" in picture.title


def test_without_a_measured_error_there_is_no_margin_to_draw() -> None:
    model, gains = model_and_gains()
    curves = margin_curves(model, gains, certified_balls(model), mismatch_of(0.0))
    with pytest.raises(EmptyPictureError, match="no model error"):
        margin_picture(curves, STEP_S)


def test_an_unstable_slope_has_no_frequency_to_blame() -> None:
    model, gains = model_and_gains()
    k = 1e4 * gains.k
    wild = replace(gains, k=k)
    curves = margin_curves(model, wild, certified_balls(model), mismatch_of(0.3))
    with pytest.raises(EmptyPictureError, match="unstable"):
        margin_picture(curves, STEP_S)


@pytest.mark.parametrize("seed", range(4))
def test_a_disc_holds_minus_one_exactly_where_the_margin_falls_below_one(seed: int) -> None:
    """With a linear input map the slopes of rest are all slopes, and both statements are one."""
    model, gains = model_and_gains(kind="linear", seed=seed)
    balls = certified_balls(model)
    curves = margin_curves(model, gains, balls, mismatch_of(1.0))
    # The discs are drawn in the middle of the bands: there the margin is taken, too.
    linear = model.linear
    slope_in = float(model.scaffold_in.jacobian(np.zeros(1))[0, 0])
    slope_out = float(model.scaffold_out.jacobian(np.zeros(1))[0, 0])
    loop = error_to_input_response(linear, gains, slope_in, slope_out)
    sizes = np.abs(frequency_response(loop, np.maximum(ANGLES, 1e-4))[:, 0, 0])
    sine = np.sin(ANGLES)
    largest = (sine**2 * sizes).max()
    limit = 1 / largest
    expected = curves[0].smallest
    assert limit == pytest.approx(expected, rel=0.05)
    mismatch = mismatch_of(0.99 * limit)
    picture = nyquist_picture(model, gains, mismatch)
    title = picture.title
    assert "outside" in title
    mismatch = mismatch_of(1.01 * limit)
    picture = nyquist_picture(model, gains, mismatch)
    title = picture.title
    assert "holds the point" in title


def test_the_nyquist_curve_is_that_of_controller_and_plant() -> None:
    """`T_ue = C / (1 - P C)` by the loop's own state space."""
    model, gains = model_and_gains()
    angles = np.array([0.01, 0.3, 2.0])
    plant, controller = plant_and_controller_responses(model, gains, angles)
    slope_in = float(model.scaffold_in.jacobian(np.zeros(1))[0, 0])
    slope_out = float(model.scaffold_out.jacobian(np.zeros(1))[0, 0])
    state_space = error_to_input_response(model.linear, gains, slope_in, slope_out)
    closed = frequency_response(state_space, angles)
    expected = closed[:, 0, 0]
    assert controller / (1 - plant * controller) == pytest.approx(expected)


def test_several_channels_have_no_nyquist_curve_and_no_input_map() -> None:
    rng = np.random.default_rng(0)
    model = random_model(rng, "linear", 2)
    design = random_design(rng, model, False)
    gains = design.gain_pair
    with pytest.raises(EmptyPictureError, match="one input"):
        nyquist_picture(model, gains, None)
    slopes = certified_balls(model).input
    with pytest.raises(EmptyPictureError, match="several inputs"):
        input_map_picture(model, slopes, "u")


def test_the_drawn_response_is_what_a_sinusoid_shows() -> None:
    """Gain and phase of a long sinusoid through the linear model, by least squares."""
    model, _ = model_and_gains(kind="linear")
    record = Trajectory(u=np.zeros((40, 1)), y=np.zeros((40, 1)), step_s=STEP_S)
    panels = bode_picture(model, record).panels
    panel = panels[0]
    gains = panel.series[0]
    hertz = gains.x[120]
    time_s = np.arange(4000) * STEP_S
    input_equilibrium = model.scale.input_equilibrium
    sine = np.sin(2 * np.pi * hertz * time_s)
    u = input_equilibrium + 1e-3 * sine[:, None]
    response = model.simulate(u)
    difference = response - model.scale.output_equilibrium
    y = difference[2000:, 0]
    basis = np.exp(2j * np.pi * hertz * time_s[2000:])
    least_squares = np.linalg.lstsq(np.c_[basis.real, basis.imag], y, rcond=None)
    fit = least_squares[0]
    expected = gains.y[120]
    assert np.hypot(*fit) / 1e-3 == pytest.approx(expected, rel=1e-3)


def test_the_free_run_says_the_fit_of_all_samples_and_draws_the_first() -> None:
    sine = np.sin(np.arange(3000) / 50)
    measured = sine[:, None]
    time_s = np.arange(3000) * STEP_S
    simulated = {"m": 0.9 * measured}
    picture = free_run_picture(time_s, measured, simulated, ["y (V)"])
    assert "fit 90.0 %" in picture.title
    assert "2000 of 3000" in picture.title
    series = picture.panels[0].series
    series_x = series[1].x
    assert len(series_x) == 2000
    y_label = picture.panels[1].y_label
    assert y_label == "Error (V)"


def test_the_band_of_the_input_map_holds_its_slope() -> None:
    model, _ = model_and_gains()
    picture = input_map_picture(model, certified_balls(model).input, "u")
    _, slopes = picture.panels
    (band,) = slopes.bands
    series_y = slopes.series[0].y
    smallest = series_y.min()
    assert smallest >= band.low[0]
    series_y = slopes.series[0].y
    largest = series_y.max()
    assert largest <= band.high[0]
