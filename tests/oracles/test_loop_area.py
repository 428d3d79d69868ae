"""The response area that ranks designs, written out sample by sample, and what it is released
from."""

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import motor_design, motor_model, motor_record, random_model

from ssm_study.certificates.theorems.integral_action import linear_output_gain
from ssm_study.models.identified import SSM
from ssm_study.signals import Trajectory
from ssm_study.synthesis.integrated_error import comparison_scenario, relative_response_areas
from ssm_study.systems import Gains, StateSpace


def record(model: SSM, samples: int = 240, seed: int = 0) -> Trajectory:
    input_equilibrium = model.scale.input_equilibrium
    rng = np.random.default_rng(seed)
    inputs = model.scale.inputs
    deviation = rng.normal(size=(samples, inputs))
    u = input_equilibrium + deviation
    outputs = model.scale.outputs
    y = np.zeros((samples, outputs))
    return Trajectory(u=u, y=y, step_s=0.01)


def visited(model: SSM, records: tuple[Trajectory, ...]) -> np.ndarray:
    states = []
    for trajectory in records:
        x = np.zeros(model.order)
        for u in trajectory.u:
            states.append(x)
            linear_a = model.linear.a
            linear_b = model.linear.b
            scaled_input = model.scale.scaled_input(u)
            mapped_input = model.scaffold_in(scaled_input)
            x = linear_a @ x + linear_b @ mapped_input
    return np.array(states)


def test_twelve_states_of_the_records_evenly_spaced() -> None:
    model = random_model(3, inputs=2, outputs=2)
    records = record(model), record(model, 110, 1)
    x0, load, _ = comparison_scenario(model, records, has_loads=False)
    states = visited(model, records)
    places = []
    for x in x0:
        distances = np.abs(states - x).max(axis=1)
        places.append(int(distances.argmin()))
    np.testing.assert_allclose(x0, states[places], atol=1e-12)
    # neither end of the record: there the model rests, or nothing follows
    last = len(states) - 1
    expected = [k * last // 13 for k in range(1, 13)]
    assert places == expected
    assert not load.any()


HORIZONS = [(0.0, 50), (0.5, 50), (0.96, 98), (0.97, 132), (0.98, 150), (1.0, 150), (1.2, 150)]


@pytest.mark.parametrize(("modulus", "samples"), HORIZONS)
def test_the_horizon_is_four_time_constants_between_50_and_150_samples(
    modulus: float, samples: int
) -> None:
    """A mode `lambda^k` falls by e in `-1 / ln |lambda|` samples."""
    model = motor_model()
    modes = [modulus, 0.0]
    a = np.diag(modes)
    b = model.linear.b
    c = model.linear.c
    d = model.linear.d
    linear = StateSpace(a=a, b=b, c=c, d=d)
    changed_model = model.with_linear_part(linear)
    validation = (motor_record(),)
    _, _, horizon = comparison_scenario(changed_model, validation, has_loads=False)
    assert horizon == samples


def test_loads_hold_a_quarter_and_half_of_an_output_scale_on_every_channel_that_acts() -> None:
    model = random_model(4, inputs=3, outputs=2)
    idle = model.linear.b.copy()
    idle[:, 1] = 0.0
    linear = replace(model.linear, b=idle)
    model = model.with_linear_part(linear)
    validation = (record(model),)
    x0, load, _ = comparison_scenario(model, validation, has_loads=True)
    loads = load[12:]
    states = x0[12:]
    first_loads = load[:12]
    assert not first_loads.any()
    assert not states.any()
    assert len(loads) == 4 * 2
    linear_a = model.linear.a
    difference = np.eye(4) - linear_a
    linear_b = model.linear.b
    drive = linear_b @ loads.T
    rest = np.linalg.solve(difference, drive)
    ubar = np.zeros((8, 3))
    scaled = model.scaled_output_at(rest.T, ubar)
    output_sizes = np.linalg.norm(scaled, axis=1)
    for channel in (0, 2):
        acting = loads[:, channel] != 0
        acting_loads = loads[acting, channel]
        directions = np.sign(acting_loads)
        signed_outputs = output_sizes[acting] * directions
        signed = np.sort(signed_outputs)
        expected = [-0.5, -0.25, 0.25, 0.5]
        np.testing.assert_allclose(signed, expected)
    idle_loads = loads[:, 1].any()
    assert not idle_loads


def by_hand(
    model: SSM, k: np.ndarray, gain: np.ndarray, x0: np.ndarray, load: np.ndarray, horizon: int
) -> float:
    """Plant and observer are the model; integrators sum the output; the load enters behind the
    scaffolding."""
    linear = model.linear
    n = model.order
    x = x0
    x_hat = np.zeros(n)
    difference = k.shape[1] - n
    z = np.zeros(difference)
    sizes = []
    for _ in range(horizon):
        state_feedback = k[:, :n] @ x_hat
        integral_feedback = k[:, n:] @ z
        drive = model.scaffold_in(state_feedback + integral_feedback)
        disturbed_drive = drive + load
        state_part = linear.c @ x
        direct_part = linear.d @ disturbed_drive
        plant_output = state_part + direct_part
        y = model.scaffold_out(plant_output)
        predicted_state_part = linear.c @ x_hat
        predicted_direct_part = linear.d @ drive
        predicted_output = predicted_state_part + predicted_direct_part
        predicted_y = model.scaffold_out(predicted_output)
        norm = float(np.linalg.norm(y))
        sizes.append(norm)
        free_motion = linear.a @ x
        x = free_motion + linear.b @ (drive + load)
        correction = gain @ (predicted_y - y)
        predicted_motion = linear.a @ x_hat
        driven_motion = linear.b @ drive
        x_hat = predicted_motion + driven_motion + correction
        integrated = y[: len(z)]
        z = z + integrated
    afters = range(horizon + 1)
    largest_after = [max(sizes[after:], default=0.0) for after in afters]
    settled = next(after for after in afters if largest_after[after] <= 0.05)
    return sum(sizes) + settled


NUMBERS_OF_INTEGRATORS = [0, 2]


@pytest.mark.parametrize("integrators", NUMBERS_OF_INTEGRATORS)
def test_the_area_is_the_loop_written_out(integrators: int) -> None:
    model = random_model(5, inputs=2, outputs=2)
    rng = np.random.default_rng(0)
    drawn_d = rng.normal(size=(2, 2))
    d = 0.3 * drawn_d
    linear = replace(model.linear, d=d)
    model = model.with_linear_part(linear)
    n = model.order
    drawn_ks = rng.normal(size=(2, 2, n + integrators))
    ks = 0.05 * drawn_ks
    drawn_ls = rng.normal(size=(2, n, 2))
    ls = 0.05 * drawn_ls
    rows_of_pairs = [[1, 0], [0, 1]]
    pairs = np.array(rows_of_pairs)
    trajectory = record(model)
    trajectory.u[60:] = model.scale.input_equilibrium  # where the record rests
    x0s, loads, horizon = comparison_scenario(model, (trajectory,), has_loads=integrators > 0)
    first = pairs[:, 0]
    k = ks[first]
    second = pairs[:, 1]
    observer_gains = ls[second]
    gains = Gains(k=k, l=observer_gains)
    response_areas = relative_response_areas(model, gains, (trajectory,))
    no_feedback = np.zeros((2, n))
    no_injection = np.zeros((n, 2))
    cases = list(zip(x0s, loads, strict=True))
    areas = [by_hand(model, no_feedback, no_injection, x0, load, horizon) for x0, load in cases]
    alone = np.array(areas)
    least = 0.1 * alone.max()
    counts = alone > least  # what rests already is no measure of a controller
    assert not counts.all()
    pairs_and_areas = zip(pairs, response_areas, strict=True)
    for (i, j), area in pairs_and_areas:
        areas = [by_hand(model, ks[i], ls[j], x0, load, horizon) for x0, load in cases]
        each = np.array(areas)
        ratios = (each / alone)[counts]
        expected = ratios.mean()
        expected_area = pytest.approx(expected, rel=1e-9)
        assert area == expected_area


def test_no_control_is_one_and_a_design_that_diverges_is_huge_and_finite() -> None:
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    no_gain = 0 * k
    feedbacks = [no_gain, k, 1e3 * k]
    ks = np.stack(feedbacks)
    injections = [gain, -1e3 * gain]
    ls = np.stack(injections)
    rows_of_pairs = [[0, 0], [1, 0], [2, 0], [1, 1]]
    pairs = np.array(rows_of_pairs)
    first = pairs[:, 0]
    ks_of_pairs = ks[first]
    second = pairs[:, 1]
    ls_of_pairs = ls[second]
    gains = Gains(k=ks_of_pairs, l=ls_of_pairs)
    validation = (motor_record(),)
    none, own, wild, blind = relative_response_areas(model, gains, validation)
    assert none == pytest.approx(1.0)
    assert own < 0.9
    is_finite = np.isfinite([wild, blind])
    assert is_finite.all()
    assert max(wild, blind) > 1e3


def test_the_output_gain_is_the_maps_own() -> None:
    model = random_model(1, inputs=2, outputs=2)
    expected = np.eye(2)
    np.testing.assert_array_equal(linear_output_gain(model), expected)
