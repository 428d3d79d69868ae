"""Set points and trajectories: what is planned is a trajectory of the model, and the loop converges
to it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import motor, motor_design, motor_model, random_model

from ssm_study.bounds.network import Network
from ssm_study.loop.reference import FileReference, StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.trajectory import (
    find_map_arguments,
    reference_tracking_trajectory,
    scaled_equilibrium,
    set_point_equilibria,
)
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance
from ssm_study.refusal import BadRequest


@given(st.integers(0, 1000), st.floats(-50, 50))
def test_scalar_inverse_undoes_the_map(seed, v):
    scaffold = random_model(seed).scaffold_in
    w = scaffold(np.array([[v]]))
    actual = find_map_arguments(scaffold, w)
    expected = [[v]]
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


def test_inverse_of_a_map_with_several_channels():
    rng = np.random.default_rng(0)
    model = random_model(3, inputs=3, outputs=2)
    v = rng.standard_normal((20, 3))
    w = model.scaffold_in(v)
    actual = find_map_arguments(model.scaffold_in, w)
    np.testing.assert_allclose(actual, v, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("inputs", [1, 3])
@pytest.mark.parametrize("size", [1e-13, 1e-17])
def test_what_is_left_of_zero_by_rounding_is_reached(inputs, size):
    scaffold = random_model(3, inputs=inputs, outputs=1).scaffold_in
    w = np.full((1, inputs), size)
    matrix = find_map_arguments(scaffold, w)
    largest = np.abs(matrix).max()
    assert largest < 1e-11


def test_a_value_the_map_does_not_reach_is_refused():
    two_equal = np.array([[1.0], [1.0]])
    difference_of_both = np.array([[1.0, -1.0]])
    weights = (two_equal, difference_of_both)
    biases = (np.array([0.0, 1.0]),)
    negative_slopes = (np.zeros(2),)
    positive_slopes = (np.ones(2),)
    flat = Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )
    scaffold = MlpScaffold(network=flat)
    w = np.array([[5.0]])
    with pytest.raises(BadRequest, match="does not reach"):
        find_map_arguments(scaffold, w)


@pytest.mark.parametrize("seed", range(4))
def test_an_equilibrium_is_one(seed):
    inputs = 1 + seed // 2
    model = random_model(seed, inputs=inputs, outputs=1)
    output_equilibrium = model.scale.output_equilibrium
    y = output_equilibrium + 0.7 * model.scale.output_scale
    x, u = scaled_equilibrium(model, y)
    lifted = model.scaffold_in(u)
    actual = model.next_state(x, lifted)
    np.testing.assert_allclose(actual, x, atol=1e-9)
    actual = model.output_at(x, lifted)
    np.testing.assert_allclose(actual, y, rtol=1e-9)


def test_a_planned_trajectory_is_the_models_own_and_near():
    model = motor_model()
    time_s = np.arange(300) * 0.01
    sine = np.sin(2 * np.pi * time_s)
    reference = (4 * sine)[:, None]
    plan = reference_tracking_trajectory(model, reference)
    x = plan[:, :2]
    u = plan[:, 2:]
    actual = x[1:]
    drive = model.scaffold_in(u[:-1])
    expected = model.next_state(x[:-1], drive)
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    y = model.output_at(x, model.scaffold_in(u))
    difference = np.abs(y - reference)
    largest = difference[20:].max()
    assert largest < 1.0


def test_no_other_trajectory_costs_less():
    """The plan is the minimum of what it says it minimises: every small change of the inputs costs
    more."""
    model = random_model(2, inputs=2, outputs=2)
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((60, 2))
    walk = np.cumsum(0.1 * white_noise, axis=0)
    output_equilibrium = model.scale.output_equilibrium
    resting = np.tile(walk[-1], (150, 1))
    reference = output_equilibrium + np.concatenate([walk, resting])  # ends at rest
    plan = reference_tracking_trajectory(model, reference)
    v = model.scaffold_in(plan[:, model.order :])
    target = model.scale.scaled_output(reference)

    def cost(inputs: np.ndarray) -> float:
        y, _ = model.linear.simulate(inputs, plan[0, : model.order])
        differences = np.diff(inputs, axis=0, prepend=0)
        output_cost = ((y - target) ** 2).sum()
        input_cost = (differences**2).sum()
        return float(output_cost + input_cost)

    for _ in range(5):
        step = np.zeros_like(v)
        step[:60] = rng.standard_normal((60, 2))
        ahead = cost(v + 1e-4 * step)
        behind = cost(v - 1e-4 * step)
        difference = ahead - behind
        slope = difference / 2e-4
        assert abs(slope) < 1e-6
        assert cost(v + 0.05 * step) > cost(v)


def test_the_loop_converges_to_any_planned_trajectory_of_its_model():
    model = motor_model()
    identified_plant = IdentifiedPlant.from_model(model)
    initial_range = (-4.0, 4.0)
    plant = replace(identified_plant, initial_range=initial_range)
    reference = PeriodicDisturbance(amplitude=4.0, frequency_hz=1.0)
    loop = LoopExperiment(horizon_s=4.0, measurement_noise_variance=0.0, reference=reference)
    loop_runs = loop.run_design(plant, model, motor_design(), seed=0)
    run = loop_runs.controlled
    plan = reference_tracking_trajectory(model, run.reference)
    drive = model.scaffold_in(plan[:, 2:])
    target = model.output_at(plan[:, :2], drive)
    difference = np.abs(run.y - target)
    largest = difference[:, 300:].max()
    assert largest < 1e-3
    difference = np.abs(run.y - target)
    largest = difference[:, 0].max()
    assert largest > 1.0


@pytest.mark.parametrize("speed", [-6.0, 8.0])
def test_the_true_motor_reaches_a_set_speed_within_what_the_model_misses(speed):
    reference = StepReference(before=0.0, after=speed, at_s=0.5)
    loop = LoopExperiment(horizon_s=3.0, measurement_noise_variance=0.0, reference=reference)
    loop_runs = loop.run_design(motor(), motor_model(), motor_design(), seed=0)
    run = loop_runs.controlled
    assert run.stayed_within_bound.all()
    last_output = run.y[:, -1, 0]
    difference = np.abs(last_output - speed)
    largest_difference = difference.max()
    assert largest_difference < 1.5


def test_set_points_hold_each_value():
    model = motor_model()
    levels = [[1.0], [-3.0], [1.0]]
    reference = np.repeat(levels, 5, axis=0)
    points = set_point_equilibria(model, reference)
    for k in (0, 7, 14):
        expected = np.concatenate(scaled_equilibrium(model, reference[k]))
        np.testing.assert_allclose(points[k], expected)


def test_reference_signals(tmp_path):
    time_s = np.array([0.0, 0.5, 1.0, 1.5])
    step_reference = StepReference(before=1.0, after=3.0, at_s=0.5)
    actual = step_reference.signal(time_s)
    expected = [1, 3, 3, 3]
    np.testing.assert_allclose(actual, expected)
    ramp_disturbance = RampDisturbance(slope_per_s=2.0, from_s=0.5, until_s=1.0)
    actual = ramp_disturbance.signal(time_s)
    expected = [0, 0, 1, 1]
    np.testing.assert_allclose(actual, expected)
    periodic_disturbance = PeriodicDisturbance(amplitude=2.0, frequency_hz=0.5)
    actual = periodic_disturbance.signal(time_s)
    expected = [0, 2, 0, -2]
    np.testing.assert_allclose(actual, expected, atol=1e-12)
    path = tmp_path / "reference.csv"
    path.write_text("# time, offset\n0.25,1\n\n0.75,3\n")
    file_reference = FileReference(path=str(path))
    actual = file_reference.signal(time_s)
    expected = [1, 2, 3, 3]
    np.testing.assert_allclose(actual, expected)


def test_a_reference_without_equilibrium_is_refused():
    model = random_model(0, inputs=1, outputs=2)
    output_equilibrium = model.scale.output_equilibrium
    y = output_equilibrium + np.array([1.0, -1.0])
    with pytest.raises(BadRequest, match="no constant input"):
        scaled_equilibrium(model, y)


def test_rest_is_planned_as_rest():
    reference = np.zeros((50, 1))
    plan = reference_tracking_trajectory(motor_model(), reference)
    assert not plan.any()


def test_a_planned_step_ends_at_its_set_point():
    model = motor_model()
    levels = [[0.0], [5.0]]
    reference = np.repeat(levels, 300, axis=0)
    plan = reference_tracking_trajectory(model, reference)
    actual = plan[-1]
    y = np.array([5.0])
    expected = np.concatenate(scaled_equilibrium(model, y))
    np.testing.assert_allclose(actual, expected, atol=1e-6)
    np.testing.assert_allclose(plan[0], 0, atol=1e-3)
