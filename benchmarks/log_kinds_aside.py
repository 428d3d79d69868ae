"""Eight further kinds of logs, on which the choice of models is judged and never made.

The generators were written before the choice was changed, and no log of theirs was looked at while
it was. The last four are positions: a running sum of what a nonlinear drive does. Same form as
`log_kinds.py`.
"""

import numpy as np
from log_kinds import LogKind, Rng, column, random_levels, with_noise


def two_tanks(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two tanks in a row, each with an outflow that grows with the root of its level."""
    u = random_levels(rng, samples, 10, 60)
    size = rng.uniform(0.08, 0.15)
    y = np.zeros(samples)
    level = np.array([0.5, 0.5])
    for k in range(samples):
        y[k] = level[1]
        inflow = size * (1.0 + 0.9 * u[k])
        out = size * np.sqrt(level + 1e-4)
        change = np.array([inflow - out[0], out[0] - out[1]])
        level = np.maximum(level + 0.6 * change, 0.0)
    return column(u), with_noise(rng, y)


def mass_with_friction(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A mass on a spring, with viscous damping and dry friction."""
    u = random_levels(rng, samples, 5, 30)
    damping = rng.uniform(0.1, 0.2)
    stiffness = rng.uniform(0.03, 0.06)
    dry = rng.uniform(0.01, 0.03)
    h = 0.2
    y = np.zeros(samples)
    position = 0.0
    velocity = 0.0
    for k in range(samples):
        y[k] = position
        for _ in range(5):
            friction = damping * velocity + dry * np.tanh(velocity / 0.02)
            velocity += h * (0.1 * u[k] - friction - stiffness * position)
            position += h * velocity
    return column(u), with_noise(rng, y)


def heated_flow(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A vessel that a flow cools: the input multiplies the temperature; a sensor with a lag."""
    u = random_levels(rng, samples, 6, 40)
    share = rng.uniform(0.05, 0.1)
    y = np.zeros(samples)
    temperature = 1.0
    sensor = 0.0
    for k in range(samples):
        flow = 1.0 + 0.7 * u[k]
        temperature += share * (1.0 - flow * temperature)
        sensor += 0.3 * (temperature - sensor)
        y[k] = sensor
    return column(u), with_noise(rng, y)


def two_inputs_one_late(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two inputs in the log, one of them six samples late; their sum saturates."""
    first = random_levels(rng, samples, 5, 40)
    second = random_levels(rng, samples, 20, 90)
    late = np.concatenate([np.zeros(6), second])[:samples]
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[1]
        x[1] = 0.93 * x[1] + 0.07 * x[0]
        x[0] = 0.6 * x[0] + 0.4 * np.tanh(1.2 * first[k] + 0.8 * late[k])
    return np.stack([first, second], axis=1), with_noise(rng, y)


def reverse_outward(u: np.ndarray, k: int, position: float, limit: float) -> None:
    """An operator turns all inputs from sample `k` on round, where they lead further away from zero
    than the limit."""
    if abs(position) > limit and u[k] * position > 0:
        u[k:] *= -1


def servo_with_friction(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A servo's position in encoder counts: voltage, viscous and Coulomb friction that holds it."""
    u = random_levels(rng, samples, 8, 50)
    damping = rng.uniform(0.1, 0.25)
    dry = rng.uniform(0.15, 0.3)
    y = np.zeros(samples)
    position = 0.0
    speed = 0.0
    for k in range(samples):
        y[k] = position
        reverse_outward(u, k, position, 600.0)
        pushed = speed + damping * (25.0 * u[k] - speed)
        speed = np.sign(pushed) * max(abs(pushed) - damping * 25.0 * dry, 0.0)
        position += speed
    return column(u), np.round(y)


def ship_heading(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A ship's heading: a rudder of limited speed, and a turn that the hull resists as its cube."""
    u = random_levels(rng, samples, 15, 80)
    slow = rng.uniform(0.03, 0.08)
    cube = rng.uniform(0.5, 2.0)
    fastest = rng.uniform(0.1, 0.2)
    y = np.zeros(samples)
    heading = 0.0
    turn = 0.0
    rudder = 0.0
    for k in range(samples):
        y[k] = heading
        reverse_outward(u, k, heading, 40.0)
        rudder += np.clip(u[k] - rudder, -fastest, fastest)
        turn += slow * (rudder - turn - cube * turn**3)
        heading += turn
    return column(u), with_noise(rng, y)


def level_by_pump(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A tank's level: a pump with a dead zone fills it and drains it, each with a gain of its
    own."""
    u = random_levels(rng, samples, 10, 60)
    zone = rng.uniform(0.1, 0.3)
    lag = rng.uniform(0.6, 0.9)
    draining = rng.uniform(0.6, 0.9)
    y = np.zeros(samples)
    level = 0.0
    flow = 0.0
    for k in range(samples):
        y[k] = level
        reverse_outward(u, k, level, 20.0)
        pumped = np.sign(u[k]) * max(abs(u[k]) - zone, 0.0)
        flow = lag * flow + (1.0 - lag) * pumped * (1.0 if pumped > 0 else draining)
        level += flow
    return column(u), with_noise(rng, y)


def angle_behind_gear(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """The angle of a motor's load in counts, behind a gear with play; the voltage saturates."""
    u = random_levels(rng, samples, 10, 50)
    lag = rng.uniform(0.75, 0.9)
    play = rng.uniform(20.0, 60.0)
    y = np.zeros(samples)
    angle = 0.0
    load = 0.0
    speed = 0.0
    for k in range(samples):
        y[k] = load
        reverse_outward(u, k, load, 500.0)
        speed = lag * speed + (1.0 - lag) * 20.0 * np.tanh(1.5 * u[k])
        angle += speed
        load = np.clip(load, angle - play / 2, angle + play / 2)
    return column(u), np.round(y)


KINDS = (
    LogKind(name="tanks", describes="two tanks", step_s=1.0, make=two_tanks),
    LogKind(name="friction", describes="dry friction", step_s=0.05, make=mass_with_friction),
    LogKind(name="flow", describes="flow times temperature", step_s=0.1, make=heated_flow),
    LogKind(name="two_inputs", describes="two inputs", step_s=0.1, make=two_inputs_one_late),
    LogKind(name="servo", describes="Coulomb friction", step_s=0.02, make=servo_with_friction),
    LogKind(name="heading", describes="ship's heading", step_s=1.0, make=ship_heading),
    LogKind(name="pump", describes="level by a pump", step_s=1.0, make=level_by_pump),
    LogKind(name="gear", describes="gear with play", step_s=0.01, make=angle_behind_gear),
)
