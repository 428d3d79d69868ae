"""Twelve plants from other fields, logged by twelve kinds of loggers: no rule of this project was
made on them.

Their numbers were written down before the first run and not changed after it. They answer what the
five of `stranger_plants.py` do not ask: decimal commas, dates, rows of units, few samples and many,
irregular times, coarse sensors, friction that sticks, plants that their owner logs in a loop, and
two that do not come to rest without one (`levitation`, `quadrotor`).
"""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from stranger_plants import (
    Dialect,
    Recording,
    Rng,
    Signals,
    State,
    StrangerPlant,
    Vector,
    random_levels,
)

GRAVITY_M_PER_S2 = 9.81


@dataclass(frozen=True, kw_only=True)
class NeutralisationTank(StrangerPlant):
    """pH of a stirred tank in which a base neutralises an acid; the probe stands down the pipe, six
    samples later. State (excess of base in mmol/l, six values under way)."""

    name = "neutralisation"
    describes = "pH of a stirred tank, with dead time"
    step_s = 10.0
    inputs = ("Lauge [l/h]",)
    outputs = ("pH",)
    noise = (0.02,)
    resolution = 0.01
    lower = 40.0
    upper = 60.0

    seed: int = 200
    samples: int = 3000
    dialect: Dialect = field(
        default_factory=lambda: Dialect(
            separator=";",
            decimal=",",
            above=("Anlage 3;Neutralisation", "Export vom 12.03.2024;"),
            encoding="cp1252",
        )
    )
    volume_l: float = 8.0
    acid_l_per_h: float = 50.0
    strength_mmol_per_l: float = 10.0
    buffer_mmol_per_l: float = 0.05
    dead_samples: int = 6

    def first_state(self) -> State:
        return np.zeros(1 + self.dead_samples)

    def clock(self) -> dict[str, object]:
        start = pd.Timestamp("2024-03-11 06:00:00")
        times = start + pd.to_timedelta(self.step_s * np.arange(self.samples), unit="s")
        return {"Zeit": times.strftime("%d.%m.%Y %H:%M:%S")}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 20, 150, 45.0, 55.0)[:, None]

    def output(self, x: State) -> Vector:
        return 7.0 + np.arcsinh(x[1:2] / (2 * self.buffer_mmol_per_l)) / np.log(10)

    def advance(self, x: State, u: Vector) -> State:
        excess, _, *under_way = x
        hours = self.step_s / 3600.0
        inflow = self.strength_mmol_per_l * (u[0] - self.acid_l_per_h)
        outflow = excess * (u[0] + self.acid_l_per_h)
        following = excess + hours * (inflow - outflow) / self.volume_l
        return np.array([following, *under_way, excess])


@dataclass(frozen=True, kw_only=True)
class HeatedRoom(StrangerPlant):
    """Air, wall and radiator of a room under a boiler's power, while the temperature outdoors is
    measured; the radiator gives its heat with a power of 1.3. State: three temperatures."""

    name = "room"
    describes = "temperature of a heated room, outdoors measured"
    step_s = 300.0
    inputs = ("heater",)
    disturbances = ("outdoor",)
    outputs = ("room",)
    noise = (0.05,)
    lower = 0.0
    upper = 2000.0

    seed: int = 201
    dialect: Dialect = field(
        default_factory=lambda: Dialect(separator="\t", units=("", "W", "degC", "degC"))
    )
    air_j_per_k: float = 4e5
    wall_j_per_k: float = 8e6
    radiator_j_per_k: float = 6e4
    wall_w_per_k: float = 120.0
    outer_w_per_k: float = 30.0
    leak_w_per_k: float = 15.0
    radiator_w: float = 7.0  # per K to the power of 1.3
    substeps: int = 10

    def first_state(self) -> State:
        return np.array([20.0, 16.0, 35.0])

    def clock(self) -> dict[str, object]:
        start = pd.Timestamp("2024-01-08 00:00:00")
        times = start + pd.to_timedelta(self.step_s * np.arange(self.samples), unit="s")
        return {"timestamp": times.strftime("%Y-%m-%dT%H:%M:%S")}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 6, 72, 0.0, 2000.0)[:, None]

    def weather(self, rng: Rng) -> Signals:
        days = self.step_s * np.arange(self.samples) / 86400.0
        fronts = np.cumsum(rng.standard_normal(self.samples)) * 0.08
        return (4.0 + 4.0 * np.sin(2 * np.pi * (days - 0.4)) + fronts)[:, None]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        air, wall, radiator = x
        h = self.step_s / self.substeps
        for _ in range(self.substeps):
            given = self.radiator_w * max(radiator - air, 0.0) ** 1.3
            inwards = self.wall_w_per_k * (wall - air)
            leak = self.leak_w_per_k * (u[1] - air)
            outwards = self.outer_w_per_k * (u[1] - wall)
            radiator += h * (u[0] - given) / self.radiator_j_per_k
            air += h * (given + inwards + leak) / self.air_j_per_k
            wall += h * (outwards - inwards) / self.wall_j_per_k
        return np.array([air, wall, radiator])


@dataclass(frozen=True, kw_only=True)
class Levitation(StrangerPlant):
    """Gap below an electromagnet that holds a ball; unstable, so a loop with proportional and
    derivative action holds it while it is logged. State (gap in mm, speed in mm/s)."""

    name = "levitation"
    describes = "gap of a magnetic levitation, logged in a loop"
    step_s = 0.001
    inputs = ("current_A",)
    outputs = ("gap_mm",)
    noise = (0.01,)
    lower = 0.0
    upper = 3.0

    seed: int = 202
    force_mm3: float = 9.81e3 * 64.0  # acceleration times gap^2 over current^2, in mm^3/s^2/A^2
    stiffness_a_per_mm: float = 0.35
    damping_a_s_per_mm: float = 0.006
    substeps: int = 4

    def first_state(self) -> State:
        return np.array([8.0, 0.0])

    def clock(self) -> dict[str, object]:
        return {"t_ms": np.arange(self.samples)}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 50, 300, 7.0, 9.0)[:, None]

    def operate(self, plan: Vector, measured: Vector, x: State) -> Vector:
        holding = plan / 8.0
        pull = self.stiffness_a_per_mm * (measured - plan)
        return holding + pull + self.damping_a_s_per_mm * x[1]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        gap, speed = x
        h = self.step_s / self.substeps
        for _ in range(self.substeps):
            pull = self.force_mm3 * (u[0] / gap) ** 2
            speed += h * (1e3 * GRAVITY_M_PER_S2 - pull)
            gap = float(np.clip(gap + h * speed, 2.0, 20.0))
        return np.array([gap, speed])

    def table(self, recording: Recording) -> pd.DataFrame:
        table = super().table(recording)
        table.insert(1, "setpoint_mm", recording.planned[:, 0])
        return table


@dataclass(frozen=True, kw_only=True)
class BoostConverter(StrangerPlant):
    """Voltage of a boost converter under its duty cycle, averaged over a period of the switch: a
    product of duty and state, and a step that first goes the wrong way. State (current in A,
    voltage in V)."""

    name = "converter"
    describes = "voltage of a boost converter at 20 kHz"
    step_s = 5e-5
    inputs = ("duty",)
    outputs = ("v_out",)
    noise = (0.05,)
    lower = 0.1
    upper = 0.7

    seed: int = 203
    source_v: float = 12.0
    coil_h: float = 470e-6
    coil_ohm: float = 0.3
    capacitor_f: float = 220e-6
    load_ohm: float = 15.0
    substeps: int = 5

    def first_state(self) -> State:
        return np.array([1.6, 19.0])

    def clock(self) -> dict[str, object]:
        return {"t_us": np.arange(self.samples) * 50}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 10, 80, 0.2, 0.55)[:, None]

    def output(self, x: State) -> Vector:
        return x[1:]

    def advance(self, x: State, u: Vector) -> State:
        current, voltage = x
        h = self.step_s / self.substeps
        open_share = 1 - u[0]
        for _ in range(self.substeps):
            across = self.source_v - open_share * voltage - self.coil_ohm * current
            charging = open_share * current - voltage / self.load_ohm
            current = max(current + h * across / self.coil_h, 0.0)
            voltage += h * charging / self.capacitor_f
        return np.array([current, voltage])


@dataclass(frozen=True, kw_only=True)
class Crane(StrangerPlant):
    """Angle of a load below a trolley whose speed is commanded: a pendulum with a damping of one
    percent. State (angle in rad, its speed, trolley speed in m/s)."""

    name = "crane"
    describes = "swing of a crane's load under the trolley's speed"
    step_s = 0.1
    inputs = ("trolley",)
    outputs = ("swing",)
    noise = (0.05,)
    lower = -1.0
    upper = 1.0
    trial_samples = 2000

    seed: int = 204
    dialect: Dialect = field(
        default_factory=lambda: Dialect(
            separator="|", above=("# crane 2, bay 4", "# trolley in m/s, swing in deg")
        )
    )
    rope_m: float = 2.0
    damping_per_s: float = 0.045
    drive_s: float = 0.8
    substeps: int = 5

    def first_state(self) -> State:
        return np.zeros(3)

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 5, 60, -0.4, 0.4)[:, None]

    def output(self, x: State) -> Vector:
        return np.degrees(x[:1])

    def advance(self, x: State, u: Vector) -> State:
        angle, turning, trolley = x
        h = self.step_s / self.substeps
        for _ in range(self.substeps):
            push = (u[0] - trolley) / self.drive_s
            fall = GRAVITY_M_PER_S2 * np.sin(angle) + push * np.cos(angle)
            turning += h * (-fall / self.rope_m - self.damping_per_s * turning)
            angle += h * turning
            trolley += h * push
        return np.array([angle, turning, trolley])


@dataclass(frozen=True, kw_only=True)
class QuadrotorHeight(StrangerPlant):
    """Height of a quadrotor under its throttle: rotors with a lag, thrust with the square of their
    speed, drag of the air; a pilot holds it while it is logged. State (height in m, climb in m/s,
    rotor speed as a share)."""

    name = "quadrotor"
    describes = "height of a quadrotor, logged under its pilot"
    step_s = 0.02
    inputs = ("throttle",)
    outputs = ("height",)
    noise = (0.02,)
    lower = 0.0
    upper = 1.0

    seed: int = 205
    dialect: Dialect = field(default_factory=lambda: Dialect(digits="%.6g"))
    hover: float = 0.55
    rotor_s: float = 0.06
    drag_per_s: float = 0.4
    pilot_per_m: float = 0.06
    pilot_s_per_m: float = 0.08

    def first_state(self) -> State:
        return np.array([10.0, 0.0, self.hover])

    def clock(self) -> dict[str, object]:
        start = pd.Timestamp("2024-05-04 14:02:11")
        times = start + pd.to_timedelta(self.step_s * np.arange(self.samples), unit="s")
        return {"time": [text[:-3] for text in times.strftime("%H:%M:%S.%f")]}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 50, 250, 8.0, 12.0)[:, None]

    def operate(self, plan: Vector, measured: Vector, x: State) -> Vector:
        correction = self.pilot_per_m * (plan - measured) - self.pilot_s_per_m * x[1]
        return self.hover + correction

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        height, climb, rotor = x
        rotor = rotor + self.step_s / self.rotor_s * (u[0] - rotor)
        lift = GRAVITY_M_PER_S2 * (rotor / self.hover) ** 2
        climb += self.step_s * (lift - GRAVITY_M_PER_S2 - self.drag_per_s * climb)
        return np.array([height + self.step_s * climb, climb, rotor])


@dataclass(frozen=True, kw_only=True)
class PneumaticActuator(StrangerPlant):
    """Position of a pneumatic piston against a spring, with friction that sticks. State (position
    in mm, speed in mm/s, force of the pressure in N)."""

    name = "pneumatic"
    describes = "position of a pneumatic actuator with friction that sticks"
    step_s = 0.005
    inputs = ("valve (V)",)
    outputs = ("stroke (mm)",)
    noise = (0.03,)
    lower = 0.0
    upper = 10.0

    seed: int = 206
    mass_kg: float = 1.2
    spring_n_per_mm: float = 4.0
    damping_n_s_per_mm: float = 0.06
    sliding_n: float = 12.0
    sticking_n: float = 18.0
    pressure_s: float = 0.04
    force_n_per_v: float = 40.0
    substeps: int = 10

    def first_state(self) -> State:
        return np.zeros(3)

    def clock(self) -> dict[str, object]:
        return {"t (s)": np.arange(self.samples) * self.step_s}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 20, 120, 1.0, 9.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        place, speed, force = x
        h = self.step_s / self.substeps
        per_kg = 1e3 / self.mass_kg  # mm/s^2 for a newton
        for _ in range(self.substeps):
            force += h / self.pressure_s * (self.force_n_per_v * u[0] - force)
            damping = self.damping_n_s_per_mm * speed
            driving = force - self.spring_n_per_mm * place - damping
            if speed == 0.0 and abs(driving) <= self.sticking_n:
                continue
            free = speed + h * per_kg * driving
            stop = h * per_kg * self.sliding_n
            speed = float(np.sign(free) * max(abs(free) - stop, 0.0))
            place += h * speed
        return np.array([place, speed, force])


@dataclass(frozen=True, kw_only=True)
class HeatPump(StrangerPlant):
    """Temperature of a water loop under a heat pump that heats more strongly than it cools, and
    faster. State (water in degrees, power of the compressor in percent)."""

    name = "heat_pump"
    describes = "water under a heat pump whose gain depends on the direction"
    step_s = 60.0
    inputs = ("power_%",)
    outputs = ("water_degC",)
    noise = (0.05,)
    resolution = 0.1
    lower = -100.0
    upper = 100.0

    seed: int = 207
    dialect: Dialect = field(default_factory=lambda: Dialect(separator=";"))
    surroundings_degc: float = 22.0
    heating_k: float = 18.0
    cooling_k: float = 9.0
    compressor: float = 0.35
    warming_s: float = 600.0
    cooling_s: float = 1500.0

    def first_state(self) -> State:
        return np.array([22.0, 0.0])

    def clock(self) -> dict[str, object]:
        return {"min": np.arange(self.samples)}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 10, 60, -100.0, 100.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        water, power = x
        power = power + self.compressor * (u[0] - power)
        gain = self.heating_k if power > 0 else self.cooling_k
        target = self.surroundings_degc + gain * power / 100
        lag_s = self.warming_s if target > water else self.cooling_s
        return np.array([water + self.step_s / lag_s * (target - water), power])


@dataclass(frozen=True, kw_only=True)
class FedBatch(StrangerPlant):
    """Glucose in a fed batch of yeast, 300 samples of 6 min: the cells grow, so the same feed is
    eaten faster at the end than at the beginning. State (cells in g/l, glucose in g/l, volume in
    l). Source: Monod's growth."""

    name = "fed_batch"
    describes = "glucose in a fed batch, 300 samples"
    step_s = 360.0
    inputs = ("Feed (ml/h)",)
    outputs = ("Glucose (g/l)",)
    noise = (0.02,)
    lower = 0.0
    upper = 400.0

    seed: int = 208
    samples: int = 300
    dialect: Dialect = field(default_factory=lambda: Dialect(separator=";", decimal=","))
    growth_per_h: float = 0.25
    half_g_per_l: float = 0.6
    cells_per_glucose: float = 0.45
    feed_g_per_l: float = 200.0
    substeps: int = 10

    def first_state(self) -> State:
        return np.array([8.0, 0.5, 10.0])

    def clock(self) -> dict[str, object]:
        return {"Time (h)": np.arange(self.samples) * 0.1}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 5, 20, 20.0, 200.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[1:2]

    def advance(self, x: State, u: Vector) -> State:
        cells, glucose, volume = x
        h = self.step_s / 3600.0 / self.substeps
        litres_per_h = u[0] / 1e3
        for _ in range(self.substeps):
            growth = self.growth_per_h * glucose / (self.half_g_per_l + glucose)
            thinning = litres_per_h / volume
            eaten = growth * cells / self.cells_per_glucose
            cells += h * (growth - thinning) * cells
            glucose += h * (thinning * (self.feed_g_per_l - glucose) - eaten)
            glucose = max(glucose, 0.0)
            volume += h * litres_per_h
        return np.array([cells, glucose, volume])


@dataclass(frozen=True, kw_only=True)
class VoiceCoil(StrangerPlant):
    """Position of a voice coil on a spring, 200,000 samples at 10 kHz; its force falls towards the
    ends of the stroke. State (position in mm, speed in mm/s, current in A)."""

    name = "voice_coil"
    describes = "voice coil, 200,000 samples at 10 kHz"
    step_s = 1e-4
    inputs = ("1",)
    outputs = ("2",)
    noise = (0.002,)
    lower = -10.0
    upper = 10.0

    seed: int = 209
    samples: int = 200_000
    dialect: Dialect = field(
        default_factory=lambda: Dialect(separator=" ", digits="%.7g", names=False)
    )
    natural_rad_per_s: float = 380.0
    damping: float = 0.25
    coil_s: float = 4e-4
    current_a_per_v: float = 0.2
    gain_mm_per_a: float = 1.0
    stroke_mm: float = 4.0

    def first_state(self) -> State:
        return np.zeros(3)

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 20, 300, -10.0, 10.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        place, speed, current = x
        h = self.step_s
        w = self.natural_rad_per_s
        current += h / self.coil_s * (self.current_a_per_v * u[0] - current)
        push = self.gain_mm_per_a * current * (1 - (place / self.stroke_mm) ** 2)
        speed += h * (w * w * (push - place) - 2 * self.damping * w * speed)
        return np.array([place + h * speed, speed, current])


@dataclass(frozen=True, kw_only=True)
class BufferTank(StrangerPlant):
    """Level of a tank with a free outflow under a pump, whose logger is late by up to 0.4 s, leaves
    out two percent of the rows, and stops three times for some minutes. State: the level in m."""

    name = "buffer_tank"
    describes = "level of a tank, irregular times with gaps"
    step_s = 10.0
    inputs = ("Pump rate [l/s]",)
    outputs = ("Level [m]",)
    noise = (0.005,)
    lower = 0.0
    upper = 8.0

    seed: int = 210
    dialect: Dialect = field(default_factory=lambda: Dialect(digits="%.3f"))
    area_m2: float = 1.5
    outlet_l_per_s: float = 3.0  # at a level of one metre

    def first_state(self) -> State:
        return np.array([1.0])

    def clock(self) -> dict[str, object]:
        late = np.random.default_rng(self.seed + 1).uniform(0.0, 0.4, self.samples)
        return {"Time [s]": 1.7e9 + self.step_s * np.arange(self.samples) + late}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 20, 150, 0.5, 6.0)[:, None]

    def output(self, x: State) -> Vector:
        return x

    def advance(self, x: State, u: Vector) -> State:
        outflow = self.outlet_l_per_s * np.sqrt(np.maximum(x, 0.0))
        return np.maximum(x + self.step_s * (u - outflow) / 1e3 / self.area_m2, 0.0)

    def table(self, recording: Recording) -> pd.DataFrame:
        table = super().table(recording)
        rows = np.arange(len(table))
        left_out = np.random.default_rng(self.seed + 2).uniform(size=len(table)) < 0.02
        for first in (900, 1900, 3100):
            left_out |= (rows >= first) & (rows < first + 30)
        return table[~left_out]


@dataclass(frozen=True, kw_only=True)
class Oven(StrangerPlant):
    """Temperature of an oven that loses heat by convection and radiation, read in whole degrees.
    State (heating element and chamber in degrees)."""

    name = "oven"
    describes = "oven read in whole degrees"
    step_s = 2.0
    inputs = ("power",)
    outputs = ("temp",)
    noise = (0.2,)
    resolution = 1.0
    lower = 0.0
    upper = 100.0

    seed: int = 211
    dialect: Dialect = field(default_factory=lambda: Dialect(units=("s", "%", "°C")))
    element_s: float = 25.0
    chamber_s: float = 180.0
    full_k: float = 420.0
    radiation: float = 0.9  # of the linear loss, at 300 degrees above the surroundings
    surroundings_degc: float = 22.0

    def first_state(self) -> State:
        return np.array([22.0, 22.0])

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 40, 250, 0.0, 100.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[1:]

    def advance(self, x: State, u: Vector) -> State:
        element, chamber = x - self.surroundings_degc
        element += self.step_s / self.element_s * (self.full_k * u[0] / 100 - element)
        loss = chamber * (1 + self.radiation * (chamber / 300.0) ** 3)
        chamber += self.step_s / self.chamber_s * (element - loss)
        return np.array([element, chamber]) + self.surroundings_degc


PLANTS_ASIDE: tuple[type[StrangerPlant], ...] = (
    NeutralisationTank,
    HeatedRoom,
    Levitation,
    BoostConverter,
    Crane,
    QuadrotorHeight,
    PneumaticActuator,
    HeatPump,
    FedBatch,
    VoiceCoil,
    BufferTank,
    Oven,
)
