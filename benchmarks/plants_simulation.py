"""How fast the batched motor is, and how exact: against scipy's integrator with events, and against
the exact motor.

    python benchmarks/plants_simulation.py

writes `results/reference/benchmarks/plants_simulation.csv`. The integrator is timed on part of the
work (it would take minutes) at the tolerance that gives it the batched motor's accuracy, and scaled
up. Processor time, medians.
"""

import csv
import sys
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import numpy as np
import yaml
from common import REFERENCE, ROOT, cpu_seconds
from scipy.integrate import solve_ivp

from ssm_study.plants.dc_motor import DCMotor

sys.path.insert(0, str(ROOT / "tests"))  # where oracles are
from dc_motor_exact import simulate_exactly

OUT = REFERENCE / "benchmarks" / "plants_simulation.csv"
CASES = 64
SAMPLES = 2000
PART = 300  # samples of one trajectory that the slow routes are timed on
ROUNDS = 5


def motor_from_yaml() -> DCMotor:
    settings = yaml.safe_load((ROOT / "conf" / "plant" / "dc_motor.yaml").read_text())
    return DCMotor(**{key: float(value) for key, value in settings.items() if key != "_target_"})


def excitation(motor: DCMotor) -> np.ndarray:
    rng = np.random.default_rng(0)
    levels = rng.uniform(-motor.amplitude_v, motor.amplitude_v, (CASES, SAMPLES // 20, 1))
    return np.repeat(levels, 20, axis=1)


def mode_of(motor: DCMotor, x: np.ndarray) -> list[int]:
    """Stick (0) or the direction of slip, of motor shaft and load."""
    torques = torques_of(motor, x)
    return [
        int(np.sign(w))
        if w != 0.0
        else (0 if abs(t) <= motor.coulomb_torque_nm else int(np.sign(t)))
        for w, t in zip(x[1:3], torques, strict=True)
    ]


def torques_of(motor: DCMotor, x: np.ndarray) -> tuple[float, float]:
    shaft = motor.shaft_stiffness_nm_per_rad * x[3] + motor.shaft_damping_nms_per_rad * (
        x[1] - x[2]
    )
    return (
        motor.torque_constant_nm_per_a * x[0] - shaft - motor.motor_viscous_nms_per_rad * x[1],
        shaft - motor.load_viscous_nms_per_rad * x[2],
    )


def with_events(motor: DCMotor, u: np.ndarray, tolerance: float, method: str) -> np.ndarray:
    """What one would write with `solve_ivp`: a mode machine, each mode integrated until one of its
    events."""
    x = np.zeros(4)
    states = [np.zeros(4)]
    for v in u[:, 0]:
        v_eff = float(np.sign(v) * max(abs(v) - motor.dead_zone_v, 0.0))
        x = one_period(motor, x, v_eff, tolerance, method)
        states.append(x)
    return np.array(states)


def one_period(
    motor: DCMotor, x: np.ndarray, v_eff: float, tolerance: float, method: str
) -> np.ndarray:
    t = 0.0
    modes = mode_of(motor, x)
    while t < motor.step_s:
        events = [event(motor, body, modes[body]) for body in (0, 1)]
        run = solve_ivp(
            rate, (t, motor.step_s), x, method, events=events, args=(motor, v_eff, tuple(modes)),
            rtol=tolerance, atol=tolerance * 1e-2,
        )  # fmt: skip
        t = float(run.t[-1])
        x = run.y[:, -1].copy()
        for body in (0, 1):
            if len(run.t_events[body]):
                x[1 + body] = 0.0
                torque = torques_of(motor, x)[body]
                released = modes[body] == 0 or abs(torque) > motor.coulomb_torque_nm
                modes[body] = int(np.sign(torque)) if released else 0
    return x


def event(motor: DCMotor, body: int, mode: int) -> Callable[..., float]:
    def ends(t: float, x: np.ndarray, *_: object) -> float:
        if mode != 0:
            return float(mode * x[1 + body]) if t > 0 or x[1 + body] != 0.0 else 1e-300
        return motor.coulomb_torque_nm - abs(torques_of(motor, x)[body])

    ends.terminal = True  # type: ignore[attr-defined]  # as scipy wants it
    ends.direction = -1.0  # type: ignore[attr-defined]
    return ends


def rate(
    _: float, x: np.ndarray, motor: DCMotor, v_eff: float, modes: tuple[int, int]
) -> np.ndarray:
    tm, tl = torques_of(motor, x)
    a0 = motor.coulomb_torque_nm
    return np.array([
        (v_eff - motor.resistance_ohm * x[0] - motor.torque_constant_nm_per_a * x[1])
        / motor.inductance_h,
        0.0 if modes[0] == 0 else (tm - a0 * modes[0]) / motor.motor_inertia_kgm2,
        0.0 if modes[1] == 0 else (tl - a0 * modes[1]) / motor.load_inertia_kgm2,
        x[1] - x[2],
    ])  # fmt: skip


Route = tuple[str, Callable[[], np.ndarray], float]


def all_routes(motor: DCMotor, u: np.ndarray) -> list[Route]:
    """Name, work, and what its time is to be multiplied by."""
    routes: list[Route] = []
    for step in (8e-4, 5e-4, 2.5e-4, 1.25e-4):
        stepped = replace(motor, solver_step_s=step)
        routes.append((f"batched, solver step {step:g} s", lambda m=stepped: m.simulate(u)[0], 1.0))  # type: ignore[misc]
    scale = CASES * SAMPLES / PART
    for method, tolerance in (("RK45", 1e-4), ("RK45", 1e-6), ("RK45", 1e-8), ("LSODA", 1e-6)):
        routes.append((
            f"solve_ivp with events, {method}, rtol {tolerance:g}",
            lambda m=method, r=tolerance: with_events(motor, u[0, :PART], r, m)[:-1][None],
            # type: ignore[misc]
            scale,
        ))  # fmt: skip
    return [*routes, ("event-accurate motor", lambda: exactly(motor, u)[None], scale)]


def exactly(motor: DCMotor, u: np.ndarray) -> np.ndarray:
    return simulate_exactly(motor, u[0, :PART], np.zeros(4)).x[:-1]


def main() -> None:
    motor = motor_from_yaml()
    u = excitation(motor)
    exact = exactly(motor, u)
    motor.simulate(u[:1, :2])  # compile
    rows = []
    for name, work, factor in all_routes(motor, u):
        error = float(np.abs(work()[0, :PART, 2] - exact[:, 2]).max())
        rounds = ROUNDS if factor == 1.0 else 2
        rows.append([name, error, factor * median(cpu_seconds(work) for _ in range(rounds))])
    configured = rows[1][2]
    OUT.parent.mkdir(parents=True, exist_ok=True)
    with OUT.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            [
                "route",
                "largest_speed_error_rad_per_s",
                "processor_seconds_64_x_2000",
                "times_the_configured_motor",
            ]
        )
        writer.writerows(
            [name, f"{error:.2e}", f"{s:.3g}", f"{s / configured:.3g}"] for name, error, s in rows
        )
    print(OUT.read_text())


if __name__ == "__main__":
    main()
