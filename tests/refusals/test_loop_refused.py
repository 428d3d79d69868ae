"""The refusals of the loop, in one sentence, and how a diverging loop is recorded."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor, motor_design, motor_model, random_model

from ssm_study.certificates.certificate import Design
from ssm_study.loop.comparison import ControllerComparison
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.loop.reference import FileReference, StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains, JacobianBall, StateSpace

LOOP = LoopExperiment(horizon_s=1.0, measurement_noise_variance=0.0)


NO_STARTS = {"initial_conditions": 0}
NO_HORIZON = {"horizon_s": 0.0}
NEGATIVE_VARIANCE = {"measurement_noise_variance": -1.0}
SMALL_BOUND = {"bound_in_initial_ranges": 0.5}
CROSSED_LIMITS = {"input_lower": 1.0, "input_upper": -1.0}
OUT_OF_RANGE = [
    (NO_STARTS, "initial_conditions"),
    (NO_HORIZON, "horizon_s"),
    (NEGATIVE_VARIANCE, "measurement_noise_variance"),
    (SMALL_BOUND, "bound_in_initial_ranges"),
    (CROSSED_LIMITS, "input_lower"),
]


@pytest.mark.parametrize(("values", "names"), OUT_OF_RANGE)
def test_values_out_of_range(values, names):
    in_range = {"horizon_s": 1.0, "measurement_noise_variance": 0.02}
    settings = in_range | values
    with pytest.raises(BadRequest, match=names):
        LoopExperiment(**settings)


def test_a_controller_for_other_dimensions():
    model = random_model(0, inputs=2, outputs=1)
    k = np.zeros((2, 4))
    no_injection = np.zeros((4, 1))
    gains = Gains(k=k, l=no_injection)
    controller = ObserverFeedback(model=model, gains=gains)
    with pytest.raises(BadRequest, match="controller inputs, outputs"):
        LOOP.run_on_plant(motor(), controller, seed=0)


def test_a_controller_for_another_sampling_time():
    design = motor_design()
    model = replace(motor_model(), step_s=0.02)
    controller = ObserverFeedback(model=model, gains=design.gain_pair)
    with pytest.raises(BadRequest, match="step_s"):
        LOOP.run_on_plant(motor(), controller, seed=0)


def test_gains_of_another_model():
    k = np.zeros((1, 5))
    no_injection = np.zeros((5, 1))
    gains = Gains(k=k, l=no_injection)
    with pytest.raises(BadRequest, match=r"k = .*shape"):
        ObserverFeedback(model=motor_model(), gains=gains)
    k = np.zeros((1, 2))
    no_injection = np.zeros((2, 2))
    gains = Gains(k=k, l=no_injection)
    with pytest.raises(BadRequest, match=r"l = .*shape"):
        ObserverFeedback(model=motor_model(), gains=gains)


def test_an_infeasible_design_closes_no_loop():
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.9, rate_observer=0.2)
    system = motor_model().linear
    ball = JacobianBall.from_slopes(0.01, 1.0)
    infeasible = riccati_synthesis.state_feedback(system, ball)
    observer = motor_design().observer
    with pytest.raises(BadRequest, match="state_feedback"):
        LOOP.run_design(
            motor(), motor_model(), Design(state_feedback=infeasible, observer=observer), seed=0
        )


def test_a_model_with_feedthrough_in_the_plants_place():
    model = motor_model()
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    d = np.ones((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    with pytest.raises(BadRequest, match="feedthrough"):
        IdentifiedPlant.from_model(model.with_linear_part(linear))
    channel = Channel(name="x", unit="1")
    inputs = (channel,) * 2
    with pytest.raises(BadRequest, match="name each of its signals"):
        IdentifiedPlant.from_model(model, inputs)


def test_a_diverging_loop_is_stopped_and_labelled():
    """Gains with the wrong sign: every case leaves the bound, no overflow, no NaN, and the record
    says when."""
    design = motor_design()
    k = -5 * design.state_feedback.k
    observer_l = design.observer.l
    gains = Gains(k=k, l=observer_l)
    wrong = ObserverFeedback(model=motor_model(), gains=gains)
    loop = LoopExperiment(
        horizon_s=1.0, measurement_noise_variance=0.02
    )  # noise carries the slowest case out of the dead-zone
    result = loop.run_on_plant(motor(), wrong, seed=0)
    columns = behaviour_columns(result)
    assert columns["stable_count"] == 0
    assert columns["left_bound_count"] == 10
    assert 0 < columns["left_bound_first_s"] < 1.0
    assert columns["settling_time_mean_s"] is None
    assert columns["settling_time_worst_s"] is None
    assert columns["unsettled_as"] == "10 lost"
    values = columns.values()
    finite = [isinstance(value, str | None) or np.isfinite(value) for value in values]
    assert all(finite)
    run = result.controlled
    magnitudes = np.abs(run.y)
    is_within = magnitudes <= run.bound
    assert is_within.all()
    leaving = enumerate(run.left_at_sample)
    for case, at in leaving:
        expected = run.y[case, at - 1]
        after_leaving = run.y[case, at:]
        is_held = after_leaving == expected
        assert is_held.all()


def test_an_unstable_observer_is_stopped_before_it_overflows():
    design = motor_design()
    k = 0 * design.state_feedback.k
    observer_l = design.observer.l
    gains = Gains(k=k, l=1e3 * observer_l)
    wild = ObserverFeedback(model=motor_model(), gains=gains)
    loop = LoopExperiment(horizon_s=5.0, measurement_noise_variance=0.02)
    loop_runs = loop.run_on_plant(motor(), wild, seed=0)
    run = loop_runs.controlled
    assert not run.stayed_within_bound.any()
    is_finite = np.isfinite(run.estimate)
    assert is_finite.all()


def test_references_out_of_order():
    with pytest.raises(BadRequest, match="from_s, until_s"):
        RampDisturbance(slope_per_s=1.0, from_s=1.0, until_s=0.5)
    with pytest.raises(BadRequest, match="frequency_hz"):
        PeriodicDisturbance(amplitude=1.0, frequency_hz=0.0)


CONTENTS = ["", "1,2,3\n", "0,1\n0,2\n", "0,1\n1,nan\n", "time,offset\n0,1\n"]


@pytest.mark.parametrize("content", CONTENTS)
def test_a_malformed_reference_file(tmp_path, content):
    path = tmp_path / "reference.csv"
    path.write_text(content)
    file_reference = FileReference(path=str(path))
    with pytest.raises(BadRequest, match=r"loop\.reference\.path"):
        file_reference.signal(np.arange(3.0))


def test_a_missing_reference_file(tmp_path):
    path = str(tmp_path / "none.csv")
    file_reference = FileReference(path=path)
    with pytest.raises(BadRequest, match=r"loop\.reference\.path"):
        file_reference.signal(np.arange(3.0))


def test_a_reference_that_needs_more_than_the_limits_allow():
    reference = StepReference(before=0.0, after=30.0, at_s=0.0)
    loop = LoopExperiment(
        horizon_s=1.0,
        measurement_noise_variance=0.0,
        reference=reference,
        input_upper=3.0,
        input_lower=-3.0,
    )
    with pytest.raises(BadRequest, match=r"loop\.reference"):
        loop.run_design(motor(), motor_model(), motor_design(), seed=0)


def test_a_horizon_shorter_than_a_sample_has_two() -> None:
    horizons = (1e-6, 0.02, 0.031)
    expected = [2, 2, 3]
    samples = [LoopExperiment(horizon_s=horizon).horizon_samples(0.01) for horizon in horizons]
    assert samples == expected


def test_a_withdrawn_controller_is_refused_with_the_line_of_the_changelog():
    with pytest.raises(BadRequest, match=r"MPC was withdrawn in 0\.2 \(CHANGELOG\.md"):
        ControllerComparison(controllers=("mpc",))
    with pytest.raises(BadRequest, match="not known"):
        ControllerComparison(controllers=("no such controller",))
