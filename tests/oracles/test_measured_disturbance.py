"""A load that is measured and not commanded: it drives model, observer and the exported step, and
cancels in every difference."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from disturbance_cases import (
    differences_of_loops,
    far_disturbance,
    motor_log,
    random_model,
    recorded,
)

from ssm_study.bounds.reduction import Reduction
from ssm_study.data.splits import rest_segments
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale, Trajectory
from ssm_study.systems import Gains
from ssm_study.training.structured_fit import StructuredFit


@pytest.mark.parametrize("neurons", [False, True])
def test_the_difference_of_two_motions_does_not_know_the_load(neurons: bool) -> None:
    """`x+ = f(x, u) + B_d d`: one load in two motions under one input leaves their difference."""
    model = random_model(0, neurons)
    rng = np.random.default_rng(2)
    scaled_u = rng.normal(size=(60, 1))
    u = model.scale.physical_input(scaled_u)
    rng = np.random.default_rng(3)
    x0 = rng.normal(size=(2, model.order))
    d = far_disturbance(model, 60)
    if neurons:  # neurons see the state that the load moved: what is left is their slope's share
        e = 0 * model.e
        model = replace(model, e=e)
    moved = [model.simulate(u, start, d) for start in x0]
    still = [model.simulate(u, start) for start in x0]
    difference = moved[0] - moved[1]
    expected = still[0] - still[1]
    largest = np.abs(moved).max()
    atol = 1e-12 * largest
    np.testing.assert_allclose(difference, expected, atol=atol)
    effect = np.abs(moved[0] - still[0])
    largest_difference = effect.max()
    assert largest_difference > 1.0


def linear_input_model() -> SSM:
    """A random linear model whose input map is the identity."""
    model = random_model(0, neurons=False)
    identity = LinearScaffold.identity(1)
    return replace(model, scaffold_in=identity)


def test_the_difference_of_two_loops_does_not_know_the_load() -> None:
    """With linear maps the two loops' difference is the same to rounding, whatever the load."""
    model = linear_input_model()
    d = far_disturbance(model, 80)
    moved = differences_of_loops(model, d)
    still = differences_of_loops(model, None)
    np.testing.assert_allclose(moved, still, atol=1e-11)
    largest = np.abs(still[0]).max()
    assert largest > 0.1


def test_loops_with_neurons_contract_under_any_load() -> None:
    model = random_model(0, neurons=True)
    for seed in range(3):
        d = far_disturbance(model, 300, seed)
        apart = differences_of_loops(model, d, samples=300)
        norm = np.linalg.norm(apart[-1])
        initial_norm = np.linalg.norm(apart[0])
        upper_limit = 1e-4 * initial_norm
        assert norm < upper_limit


def test_the_observer_is_told_the_load() -> None:
    """From the right state the estimate stays right under any load; untold, it errs."""
    model = random_model(1, neurons=False)
    k = np.zeros((1, 3))
    gain = -0.2 * np.ones((3, 1))
    gains = Gains(k=k, l=gain)
    law = ObserverFeedback(model=model, gains=gains)
    x = np.ones((1, 3))
    informed = np.ones((1, 3))
    uninformed = np.ones((1, 3))
    no_drive = np.zeros((1, 1))
    u = model.scale.input_equilibrium[None]
    drive = model.map_input(u)
    reference = model.scale.output_equilibrium[None]
    plan = law.target_trajectory(reference)
    target = plan[0]
    for d in far_disturbance(model, 30):
        y = model.output_at(x, no_drive)
        informed = law.next_memory(informed, u, y, target, d)
        uninformed = law.next_memory(uninformed, u, y, target)
        load = model.disturbance_contribution(d)
        x = model.next_state(x, drive) + load
    np.testing.assert_allclose(informed, x, atol=1e-12)
    difference = np.abs(uninformed - x)
    largest_difference = difference.max()
    assert largest_difference > 0.1


def test_a_model_without_a_load_is_written_as_before() -> None:
    model = random_model(0, neurons=True)
    input_scale = model.scale.input_scale
    output_scale = model.scale.output_scale
    input_equilibrium = model.scale.input_equilibrium
    output_equilibrium = model.scale.output_equilibrium
    bare = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    b_d = np.zeros((0, 0))
    without = replace(model, scale=bare, b_d=b_d)
    names = set(model.to_json())
    names_without = set(without.to_json())
    expected = {"b_d", "disturbance_scale", "disturbance_equilibrium"}
    assert names - names_without == expected
    for written in (model, without):
        stored = written.to_json()
        text = json.dumps(stored)
        content = json.loads(text)
        again = model_from_json(content)
        assert again.to_json() == stored
    b_d = np.zeros((0, 0))
    with pytest.raises(BadRequest, match="b_d"):
        replace(model, b_d=b_d)


def test_reduction_leaves_a_mode_that_only_the_load_moves() -> None:
    """The mode is unreachable for `(A, B)` alone, and would be dropped."""
    model = random_model(3, neurons=False)
    a = np.diag([0.9, 0.5, 0.3])
    b = np.array([[0.0], [1.0], [1.0]])
    linear = replace(model.linear, a=a, b=b)
    scaffold_in = LinearScaffold.identity(1)
    model = replace(model, linear=linear, scaffold_in=scaffold_in)
    balanced = Reduction().reduce_model(model)
    rng = np.random.default_rng(0)
    u = rng.normal(size=(50, 1))
    d = far_disturbance(model, 50)
    assert balanced.order == 3
    actual = balanced.simulate(u, d=d)
    expected = model.simulate(u, d=d)
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    scale = no_load(model.scale)
    b_d = np.zeros((0, 0))
    changed_model = replace(model, scale=scale, b_d=b_d)
    order = Reduction().reduce_model(changed_model).order
    assert order == 2


def no_load(scale: Scale) -> Scale:
    """The scale without its disturbances."""
    disturbance_scale = np.zeros(0)
    disturbance_equilibrium = np.zeros(0)
    return replace(
        scale, disturbance_scale=disturbance_scale, disturbance_equilibrium=disturbance_equilibrium
    )


def test_a_load_acts_without_the_dead_time() -> None:
    model = linear_input_model()
    late = model.with_dead_time(4)
    input_equilibrium = model.scale.input_equilibrium
    rng = np.random.default_rng(0)
    deviation = rng.normal(size=(60, 1))
    u = input_equilibrium + deviation
    d = far_disturbance(model, 60)
    rest = np.tile(input_equilibrium, (4, 1))
    shifted = np.concatenate([rest, u[:-4]])
    actual = late.simulate(u, d=d)
    expected = model.simulate(shifted, d=d)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


def test_a_structured_model_is_trained_with_the_load(tmp_path: Path) -> None:
    """Its Jacobian is that of finite differences, and the load reaches no output and no neuron."""
    data = recorded(tmp_path, disturbance="torque").build(0)
    size = {"order": 2, "neurons": 1, "knots": 3}
    search = {"starts": 1, "draws": 1}
    spec = StructuredSpec(input_path="free", feedthrough=True, **size, **search)
    fit = StructuredFit(spec, data, 0)
    fit.start_training(4)
    theta = fit.parameter_blocks
    free = fit._trained_block_names
    r, j, turn = fit.problem.residual_and_jacobian(theta, free)
    sizes = [theta[n].size for n in free]
    running_sum = np.cumsum(sizes)
    columns = np.split(j @ turn, running_sum[:-1], 1)
    block = dict(zip(free, columns, strict=True))
    for name in ("b", "d", "g"):
        for entry in range(2):
            moved = theta[name].copy()
            moved.ravel()[entry] += 1e-6
            changed = theta | {name: moved}
            difference = fit.problem.weighted_error(changed) - r
            expected = difference / 1e-6
            if name != "b" and entry == 1:
                assert not block[name][:, entry].any()
                assert theta[name].ravel()[entry] == 0.0
            else:
                actual = block[name][:, entry]
                np.testing.assert_allclose(actual, expected, atol=1e-5)
    model = fit.as_model()
    x0 = theta["x0"][0]
    training_u = data.training[0].u
    training_d = data.training[0].d
    simulated = model.simulate(training_u, x0, training_d)
    training_y = data.training[0].y
    difference = simulated - training_y
    residual = difference / data.scale.output_scale
    records = fit.problem.records
    weight = records.weight[0]
    actual = (weight * residual).ravel()
    np.testing.assert_allclose(actual, r, atol=1e-10)
    largest = np.abs(model.b_d).max()
    assert largest > 0.0


def test_nothing_rests_while_the_load_moves() -> None:
    moving_input = [1.0] * 20
    resting_input = [0.0] * 40
    u = np.array(moving_input + resting_input)[:, None]
    y = np.zeros((60, 1))
    d = np.arange(60.0)[:, None]
    moving = Trajectory(u=u, y=y, step_s=1.0, d=d)
    d = np.ones((60, 1))
    held = replace(moving, d=d)
    assert len(rest_segments(held)) == 1
    assert rest_segments(moving) == []
    moving_d = moving[10:20].d
    actual = moving_d[:, 0]
    expected = np.arange(10.0, 20.0)
    np.testing.assert_array_equal(actual, expected)


def test_a_log_with_a_hole_and_a_set_point_keeps_its_load(tmp_path: Path) -> None:
    """Each piece has the load of its own samples, and the set point's column is no load."""
    path = motor_log(tmp_path)
    log = pd.read_csv(path)
    log.loc[450, "torque"] = np.nan
    log["wanted"] = np.roll(log.speed, 3)
    log.to_csv(tmp_path / "holes.csv", index=False)
    source = recorded(tmp_path, disturbance="torque", reference="wanted")
    path = str(tmp_path / "holes.csv")
    changed_source = replace(source, path=path)
    data = changed_source.build(0)
    records = (*data.training, *data.validation, *data.test)
    names = [channel.name for channel in data.disturbances]
    assert names == ["torque"]
    for record in records:
        first = record.first
        last = first + len(record)
        expected = log.torque.to_numpy()[first:last]
        actual = record.d[:, 0]
        np.testing.assert_array_equal(actual, expected)
    disturbance_equilibrium = data.scale.disturbance_equilibrium
    loads = [record.d for record in data.training]
    mean = np.concatenate(loads).mean()
    assert disturbance_equilibrium == pytest.approx(mean)
