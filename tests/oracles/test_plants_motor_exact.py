"""The motor by two routes: the batched stepper against the event-accurate solution, and both
against solve_ivp."""

from dataclasses import replace

import numpy as np
import pytest
from dc_motor_exact import SWITCH_TIME_TOLERANCE_S, simulate_exactly
from hypothesis import given
from hypothesis import strategies as st
from plants_cases import from_yaml
from scipy.integrate import solve_ivp

from ssm_study.plants.dc_motor import DCMotor


@pytest.fixture(scope="module")
def motor() -> DCMotor:
    return from_yaml("plant", "dc_motor")


def levels(samples: int, amplitude: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = -(-samples // 15)
    heights = rng.uniform(-amplitude, amplitude, count)
    held = np.repeat(heights, 15)
    return held[:samples, None]


def test_the_fast_motor_converges_to_the_exact_one_with_order_four(motor: DCMotor) -> None:
    u = levels(200, 3.0)
    x0 = np.zeros(4)
    exact = simulate_exactly(motor, u, x0)
    assert len(exact.switch_times_s) > 5  # the record visits stick and slip, or it shows nothing
    errors = []
    for step in (5e-4, 2.5e-4, 1.25e-4):
        changed_motor = replace(motor, solver_step_s=step)
        x, _ = changed_motor.simulate(u[None])
        expected = exact.x[:-1]
        difference = np.abs(x[0] - expected)
        largest_difference = difference.max()
        errors.append(largest_difference)
    ratios = np.divide(errors[:-1], errors[1:])
    orders = np.log2(ratios)
    assert orders.min() > 3.5, (errors, orders)
    assert errors[0] < 1e-4


@pytest.mark.parametrize("seed", range(5))
def test_the_configured_step_is_accurate_with_disturbances(motor: DCMotor, seed: int) -> None:
    u = levels(150, 2.0, seed)
    d = levels(150, 3e-3, 100 + seed)
    output = 4.0 - 2 * seed
    start_output = np.array([[output]])
    x0 = motor.equilibrium_states(start_output)
    exact = simulate_exactly(motor, u, x0[0], d)
    x, _ = motor.simulate(u[None], x0=x0, d=d[None])
    difference = np.abs(x[0] - exact.x[:-1])
    largest_difference = difference.max()
    assert largest_difference < 1e-4  # the measurement noise is 0.14 rad/s


def test_the_exact_motor_agrees_with_a_general_solver_between_switches(motor: DCMotor) -> None:
    """Third route: scipy integrates the slipping motor, no friction code shared."""
    frictionless = replace(motor, coulomb_torque_nm=0.0)
    p = frictionless.motor_constants

    def rate(_: float, x: np.ndarray, v: float) -> np.ndarray:
        current, motor_speed, load_speed, twist = x
        slip = motor_speed - load_speed
        shaft = p.stiffness * twist + p.damping * slip
        back_emf = p.k * motor_speed
        winding_voltage = v - p.resistance * current
        inductor_voltage = winding_voltage - back_emf
        motor_friction = p.motor_viscous * motor_speed
        motor_torque = p.k * current - shaft - motor_friction
        load_torque = shaft - p.load_viscous * load_speed
        rates = [
            inductor_voltage / motor.inductance_h,
            motor_torque / motor.motor_inertia_kgm2,
            load_torque / motor.load_inertia_kgm2,
            slip,
        ]
        return np.array(rates)

    u = np.full((20, 1), 2.4)
    x0 = np.zeros(4)
    exact_run = simulate_exactly(frictionless, u, x0)
    exact = exact_run.x[-1]
    duration_s = 20 * motor.step_s
    tolerances = {"rtol": 1e-11, "atol": 1e-13}
    ivp = solve_ivp(rate, (0, duration_s), x0, args=(2.0,), **tolerances)
    expected = ivp.y[:, -1]
    np.testing.assert_allclose(exact, expected, rtol=1e-8, atol=1e-9)


def test_the_motor_sticks_exactly_under_a_torque_below_friction(motor: DCMotor) -> None:
    holding_torque = 0.95 * motor.coulomb_torque_nm
    holding_current = holding_torque / motor.torque_constant_nm_per_a
    holding_voltage = motor.resistance_ohm * holding_current
    stall_v = motor.dead_zone_v + holding_voltage
    constant_input = np.full((1, 300, 1), stall_v)
    x, y = motor.simulate(constant_input)
    motor_speed = x[..., 1]
    assert (motor_speed == 0.0).all()  # not small: zero
    assert (y == 0.0).all()
    current = x[0, :, 0]
    assert current[-1] > 0.05  # although current flows
    stronger_input = 1.2 * constant_input
    moving, _ = motor.simulate(stronger_input)
    motor_speed = moving[0, :, 1]
    assert (motor_speed != 0.0).any()


def test_the_motor_comes_to_rest_and_stays_there(motor: DCMotor) -> None:
    levels_of_output = np.linspace(-4, 4, 5)
    outputs = levels_of_output[:, None]
    x0 = motor.equilibrium_states(outputs)
    no_input = np.zeros((5, 400, 1))
    x, _ = motor.simulate(no_input, x0=x0)
    last_states = x[:, -50:]
    last_speeds = last_states[:, :, 1:3]
    assert (last_speeds == 0.0).all()
    last_twists = last_states[:, :, 3]
    creep = np.ptp(last_twists, axis=1)
    assert (creep == 0.0).all()  # the twist friction holds does not creep


def test_switch_times_are_located(motor: DCMotor) -> None:
    """A free run-down of one rigid speed has its stop time in closed form."""
    no_shaft = {"shaft_stiffness_nm_per_rad": 1e-15, "shaft_damping_nms_per_rad": 0.0}
    rigid = replace(motor, **no_shaft)
    u = np.zeros((300, 1))
    x0 = np.array([0.0, 0.0, 2.0, 0.0])
    run = simulate_exactly(rigid, u, x0)
    b = rigid.load_viscous_nms_per_rad
    inertia = rigid.load_inertia_kgm2
    a0 = rigid.coulomb_torque_nm
    time_constant = inertia / b
    slowing = b * 2.0 / a0
    stop = time_constant * np.log(1 + slowing)
    difference = np.abs(run.switch_times_s - stop)
    largest_difference = difference.min()
    assert largest_difference < 1e-10
    assert SWITCH_TIME_TOLERANCE_S <= 1e-10


STATE = st.floats(-4, 4)
STARTS = st.lists(STATE, min_size=4, max_size=4)


@given(x0=STARTS)
def test_energy_never_grows_without_input(x0: list[float]) -> None:
    motor = from_yaml("plant", "dc_motor")
    units = np.array([0.2, 1.0, 1.0, 0.01])
    start = np.array([x0]) * units
    no_input = np.zeros((1, 60, 1))
    x, _ = motor.simulate(no_input, x0=start)
    # (L_a i_a^2 + J_m w_m^2 + J_L w_L^2 + k_s twist^2) / 2, with the twist in the last state
    stored = (
        motor.inductance_h,
        motor.motor_inertia_kgm2,
        motor.load_inertia_kgm2,
        motor.shaft_stiffness_nm_per_rad,
    )
    energies = np.array(stored) * x[0] ** 2
    energy = 0.5 * np.sum(energies, axis=-1)
    differences = np.diff(energy)
    upper_limit = 1e-9 * energy[0] + 1e-15
    assert (differences <= upper_limit).all()


def test_the_motor_is_odd(motor: DCMotor) -> None:
    u = levels(200, 3.0)[None]
    d = levels(200, 2e-3, 1)[None]
    actual, _ = motor.simulate(-u, d=-d)
    response, _ = motor.simulate(u, d=d)
    expected = -response
    np.testing.assert_array_equal(actual, expected)


def test_the_dead_zone_is_dead(motor: DCMotor) -> None:
    inside_the_zone = np.full((1, 50, 1), 0.399)
    x, _ = motor.simulate(inside_the_zone)
    assert (x == 0.0).all()
    outside_the_zone = np.full((1, 50, 1), -0.401)
    x, _ = motor.simulate(outside_the_zone)
    current = x[0, 1:, 0]
    assert (current < 0).all()


def test_a_disturbance_torque_can_break_the_load_loose(motor: DCMotor) -> None:
    u = np.zeros((1, 100, 1))
    d = np.full((1, 100, 1), 1.9e-3)
    _, output = motor.simulate(u, d=d)
    assert (output == 0.0).all()
    d = np.full((1, 100, 1), 6e-3)
    _, output = motor.simulate(u, d=d)
    last = output[0, -1]
    assert (last < 0).all()
