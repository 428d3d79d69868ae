"""The other plants against published figures and against scipy's integrator."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from plants_cases import from_yaml
from scipy.integrate import solve_ivp

from ssm_study.loop import regulation
from ssm_study.loop.controller import Controller
from ssm_study.plants.cascaded_tanks import CascadedTanks
from ssm_study.plants.disturbance import StepDisturbance
from ssm_study.plants.stribeck_drive import StribeckDrive
from ssm_study.refusal import BadRequest


def test_quadruple_tank_rests_where_johansson_says_with_his_time_constants() -> None:
    plant = from_yaml("plant", "quadruple_tank")
    rest = plant.equilibrium()
    expected = [12.4, 12.7, 1.8, 1.4]
    np.testing.assert_allclose(rest.x, expected, rtol=0.1)  # table 2, measured levels
    areas = np.array(plant.area_cm2)
    outlets = np.array(plant.outlet_cm2)
    area_ratio = areas / outlets
    fall_times = np.sqrt(2 * rest.x / 981.0)
    t = area_ratio * fall_times
    expected = [62, 90, 23, 30]
    np.testing.assert_allclose(t, expected, rtol=0.06)
    bumps = rest.x + 0.01 * np.eye(4)
    resting_inputs = np.tile(rest.u, (4, 1))
    no_load = np.zeros((4, 2))
    after_a_step = plant.next_states(bumps, resting_inputs, no_load)
    bumped = after_a_step - rest.x
    actual = np.diag(bumped) / 0.01
    decay = -plant.step_s / t
    expected = np.exp(decay)
    np.testing.assert_allclose(actual, expected, rtol=2e-3)


def test_quadruple_tank_agrees_with_a_general_solver() -> None:
    plant = from_yaml("plant", "quadruple_tank")
    row_of_u = [2.2, 3.7]
    u = np.array([row_of_u])
    row_of_d = [3.0, -2.0]
    d = np.array([row_of_d])
    area = np.array(plant.area_cm2)
    out = np.array(plant.outlet_cm2)
    k = np.array(plant.pump_cm3_per_vs)
    g = np.array(plant.share_below)

    def rate(_: float, h: np.ndarray) -> np.ndarray:
        speeds = np.sqrt(2 * 981.0 * h)
        q = out * speeds
        left_share = g[0] * k[0]
        flow_left = left_share * 2.2
        right_share = g[1] * k[1]
        flow_right = right_share * 3.7
        flow_to_upper_left = (1 - g[1]) * k[1] * 3.7
        flow_to_upper_right = (1 - g[0]) * k[0] * 2.2
        pumped = np.array([flow_left, flow_right, flow_to_upper_left, flow_to_upper_right])
        into_left = q[2] + 3.0
        into_right = q[3] - 2.0
        inflow = np.array([into_left, into_right, 0.0, 0.0])
        difference = pumped + inflow - q
        return difference / area

    x = plant.equilibrium().x
    duration_s = 10 * plant.step_s
    span = (0, duration_s)
    ivp = solve_ivp(rate, span, x, rtol=1e-11, atol=1e-12)
    there = ivp.y[:, -1]
    repetitions = (1, 11, 1)
    constant_input = np.tile(u, repetitions)
    constant_disturbance = np.tile(d, repetitions)
    response = plant.simulate(constant_input, x0=x[None], d=constant_disturbance)
    here = response[0][0, -1]
    np.testing.assert_allclose(here, there, rtol=1e-6)


def test_quadruple_tank_starts_with_the_upper_levels_at_rest() -> None:
    plant = from_yaml("plant", "quadruple_tank")
    rest = plant.equilibrium()
    levels = [[5.0, 7.0], [6.0, 6.5]]
    y0 = np.array(levels)
    resting_outputs = rest.y[None]
    actual = plant.equilibrium_states(resting_outputs)
    expected = rest.x[None]
    np.testing.assert_allclose(actual, expected)
    x0 = plant.equilibrium_states(y0)
    actual = plant.output(x0)
    np.testing.assert_allclose(actual, y0)
    actual = x0[:, 2:]
    expected = np.tile(rest.x[2:], (2, 1))
    np.testing.assert_array_equal(actual, expected)


@pytest.fixture
def tanks() -> CascadedTanks:
    return from_yaml("plant", "cascaded_tanks")


def test_tanks_agree_with_a_general_solver_below_the_brim(tanks: CascadedTanks) -> None:
    def rate(_: float, x: np.ndarray) -> list[float]:
        from_upper = tanks.outflow_upper * np.sqrt(x[0])
        upper = tanks.pump_gain * 2.0 - from_upper
        into_lower = tanks.inflow_lower * np.sqrt(x[0])
        out_of_lower = tanks.outflow_lower * np.sqrt(x[1])
        difference = into_lower - out_of_lower
        return [upper, difference + 1e-3]

    x = tanks.equilibrium().x
    duration_s = 20 * tanks.step_s
    span = (0, duration_s)
    ivp = solve_ivp(rate, span, x, rtol=1e-11, atol=1e-12)
    there = ivp.y[:, -1]
    shape = (1, 21, 1)
    d = np.full(shape, 1e-3)
    constant_input = np.full(shape, 2.0)
    response = tanks.simulate(constant_input, x0=x[None], d=d)
    here = response[0][0, -1]
    np.testing.assert_allclose(here, there, rtol=1e-8)


def test_tanks_overflow_and_the_spill_reaches_the_lower_tank(tanks: CascadedTanks) -> None:
    u = np.full((1, 200, 1), 6.0)
    x, _ = tanks.simulate(u)
    assert x.max() == tanks.brim_v  # full to the brim, never over
    changed_tanks = replace(tanks, spill_share=0.0)
    dry, _ = changed_tanks.simulate(u)
    upper_level = x[0, :, 0]
    is_full = upper_level == tanks.brim_v
    position_of_largest = np.argmax(is_full)
    first_full = int(position_of_largest)
    actual = dry[0, : first_full - 1]
    expected = x[0, : first_full - 1]
    np.testing.assert_array_equal(actual, expected)
    lower_limit = dry[0, first_full + 1 : first_full + 5, 1]
    lower_level = x[0, first_full + 1 : first_full + 5, 1]
    assert (lower_level > lower_limit).all()


def test_the_pump_never_sucks(tanks: CascadedTanks) -> None:
    shape = (1, 50, 1)
    negative_voltage = np.full(shape, -3.0)
    response = tanks.simulate(negative_voltage)
    actual = response[0]
    no_voltage = np.zeros(shape)
    response = tanks.simulate(no_voltage)
    expected = response[0]
    np.testing.assert_array_equal(actual, expected)


def test_tanks_that_overflow_at_rest_are_refused(tanks: CascadedTanks) -> None:
    with pytest.raises(BadRequest, match=r"rest_pump_v = 6\.0: the tanks overflow at rest"):
        replace(tanks, rest_pump_v=6.0)


@pytest.fixture
def drive() -> StribeckDrive:
    return from_yaml("plant", "stribeck_drive")


def test_the_drive_converges_with_order_one_to_a_general_solver(drive: StribeckDrive) -> None:
    def rate(_: float, x: np.ndarray) -> list[float]:
        w = np.array([x[1]])
        friction_torques = drive.friction_torque_nm(w)
        friction = friction_torques[0]
        driving_torque = drive.torque_constant_nm_per_a * x[0]
        viscous_torque = drive.viscous_nms_per_rad * x[1]
        difference = driving_torque - viscous_torque
        torque = difference - friction
        missing_current = 1.5 - x[0]
        current_rate = missing_current / drive.current_lag_s
        return [current_rate, torque / drive.inertia_kgm2]

    duration_s = 20 * drive.step_s
    span = (0, duration_s)
    start_state = [0.0, 5.0]
    ivp = solve_ivp(rate, span, start_state, rtol=1e-11, atol=1e-12)
    there = ivp.y[1, -1]
    constant_input = np.full((1, 21, 1), 1.5)
    start_row = [0.0, 5.0]
    start = np.array([start_row])
    errors = []
    for substeps in (20, 40, 80):
        finer_drive = replace(drive, substeps=substeps)
        response = finer_drive.simulate(constant_input, x0=start)
        error = response[1][0, -1, 0] - there
        errors.append(abs(error))
    upper_limit = 0.02 * abs(there)
    assert errors[0] < upper_limit
    first_errors = errors[:-1]
    coarser = np.array(first_errors)
    last_errors = errors[1:]
    finer = np.array(last_errors)
    actual = np.log2(coarser / finer)
    np.testing.assert_allclose(actual, 1.0, atol=0.1)


def test_the_drive_sticks_up_to_the_static_torque_and_not_beyond(drive: StribeckDrive) -> None:
    hold_a = drive.static_torque_nm / drive.torque_constant_nm_per_a
    shape = (1, 100, 1)
    below_the_hold = np.full(shape, 0.99 * hold_a)
    response = drive.simulate(below_the_hold)
    rests = response[1] == 0.0
    assert rests.all()
    above_the_hold = np.full(shape, 1.1 * hold_a)
    response = drive.simulate(above_the_hold)
    last_speed = response[1][0, -1, 0]
    assert last_speed > 0.1  # and then runs away from rest


def test_the_drive_starts_on_both_sides_of_rest(drive: StribeckDrive) -> None:
    expected = (-drive.initial_speed_rad_per_s, drive.initial_speed_rad_per_s)
    assert drive.initial_range == expected


def test_the_drive_saturates(drive: StribeckDrive) -> None:
    limit = drive.current_limit_a
    shape = (1, 50, 1)
    beyond_the_limit = np.full(shape, 3 * limit)
    response = drive.simulate(beyond_the_limit)
    actual = response[0]
    at_the_limit = np.full(shape, limit)
    response = drive.simulate(at_the_limit)
    expected = response[0]
    np.testing.assert_array_equal(actual, expected)


def test_a_loops_disturbance_enters_the_first_of_the_tanks_inflows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant = from_yaml("plant", "quadruple_tank")
    close_loop = Mock(side_effect=InterruptedError)
    monkeypatch.setattr(regulation, "simulate_closed_loop", close_loop)
    disturbance = StepDisturbance(size=2.0, at_s=0.0)
    loop = regulation.LoopExperiment(horizon_s=1.0, disturbance=disturbance)
    mock = Mock(spec=Controller)
    equilibrium = plant.equilibrium()
    no_disturbance = np.zeros((1, 5, 2))
    with pytest.raises(InterruptedError):
        loop.simulate(plant, mock, equilibrium.y[None], no_disturbance)
    disturbance = close_loop.call_args.kwargs["disturbance"]
    actual = disturbance[0]
    row = [2.0, 0.0]
    expected = [row] * 5
    np.testing.assert_array_equal(actual, expected)
