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
from ssm_study.api.pictures.nyquist import loop_parts, nyquist_picture
from ssm_study.api.pictures.picture import NothingToShow
from ssm_study.bounds.frequency import frequency_response
from ssm_study.bounds.slopes import certified_balls
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.margin_by_frequency import margin_curves
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict
from ssm_study.robustness.record_errors import View
from ssm_study.robustness.sensitivity import sensitivity
from ssm_study.signals import Trajectory

STEP_S = 0.01


def model_and_gains(kind="monotone", seed=0):
    rng = np.random.default_rng(seed)
    model = random_model(rng, kind, 1)
    model = replace(model, linear=replace(model.linear, d=np.zeros((1, 1))))
    return model, random_design(rng, model, False).pair


def mismatch_of(size: float, amplitude: float = 1.0) -> Mismatch:
    """A model error that is largest in the middle of the frequencies, without a phase."""
    by_frequency = size * np.sin(ANGLES) ** 2
    view = View(
        amplitude=amplitude,
        gain=size,
        by_frequency=by_frequency,
        linear=np.zeros(len(ANGLES), dtype=complex),
        rest=by_frequency,
    )
    return Mismatch(views=(view,))


@pytest.mark.parametrize("seed", range(4))
def test_the_smallest_margin_of_the_curves_is_the_margin_that_predicts(seed: int) -> None:
    model, gains = model_and_gains(seed=seed)
    balls = certified_balls(model)
    mismatch = mismatch_of(0.3)
    (curve,) = margin_curves(model, gains, balls, mismatch)
    margin = predict(model, gains, balls, mismatch).resolved_margin
    assert curve.smallest == pytest.approx(margin, rel=1e-12)
    assert curve.margin.min() == pytest.approx(margin, rel=0.02)
    picture = margin_picture([curve], STEP_S, margin)
    assert f"{margin:.3g}" in picture.title
    dot = picture.panels[0].series[-1]
    assert dot.y[0] == pytest.approx(margin)
    assert dot.x[0] == pytest.approx(curve.angle / (2 * np.pi * STEP_S))


def test_a_margin_that_no_curve_reaches_is_shown_as_a_line_of_its_own() -> None:
    model, gains = model_and_gains()
    curves = margin_curves(model, gains, certified_balls(model), mismatch_of(0.3))
    picture = margin_picture(curves, STEP_S, curves[0].smallest / 2)
    assert picture.panels[0].rules[-1].y == curves[0].smallest / 2
    assert "between two amplitudes" in picture.title


def test_without_a_measured_error_there_is_no_margin_to_draw() -> None:
    model, gains = model_and_gains()
    curves = margin_curves(model, gains, certified_balls(model), mismatch_of(0.0))
    with pytest.raises(NothingToShow, match="no model error"):
        margin_picture(curves, STEP_S)


def test_an_unstable_slope_has_no_frequency_to_blame() -> None:
    model, gains = model_and_gains()
    wild = replace(gains, k=1e4 * gains.k)
    curves = margin_curves(model, wild, certified_balls(model), mismatch_of(0.3))
    with pytest.raises(NothingToShow, match="unstable"):
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
    loop = sensitivity(linear, gains, slope_in, slope_out)
    sizes = np.abs(frequency_response(loop, np.maximum(ANGLES, 1e-4))[:, 0, 0])
    limit = 1 / (np.sin(ANGLES) ** 2 * sizes).max()
    assert limit == pytest.approx(curves[0].smallest, rel=0.05)
    assert "outside" in nyquist_picture(model, gains, mismatch_of(0.99 * limit)).title
    assert "holds the point" in nyquist_picture(model, gains, mismatch_of(1.01 * limit)).title


def test_the_nyquist_curve_is_that_of_controller_and_plant() -> None:
    """`T_ue = C / (1 - P C)` by the loop's own state space."""
    model, gains = model_and_gains()
    angles = np.array([0.01, 0.3, 2.0])
    plant, controller = loop_parts(model, gains, angles)
    slope_in = float(model.scaffold_in.jacobian(np.zeros(1))[0, 0])
    slope_out = float(model.scaffold_out.jacobian(np.zeros(1))[0, 0])
    closed = frequency_response(sensitivity(model.linear, gains, slope_in, slope_out), angles)
    assert controller / (1 - plant * controller) == pytest.approx(closed[:, 0, 0])


def test_several_channels_have_no_nyquist_curve_and_no_input_map() -> None:
    rng = np.random.default_rng(0)
    model = random_model(rng, "linear", 2)
    gains = random_design(rng, model, False).pair
    with pytest.raises(NothingToShow, match="one input"):
        nyquist_picture(model, gains, None)
    with pytest.raises(NothingToShow, match="several inputs"):
        input_map_picture(model, certified_balls(model).input, "u")


def test_the_drawn_response_is_what_a_sinusoid_shows() -> None:
    """Gain and phase of a long sinusoid through the linear model, by least squares."""
    model, _ = model_and_gains(kind="linear")
    record = Trajectory(u=np.zeros((40, 1)), y=np.zeros((40, 1)), step_s=STEP_S)
    panel = bode_picture(model, record).panels[0]
    gains = panel.series[0]
    hertz = gains.x[120]
    time_s = np.arange(4000) * STEP_S
    u = model.scale.input_equilibrium + 1e-3 * np.sin(2 * np.pi * hertz * time_s)[:, None]
    y = (model.simulate(u) - model.scale.output_equilibrium)[2000:, 0]
    basis = np.exp(2j * np.pi * hertz * time_s[2000:])
    fit = np.linalg.lstsq(np.c_[basis.real, basis.imag], y, rcond=None)[0]
    assert np.hypot(*fit) / 1e-3 == pytest.approx(gains.y[120], rel=1e-3)


def test_the_free_run_says_the_fit_of_all_samples_and_draws_the_first() -> None:
    measured = np.sin(np.arange(3000) / 50)[:, None]
    picture = free_run_picture(np.arange(3000) * STEP_S, measured, {"m": 0.9 * measured}, ["y (V)"])
    assert "fit 90.0 %" in picture.title
    assert "2000 of 3000" in picture.title
    assert len(picture.panels[0].series[1].x) == 2000
    assert picture.panels[1].y_label == "Error (V)"


def test_the_band_of_the_input_map_holds_its_slope() -> None:
    model, _ = model_and_gains()
    _, slopes = input_map_picture(model, certified_balls(model).input, "u").panels
    (band,) = slopes.bands
    assert slopes.series[0].y.min() >= band.low[0]
    assert slopes.series[0].y.max() <= band.high[0]
