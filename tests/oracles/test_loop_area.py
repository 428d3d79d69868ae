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
    u = input_equilibrium + rng.normal(size=(samples, inputs))
    outputs = model.scale.outputs
    y = np.zeros((samples, outputs))
    return Trajectory(u=u, y=y, step_s=0.01)


def visited(model: SSM, records: tuple[Trajectory, ...]) -> np.ndarray:
    states = []
    for one in records:
        x = np.zeros(model.order)
        for u in one.u:
            states.append(x)
            linear_a = model.linear.a
            linear_b = model.linear.b
            scaled_input = model.scale.scaled_input(u)
            x = linear_a @ x + linear_b @ model.scaffold_in(scaled_input)
    return np.array(states)


def test_twelve_states_of_the_records_evenly_spaced() -> None:
    model = random_model(3, inputs=2, outputs=2)
    records = record(model), record(model, 110, 1)
    x0, load, _ = comparison_scenario(model, records, has_loads=False)
    states = visited(model, records)
    found = [int(np.abs(states - x).max(axis=1).argmin()) for x in x0]
    np.testing.assert_allclose(x0, states[found], atol=1e-12)
    # neither end of the record: there the model rests, or nothing follows
    expected = [(k * (len(states) - 1)) // 13 for k in range(1, 13)]
    assert found == expected
    assert not load.any()


@pytest.mark.parametrize(
    ("modulus", "samples"),
    [(0.0, 50), (0.5, 50), (0.96, 98), (0.97, 132), (0.98, 150), (1.0, 150), (1.2, 150)],
)
def test_the_horizon_is_four_time_constants_between_50_and_150_samples(
    modulus: float, samples: int
) -> None:
    """A mode `lambda^k` falls by e in `-1 / ln |lambda|` samples."""
    model = motor_model()
    a = np.diag([modulus, 0.0])
    b = model.linear.b
    c = model.linear.c
    d = model.linear.d
    linear = StateSpace(a=a, b=b, c=c, d=d)
    changed_model = model.with_linear_part(linear)
    assert comparison_scenario(changed_model, (motor_record(),), has_loads=False)[2] == samples


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
    assert not load[:12].any()
    assert not states.any()
    assert len(loads) == 4 * 2
    linear_a = model.linear.a
    difference = np.eye(4) - linear_a
    linear_b = model.linear.b
    rest = np.linalg.solve(difference, linear_b @ loads.T)
    ubar = np.zeros((8, 3))
    scaled = model.scaled_output_at(rest.T, ubar)
    held = np.linalg.norm(scaled, axis=1)
    for channel in (0, 2):
        acting = loads[:, channel] != 0
        directions = np.sign(loads[acting, channel])
        signed = np.sort(held[acting] * directions)
        expected = [-0.5, -0.25, 0.25, 0.5]
        np.testing.assert_allclose(signed, expected)
    assert not loads[:, 1].any()


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
        drive = model.scaffold_in(state_feedback + k[:, n:] @ z)
        disturbed_drive = drive + load
        plant_output = linear.c @ x + linear.d @ (disturbed_drive)
        y = model.scaffold_out(plant_output)
        predicted_output = linear.c @ x_hat + linear.d @ drive
        seen = model.scaffold_out(predicted_output)
        norm = float(np.linalg.norm(y))
        sizes.append(norm)
        x = linear.a @ x + linear.b @ (drive + load)
        correction = gain @ (seen - y)
        x_hat = linear.a @ x_hat + linear.b @ drive + correction
        z = z + y[: len(z)]
    afters = range(horizon + 1)
    settled = next(after for after in afters if max(sizes[after:], default=0.0) <= 0.05)
    return sum(sizes) + settled


@pytest.mark.parametrize("integrators", [0, 2])
def test_the_area_is_the_loop_written_out(integrators: int) -> None:
    model = random_model(5, inputs=2, outputs=2)
    rng = np.random.default_rng(0)
    d = 0.3 * rng.normal(size=(2, 2))
    linear = replace(model.linear, d=d)
    model, n = model.with_linear_part(linear), model.order
    ks = 0.05 * rng.normal(size=(2, 2, n + integrators))
    ls = 0.05 * rng.normal(size=(2, n, 2))
    pairs = np.array([[1, 0], [0, 1]])
    given = record(model)
    given.u[60:] = model.scale.input_equilibrium  # where the record rests
    x0s, loads, horizon = comparison_scenario(model, (given,), has_loads=integrators > 0)
    k = ks[pairs[:, 0]]
    observer_gains = ls[pairs[:, 1]]
    gains = Gains(k=k, l=observer_gains)
    found = relative_response_areas(model, gains, (given,))
    none = np.zeros((2, n)), np.zeros((n, 2))
    cases = list(zip(x0s, loads, strict=True))
    areas = [by_hand(model, *none, x0, load, horizon) for x0, load in cases]
    alone = np.array(areas)
    counts = alone > 0.1 * alone.max()  # what rests already is no measure of a controller
    assert not counts.all()
    for (i, j), area in zip(pairs, found, strict=True):
        areas = [by_hand(model, ks[i], ls[j], x0, load, horizon) for x0, load in cases]
        each = np.array(areas)
        expected = (each / alone)[counts].mean()
        assert area == pytest.approx(expected, rel=1e-9)


def test_no_control_is_one_and_a_design_that_diverges_is_huge_and_finite() -> None:
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    no_gain = 0 * k
    ks = np.stack([no_gain, k, 1e3 * k])
    ls = np.stack([gain, -1e3 * gain])
    pairs = np.array([[0, 0], [1, 0], [2, 0], [1, 1]])
    ks_of_pairs = ks[pairs[:, 0]]
    gains = Gains(k=ks_of_pairs, l=ls[pairs[:, 1]])
    validation = (motor_record(),)
    none, own, wild, blind = relative_response_areas(model, gains, validation)
    assert none == pytest.approx(1.0)
    assert own < 0.9
    assert np.isfinite([wild, blind]).all()
    assert max(wild, blind) > 1e3


def test_the_output_gain_is_the_maps_own() -> None:
    model = random_model(1, inputs=2, outputs=2)
    expected = np.eye(2)
    np.testing.assert_array_equal(linear_output_gain(model), expected)
