"""The horizon of a loop comes from the model's own response; noise that alone crosses the band does
not judge."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor, motor_design, motor_model

from ssm_study.loop.metrics import behaviour_columns
from ssm_study.loop.regulation import SAMPLES, LoopExperiment

SHORTEST, LONGEST = SAMPLES
RESPONSES = [(0.9, 180), (0.98, 916), (0.5, SHORTEST), (0.9999, LONGEST)]


@pytest.mark.parametrize(("pole", "samples"), RESPONSES)
def test_four_times_what_the_model_takes_to_spend_99_percent_of_its_response(pole, samples):
    """One pole: what is left after k samples is `pole^k`; the input takes one sample to arrive."""
    model = motor_model()
    a = pole * np.eye(2)
    b = np.ones((2, 1))
    c = np.ones((1, 2))
    linear = replace(model.linear, a=a, b=b, c=c)
    slow_model = model.with_linear_part(linear)
    loop = LoopExperiment().with_default_horizon(slow_model)
    assert loop.horizon_samples(model.step_s) == samples
    chosen = LoopExperiment(horizon_s=2.0)
    assert chosen.with_default_horizon(model).horizon_s == 2.0
    short = LoopExperiment(horizon_s=1e-9)
    assert short.horizon_samples(model.step_s) == 2  # a motion


def test_noise_that_alone_crosses_the_band_is_left_out_of_the_judgement():
    """Twice as large a band needs no such care; a band within the noise does, and says so."""
    loop = LoopExperiment(measurement_noise_variance=0.02)
    quiet = loop.run_design(motor(), motor_model(), motor_design(), seed=0)
    assert quiet.noise_free is None
    loop = LoopExperiment(measurement_noise_variance=20.0)
    noisy = loop.run_design(motor(), motor_model(), motor_design(), seed=0)
    columns = behaviour_columns(noisy)
    assert columns["judged_noise_free"]
    assert columns["stable_count"] == 10
    assert columns["unsettled_as"] is None
    assert not behaviour_columns(quiet)["judged_noise_free"]


def test_without_noise_there_is_nothing_to_leave_out():
    k = np.array([[8.0, 8.0]])
    designed = motor_design()
    state_feedback = replace(designed.state_feedback, k=k)
    lost = replace(designed, state_feedback=state_feedback)
    loop = LoopExperiment(measurement_noise_variance=0.0)
    run = loop.run_design(motor(), motor_model(), lost, seed=0)
    assert run.noise_free is None
    columns = behaviour_columns(run)
    assert columns["stable_count"] < 10
    assert columns["unsettled_as"]
