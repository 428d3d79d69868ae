"""Laws of the loop: a batch is its rows, the seed decides the draw, and what the controller sees is
what it acts on."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor, motor_design, motor_model, random_model

from ssm_study.loop.controller import ObserverFeedback, Uncontrolled
from ssm_study.loop.metrics import behaviour_columns, certificate_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import IdentifiedPlant, Loop
from ssm_study.loop.rollout import STAYED, simulate_closed_loop
from ssm_study.plants.disturbance import PeriodicDisturbance, StepDisturbance

LOOP = Loop(horizon_s=0.6, measurement_noise_variance=0.02, initial_conditions=5)


def controller() -> ObserverFeedback:
    return ObserverFeedback.from_design(motor_model(), motor_design())


REFERENCES = [
    StepReference(before=0.0, after=6.0, at_s=0.2),
    PeriodicDisturbance(amplitude=4.0, frequency_hz=2.0),
]


@pytest.mark.parametrize("reference", REFERENCES)
def test_a_batch_is_its_rows(reference):
    loop = Loop(
        horizon_s=0.6, measurement_noise_variance=0.02, initial_conditions=5, reference=reference
    )
    y0, noise = loop.draw_starts_and_noise(motor(), seed=1)
    together = loop.simulate(motor(), controller(), y0, noise)
    for i in range(len(y0)):
        one_start = y0[i : i + 1]
        one_noise = noise[i : i + 1]
        alone = loop.simulate(motor(), controller(), one_start, one_noise)
        for name in ("u", "y", "measured", "estimate", "states"):
            actual = getattr(together, name)[i]
            expected = getattr(alone, name)[0]
            np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-12)


def test_the_loop_is_the_equations_written_out():
    """One case, sample by sample, from the model's numbers alone: the second route to every
    signal."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    observer_gain = design.observer.l
    y0, noise = LOOP.draw_starts_and_noise(motor(), seed=3)
    run = LOOP.simulate(motor(), controller(), y0[:1], noise[:1])
    x = motor().equilibrium_states(y0[:1])
    x_hat = np.zeros(model.order)
    for sample in range(run.u.shape[1]):
        y = x[0, 2] + noise[0, sample, 0]
        u = 1.7 * float((k @ x_hat)[0])
        assert run.u[0, sample, 0] == pytest.approx(u, rel=1e-9, abs=1e-12)
        assert run.measured[0, sample, 0] == pytest.approx(y, rel=1e-9, abs=1e-12)
        expected = x[0, 2]
        assert run.y[0, sample, 0] == pytest.approx(expected, rel=1e-9, abs=1e-12)
        scaled_input = np.array([u / 1.7])
        lifted = float(model.scaffold_in(scaled_input)[0])
        linear_c = model.linear.c
        error = float((linear_c @ x_hat)[0]) - y / 5.0
        linear_a = model.linear.a
        linear_b = model.linear.b
        driven = linear_a @ x_hat + linear_b[:, 0] * lifted
        x_hat = driven + observer_gain[:, 0] * error
        applied = np.array([[u]])
        no_disturbance = np.zeros((1, 1))
        x = motor().advance(x, applied, no_disturbance)


def test_the_seed_decides_the_draw_and_nothing_else_does():
    first, again, other = (LOOP.draw_starts_and_noise(motor(), seed=s) for s in (4, 4, 5))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])
    low, high = motor().initial_range
    assert (first[0] >= low).all()
    assert (first[0] <= high).all()


def test_noise_has_the_stated_variance():
    loop = Loop(horizon_s=5.0, measurement_noise_variance=0.02, initial_conditions=100)
    conditions = loop.draw_starts_and_noise(motor(), seed=0)
    noise = conditions[1]
    assert noise.var() == pytest.approx(0.02, rel=0.02)


def test_limits_hold_and_the_observer_knows_them():
    limited = Loop(
        horizon_s=0.6,
        measurement_noise_variance=0.0,
        initial_conditions=5,
        input_lower=-1.0,
        input_upper=0.5,
    )
    result = limited.run_design(motor(), motor_model(), motor_design(), seed=1)
    smallest = result.controlled.u.min()
    assert smallest == -1.0
    largest = result.controlled.u.max()
    assert largest == 0.5
    free = LOOP.run_design(motor(), motor_model(), motor_design(), seed=1)
    controlled_u = free.controlled.u
    largest = np.abs(controlled_u).max()
    assert largest > 1.0


def test_the_disturbance_reaches_the_plant_and_not_the_model():
    disturbance = StepDisturbance(size=0.02, at_s=0.3)
    pushed = Loop(
        horizon_s=0.6, measurement_noise_variance=0.0, initial_conditions=3, disturbance=disturbance
    )
    quiet = Loop(horizon_s=0.6, measurement_noise_variance=0.0, initial_conditions=3)
    loops = (pushed, quiet)
    a, b = (loop.run_design(motor(), motor_model(), motor_design(), seed=2) for loop in loops)
    controlled_y = a.controlled.y
    actual = controlled_y[:, :31]
    controlled_y = b.controlled.y
    expected = controlled_y[:, :31]
    np.testing.assert_array_equal(actual, expected)
    controlled_y = a.controlled.y
    upper_limit = b.controlled.y[:, 40] - 0.05
    assert (controlled_y[:, 40] < upper_limit).all()
    actual = a.on_model.y
    expected = b.on_model.y
    np.testing.assert_array_equal(actual, expected)


def test_the_model_in_the_plants_place_replays_itself():
    model = random_model(0, inputs=2, outputs=2)
    plant = IdentifiedPlant.from_model(model)
    input_equilibrium = model.scale.input_equilibrium
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((3, 40, 2))
    u = input_equilibrium + white_noise
    actual = plant.simulate(u)[1]
    expected = model.simulate(u)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)
    output_equilibrium = model.scale.output_equilibrium
    offsets = np.array([[0.3, -0.2], [1.0, 1.0]])
    y0 = output_equilibrium + offsets
    actual = plant.output(plant.equilibrium_states(y0))
    np.testing.assert_allclose(actual, y0, rtol=1e-9)


def test_the_units_of_input_and_output_change_nothing():
    """A pressure of 1e6 Pa is no input out of hand; the loop of a rescaled model is the rescaled
    loop."""
    ends = []
    for unit in (1.0, 1e9, 1e-9):
        scale = motor_model().scale
        input_scale = unit * scale.input_scale
        output_scale = unit * scale.output_scale
        changed_scale = replace(scale, input_scale=input_scale, output_scale=output_scale)
        model = replace(motor_model(), scale=changed_scale)
        plant = IdentifiedPlant.from_model(model)
        loop = Loop(initial_conditions=3, horizon_s=1.0)
        law = ObserverFeedback.from_design(model, motor_design())
        loop_runs = loop.run_on_plant(plant, law, 0)
        kept = loop_runs.controlled
        assert (kept.left_at_sample == STAYED).all()
        ends.append(kept.y / unit)
    for other in ends[1:]:
        np.testing.assert_allclose(other, ends[0], rtol=1e-6, atol=1e-9)


def test_a_case_that_starts_beyond_the_bound_shows_its_start_and_no_input():
    model = random_model(0, order=3)
    input_equilibrium = np.array([0.7])
    scale = replace(model.scale, input_equilibrium=input_equilibrium)
    model = replace(model, scale=scale)
    plant = IdentifiedPlant.from_model(model)
    x0 = np.array([[1e3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    noise = np.full((2, 5, 1), 0.01)
    reference = np.zeros((5, 1))
    disturbance = np.zeros((2, 5, 1))
    asked = {"x0": x0, "reference": reference, "noise": noise, "disturbance": disturbance}
    bound = np.full(1, 10.0)
    uncontrolled = Uncontrolled.for_plant(plant)
    run = simulate_closed_loop(plant, uncontrolled, **asked, bound=bound)
    expected = [0, STAYED]
    assert run.left_at_sample.tolist() == expected
    start = plant.output(x0)
    equilibrium = plant.equilibrium()
    difference = np.abs(start[0] - equilibrium.y)
    assert difference > 10
    for found, shown in (
        (run.u, [[0.7]]),
        (run.y, start),
        (run.measured, start + 0.01),
        (run.states, x0),
    ):
        expected = np.tile(shown[0], (5, 1))
        np.testing.assert_array_equal(found[0], expected)


def test_every_column_is_a_number_or_nothing():
    result = LOOP.run_design(motor(), motor_model(), motor_design(), seed=0)
    columns = behaviour_columns(result) | certificate_columns(result, motor_design())
    is_number = [value is None or np.isfinite(value) for value in columns.values()]
    assert all(is_number)
    assert columns["initial_conditions"] == 5
    assert columns["certified_bound_violations"] == 0
    rate = motor_design().observer.rate
    lower_limit = rate * (1 - 1e-9)
    assert columns["estimate_decay_rate"] >= lower_limit
    assert 0 <= columns["certified_bound_excess_plant"] < 1
    left_at_sample = result.controlled.left_at_sample
    assert (left_at_sample == STAYED).all()
