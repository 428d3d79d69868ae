"""A dead time of known length is states of the model: the same output later, and a loop that
reckons with it."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import Linear
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.spec import SSMSpec
from ssm_study.plants.wrapper import DelayedInput
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet, Scale, Trajectory
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

LATE = 8


def bent() -> SSM:
    a = np.array([[0.99, 0.1], [-0.1, 0.97]])
    b = np.array([[0.0], [0.15]])
    c = np.array([[1.0, 0.0]])
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    breakpoints = np.array([[-1.0, 0.5]])
    slopes = np.array([[1.0, 0.8, 1.0]])
    lifted = MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)
    ssm = SSM.from_linear(linear, 0.1)
    return replace(ssm, scaffold_in=lifted)


def dataset_of(record: Trajectory, scale: Scale) -> DataSet:
    """One record as training, validation and test."""
    parts = {"training": (record,), "validation": (record,), "test": (record,)}
    return DataSet(inputs=(), outputs=(), scale=scale, **parts)


@pytest.mark.parametrize("inputs", [1, 2])
def test_the_output_is_the_same_later(inputs: int) -> None:
    rng = np.random.default_rng(inputs)
    white_noise = rng.standard_normal((3, 3))
    a = 0.3 * white_noise
    b = rng.standard_normal((3, inputs))
    matrices = {"a": a, "b": b}
    c = rng.standard_normal((1, 3))
    d = rng.standard_normal((1, inputs))
    outputs = {"c": c, "d": d}
    state_space = StateSpace(**matrices, **outputs)
    model = SSM.from_linear(state_space, 0.1)
    u = rng.standard_normal((80, inputs))
    y = model.simulate(u)
    late_model = model.with_dead_time(5)
    late = late_model.simulate(u)
    assert not late[:5].any()
    on_time = y[:-5]
    assert np.allclose(late[5:], on_time, atol=1e-12)
    assert late_model.order == 3 + 5 * inputs
    record = Trajectory(u=u, y=late, step_s=0.1)
    data = dataset_of(record, model.scale)
    shifted = data.shift_out_dead_time(5)
    (moved,) = shifted.training
    response = model.simulate(moved.u)
    assert np.allclose(response, moved.y, atol=1e-12)


def test_the_loop_reckons_with_the_dead_time_and_without_it_does_not_settle() -> None:
    """On the plant behind a dead time, which the simulator of delays makes, not the model that was
    designed for."""
    model = bent()
    identified_plant = IdentifiedPlant.from_model(model)
    plant = DelayedInput(plant=identified_plant, samples=LATE)
    jacobian_ball = JacobianBall.from_slopes(0.8, 1.0)
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=jacobian_ball, output=output)
    rates = {"rate_controller": 0.08, "rate_observer": 0.1}
    synthesis = RiccatiSynthesis(input_weight=0.1, **rates)
    loop = LoopExperiment(horizon_s=20.0, measurement_noise_variance=0.0)
    late_model = model.with_dead_time(LATE)
    aware_design = synthesis.design(late_model, balls)
    naive_design = synthesis.design(model, balls)
    assert aware_design.certified
    assert naive_design.certified
    stored = aware_design.to_json()
    assert failed_checks(stored, late_model.linear, balls) == []
    aware = loop.run_design(plant, late_model, aware_design, seed=0)
    assert behaviour_columns(aware)["stable_count"] == 10
    columns = certified_bound_columns(aware, aware_design)
    assert columns["certified_bound_violations"] == 0
    controller = ObserverFeedback.from_design(model, naive_design)
    naive = loop.run_on_plant(plant, controller, seed=0)
    assert behaviour_columns(naive)["stable_count"] == 0


def test_no_dead_time_is_less_than_none_or_longer_than_a_record() -> None:
    linear = Linear()
    scaffolds = {"scaffold_in": linear, "scaffold_out": linear}
    shape = {"order": 1, "hidden_width": 1, "feedthrough": False}
    slopes = {"slope_lower": 0.1, "slope_upper": 1.0}
    with pytest.raises(BadRequest, match=r"model\.dead_time = -1"):
        SSMSpec(**shape, **slopes, **scaffolds, dead_time=-1)
    u = np.zeros((9, 1))
    y = np.zeros((9, 1))
    record = Trajectory(u=u, y=y, step_s=0.1)
    data = dataset_of(record, bent().scale)
    with pytest.raises(BadRequest, match=r"model\.dead_time = 9: .*9 samples"):
        data.shift_out_dead_time(9)
