"""Laws of the loop: a batch is its rows, the seed decides the draw, and what the controller sees is
what it acts on."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor, motor_design, motor_model, random_model

from ssm_study.loop.controller import NoControl, ObserverFeedback
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.reference import StepReference
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.rollout import STAYED, simulate_closed_loop
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.plants.disturbance import PeriodicDisturbance, StepDisturbance
from ssm_study.systems import StateSpace

LOOP = LoopExperiment(horizon_s=0.6, measurement_noise_variance=0.02, initial_conditions=5)


def controller() -> ObserverFeedback:
    return ObserverFeedback.from_design(motor_model(), motor_design())


STEP_UP = StepReference(before=0.0, after=6.0, at_s=0.2)
SINE = PeriodicDisturbance(amplitude=4.0, frequency_hz=2.0)
REFERENCES = [STEP_UP, SINE]
SIGNALS = ("u", "y", "measured", "estimate", "states")


@pytest.mark.parametrize("reference", REFERENCES)
def test_a_batch_is_its_rows(reference):
    loop = LoopExperiment(
        horizon_s=0.6, measurement_noise_variance=0.02, initial_conditions=5, reference=reference
    )
    y0, noise = loop.draw_starts_and_noise(motor(), seed=1)
    together = loop.simulate(motor(), controller(), y0, noise)
    for i in range(len(y0)):
        one_start = y0[i : i + 1]
        one_noise = noise[i : i + 1]
        alone = loop.simulate(motor(), controller(), one_start, one_noise)
        for name in SIGNALS:
            signals_together = getattr(together, name)
            actual = signals_together[i]
            signals_alone = getattr(alone, name)
            expected = signals_alone[0]
            np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-12)


def test_the_loop_is_the_equations_written_out():
    """One case, sample by sample, from the model's numbers alone: the second route to every
    signal."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    observer_gain = design.observer.l
    y0, noise = LOOP.draw_starts_and_noise(motor(), seed=3)
    first_start = y0[:1]
    first_noise = noise[:1]
    run = LOOP.simulate(motor(), controller(), first_start, first_noise)
    x = motor().equilibrium_states(first_start)
    x_hat = np.zeros(model.order)
    samples = run.u.shape[1]
    for sample in range(samples):
        true_output = x[0, 2]
        noise_now = noise[0, sample, 0]
        y = true_output + noise_now
        feedback = (k @ x_hat)[0]
        u = 1.7 * float(feedback)
        expected_u = pytest.approx(u, rel=1e-9, abs=1e-12)
        assert run.u[0, sample, 0] == expected_u
        expected_measurement = pytest.approx(y, rel=1e-9, abs=1e-12)
        assert run.measured[0, sample, 0] == expected_measurement
        expected_y = pytest.approx(x[0, 2], rel=1e-9, abs=1e-12)
        assert run.y[0, sample, 0] == expected_y
        scaled_input = np.array([u / 1.7])
        lifted_inputs = model.scaffold_in(scaled_input)
        lifted = float(lifted_inputs[0])
        linear_c = model.linear.c
        error = float((linear_c @ x_hat)[0]) - y / 5.0
        linear_a = model.linear.a
        linear_b = model.linear.b
        input_part = linear_b[:, 0]
        driven = linear_a @ x_hat + input_part * lifted
        correction = observer_gain[:, 0]
        x_hat = driven + correction * error
        applied = np.array([[u]])
        no_disturbance = np.zeros((1, 1))
        x = motor().next_states(x, applied, no_disturbance)


def test_the_seed_decides_the_draw_and_nothing_else_does():
    first = LOOP.draw_starts_and_noise(motor(), seed=4)
    again = LOOP.draw_starts_and_noise(motor(), seed=4)
    other = LOOP.draw_starts_and_noise(motor(), seed=5)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    is_the_same = np.array_equal(first[0], other[0])
    assert not is_the_same
    low, high = motor().initial_range
    assert (first[0] >= low).all()
    assert (first[0] <= high).all()


def test_noise_has_the_stated_variance():
    loop = LoopExperiment(horizon_s=5.0, measurement_noise_variance=0.02, initial_conditions=100)
    conditions = loop.draw_starts_and_noise(motor(), seed=0)
    noise = conditions[1]
    variance = noise.var()
    expected = pytest.approx(0.02, rel=0.02)
    assert variance == expected


def test_limits_hold_and_the_observer_knows_them():
    limited = LoopExperiment(
        horizon_s=0.6,
        measurement_noise_variance=0.0,
        initial_conditions=5,
        input_lower=-1.0,
        input_upper=0.5,
    )
    result = limited.run_design(motor(), motor_model(), motor_design(), seed=1)
    inputs = result.controlled.u
    smallest = inputs.min()
    assert smallest == -1.0
    largest = inputs.max()
    assert largest == 0.5
    free = LOOP.run_design(motor(), motor_model(), motor_design(), seed=1)
    controlled_u = free.controlled.u
    sizes = np.abs(controlled_u)
    largest = sizes.max()
    assert largest > 1.0


def test_the_disturbance_reaches_the_plant_and_not_the_model():
    disturbance = StepDisturbance(size=0.02, at_s=0.3)
    pushed = LoopExperiment(
        horizon_s=0.6, measurement_noise_variance=0.0, initial_conditions=3, disturbance=disturbance
    )
    quiet = LoopExperiment(horizon_s=0.6, measurement_noise_variance=0.0, initial_conditions=3)
    pushed_runs = pushed.run_design(motor(), motor_model(), motor_design(), seed=2)
    quiet_runs = quiet.run_design(motor(), motor_model(), motor_design(), seed=2)
    pushed_y = pushed_runs.controlled.y
    quiet_y = quiet_runs.controlled.y
    actual = pushed_y[:, :31]
    expected = quiet_y[:, :31]
    np.testing.assert_array_equal(actual, expected)
    upper_limit = quiet_y[:, 40] - 0.05
    is_pushed = pushed_y[:, 40] < upper_limit
    assert is_pushed.all()
    actual = pushed_runs.on_model.y
    expected = quiet_runs.on_model.y
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
    rows = [[0.3, -0.2], [1.0, 1.0]]
    offsets = np.array(rows)
    y0 = output_equilibrium + offsets
    states = plant.equilibrium_states(y0)
    actual = plant.output(states)
    np.testing.assert_allclose(actual, y0, rtol=1e-9)


def crane_swing(gain_at_rest: float) -> SSM:
    """Swing of a load under the speed of its trolley: one lightly damped mode of given gain at
    rest."""
    damped_cosine = 0.9738
    damped_sine = 0.2178
    first_row = [damped_cosine, damped_sine]
    second_row = [-damped_sine, damped_cosine]
    a = np.array([first_row, second_row])
    b = np.array([[0.0], [0.1]])
    motionless = np.eye(2) - a
    at_rest = np.linalg.solve(motionless, b)[:, 0]
    across = np.array([-at_rest[1], at_rest[0]])
    power = at_rest @ at_rest
    along = at_rest / power
    c = across + gain_at_rest * along
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c[None], d=d)
    identity = LinearScaffold.identity(1)
    model = random_model(0, order=2)
    return replace(model, linear=linear, scaffold_in=identity)


@pytest.mark.parametrize("gain_at_rest", [0.0, 1e-4, 0.5])
def test_a_loop_starts_where_the_plant_can_be(gain_at_rest):
    """No input of the records holds a crane's load away from its rest: the loop then starts from
    the smallest state with that output, not from the equilibrium of a thousandfold input."""
    model = crane_swing(gain_at_rest)
    plant = IdentifiedPlant.from_model(model)
    scale = model.scale
    highest = scale.output_equilibrium + scale.output_scale
    y0 = highest[None]
    state = plant.equilibrium_states(y0)
    output = plant.output(state)
    np.testing.assert_allclose(output, y0, rtol=1e-9)
    linear_c = model.linear.c
    pseudo_inverse = np.linalg.pinv(linear_c)
    smallest = pseudo_inverse[:, 0]
    is_smallest = np.allclose(state[0], smallest)
    assert is_smallest is (gain_at_rest < 0.1)


def test_the_units_of_input_and_output_change_nothing():
    """A pressure of 1e6 Pa is no input out of hand; the loop of a rescaled model is the rescaled
    loop."""
    ends = []
    units = (1.0, 1e9, 1e-9)
    for unit in units:
        scale = motor_model().scale
        input_scale = unit * scale.input_scale
        output_scale = unit * scale.output_scale
        changed_scale = replace(scale, input_scale=input_scale, output_scale=output_scale)
        model = replace(motor_model(), scale=changed_scale)
        plant = IdentifiedPlant.from_model(model)
        loop = LoopExperiment(initial_conditions=3, horizon_s=1.0)
        law = ObserverFeedback.from_design(model, motor_design())
        loop_runs = loop.run_on_plant(plant, law, 0)
        run = loop_runs.controlled
        has_stayed = run.left_at_sample == STAYED
        assert has_stayed.all()
        ends.append(run.y / unit)
    for other in ends[1:]:
        np.testing.assert_allclose(other, ends[0], rtol=1e-6, atol=1e-9)


def test_a_case_that_starts_beyond_the_bound_shows_its_start_and_no_input():
    model = random_model(0, order=3)
    input_equilibrium = np.array([0.7])
    scale = replace(model.scale, input_equilibrium=input_equilibrium)
    model = replace(model, scale=scale)
    plant = IdentifiedPlant.from_model(model)
    far_start = [1e3, 0.0, 0.0]
    x0 = np.array([far_start, [0.0, 0.0, 0.0]])
    noise_shape = (2, 5, 1)
    noise = np.full(noise_shape, 0.01)
    reference = np.zeros((5, 1))
    disturbance = np.zeros(noise_shape)
    signals = {"reference": reference, "noise": noise, "disturbance": disturbance}
    bound = np.full(1, 10.0)
    uncontrolled = NoControl.for_plant(plant)
    run = simulate_closed_loop(plant, uncontrolled, initial_states=x0, bound=bound, **signals)
    expected = [0, STAYED]
    assert run.left_at_sample.tolist() == expected
    start = plant.output(x0)
    equilibrium = plant.equilibrium()
    difference = np.abs(start[0] - equilibrium.y)
    assert difference > 10
    resting_input = [[0.7]]
    measured_start = (run.measured, start + 0.01)
    rows = ((run.u, resting_input), (run.y, start), measured_start, (run.states, x0))
    for signal, expected_signal in rows:
        samples = (5, 1)
        expected = np.tile(expected_signal[0], samples)
        np.testing.assert_array_equal(signal[0], expected)


def test_every_column_is_a_number_or_nothing():
    result = LOOP.run_design(motor(), motor_model(), motor_design(), seed=0)
    columns_of_certificate = certified_bound_columns(result, motor_design())
    columns = behaviour_columns(result) | columns_of_certificate
    values = columns.values()
    is_number = [value is None or np.isfinite(value) for value in values]
    assert all(is_number)
    assert columns["initial_conditions"] == 5
    assert columns["certified_bound_violations"] == 0
    rate = motor_design().observer.rate
    lower_limit = rate * (1 - 1e-9)
    assert columns["estimate_decay_rate"] >= lower_limit
    assert 0 <= columns["certified_bound_excess_plant"] < 1
    left_at_sample = result.controlled.left_at_sample
    assert (left_at_sample == STAYED).all()
