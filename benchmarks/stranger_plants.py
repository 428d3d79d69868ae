"""Five plants with physical units whose owners log them and control them afterwards: a stirred
reactor, a vehicle, a hydraulic cylinder, four coupled tanks, and an arm lifted by a fan.

`python benchmarks/stranger_plants.py --to FOLDER` writes their logs, and those of
`stranger_plants_aside.py`; `benchmarks/stranger_loops.py` identifies a model from each log as its
owner would, and runs the controller on the plant itself. A plant is simulated sample by sample, in
the order of a device: measure, compute, apply. Equal seeds give equal logs.
"""

import argparse
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
from jaxtyping import Float

Rng = np.random.Generator
State = Float[np.ndarray, "n"]
Vector = Float[np.ndarray, "c"]
Signals = Float[np.ndarray, "T c"]


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """How a logger writes its table: separator, decimal mark, digits, and the lines above it."""

    separator: str = ","
    decimal: str = "."
    digits: str = "%.5g"
    above: tuple[str, ...] = ()  # lines before the names
    units: tuple[str, ...] = ()  # a row below the names
    encoding: str = "utf-8"
    names: bool = True

    def write(self, table: pd.DataFrame, path: Path) -> None:
        """Write a table as this logger does."""
        body = table.to_csv(
            sep=self.separator,
            decimal=self.decimal,
            float_format=self.digits,
            index=False,
            header=False,
            lineterminator="\n",
        )
        lines = list(self.above)
        if self.names:
            lines.append(self.separator.join(table.columns))
        if self.units:
            lines.append(self.separator.join(self.units))
        head = "".join(f"{line}\n" for line in lines)
        path.write_text(head + body, encoding=self.encoding)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A plant's log: what was applied, what was measured, and the states that nobody sees."""

    inputs: Signals
    disturbances: Signals
    outputs: Signals
    states: Float[np.ndarray, "T n"]
    planned: Signals


@dataclass(frozen=True, kw_only=True)
class StrangerPlant(ABC):
    """A plant, its sensor, and the way in which its owner moves and logs it."""

    name: ClassVar[str]
    describes: ClassVar[str]
    step_s: ClassVar[float]
    inputs: ClassVar[tuple[str, ...]]
    outputs: ClassVar[tuple[str, ...]]
    disturbances: ClassVar[tuple[str, ...]] = ()
    noise: ClassVar[tuple[float, ...]]  # standard deviation of each output's sensor, in its unit
    resolution: ClassVar[float] = 0.0  # of the sensors; zero where they do not round
    lower: ClassVar[float]  # limits of every input
    upper: ClassVar[float]
    settings: ClassVar[tuple[str, ...]] = ()  # of the command, beside the names of the columns
    trial_samples: ClassVar[int] = 600  # of one start, and of one set point
    set_points: ClassVar[tuple[float, ...]] = ()  # instead of the quartiles of the log

    seed: int
    samples: int = 4000
    dialect: Dialect = field(default_factory=Dialect)

    @abstractmethod
    def first_state(self) -> State:
        """State in which the log begins."""

    @abstractmethod
    def excite(self, rng: Rng) -> Signals:
        """Inputs that the owner plans, one row a sample; of a plant in a loop its set points."""

    @abstractmethod
    def output(self, x: State) -> Vector:
        """Outputs without noise."""

    @abstractmethod
    def advance(self, x: State, u: Vector) -> State:
        """State one sample later under inputs within their limits, with measured disturbances after
        them."""

    def weather(self, rng: Rng) -> Signals:  # noqa: ARG002 - read by plants with disturbances
        """Measured disturbances, one row a sample; none unless a plant has them."""
        return np.zeros((self.samples, len(self.disturbances)))

    def operate(self, plan: Vector, measured: Vector, x: State) -> Vector:  # noqa: ARG002 - loops
        """Input that is applied: the planned one, or that of a loop around the plant."""
        return plan

    def measure(self, x: State, normal: Vector) -> Vector:
        """Outputs as the sensor reads them; `normal` are draws of a standard normal variable."""
        read = self.output(x) + np.array(self.noise) * normal
        if self.resolution:
            read = self.resolution * np.round(read / self.resolution)
        return read

    def next_state(self, x: State, u: Vector, d: Vector) -> State:
        """State one sample later, with the inputs cut at their limits."""
        within = np.clip(u, self.lower, self.upper)
        return self.advance(x, np.concatenate([within, d]))

    def record(self) -> Recording:
        """Move the plant and write down every sample."""
        rng = np.random.default_rng(self.seed)
        plans = self.excite(rng)
        loads = self.weather(rng)
        normals = rng.standard_normal((self.samples, len(self.outputs)))
        x = self.first_state()
        states = []
        applied = []
        measured = []
        for plan, load, normal in zip(plans, loads, normals, strict=True):
            y = self.measure(x, normal)
            u = np.clip(self.operate(plan, y, x), self.lower, self.upper)
            states.append(x)
            applied.append(u)
            measured.append(y)
            x = self.next_state(x, u, load)
        return Recording(
            inputs=np.array(applied),
            disturbances=loads,
            outputs=np.array(measured),
            states=np.array(states),
            planned=plans,
        )

    def clock(self) -> dict[str, object]:
        """Column of times, by its name."""
        return {"time_s": self.step_s * np.arange(self.samples)}

    def table(self, recording: Recording) -> pd.DataFrame:
        """Log as its owner sees it: times, inputs, measured disturbances, outputs."""
        columns = self.clock()
        signals = (
            (self.inputs, recording.inputs),
            (self.disturbances, recording.disturbances),
            (self.outputs, recording.outputs),
        )
        for names, values in signals:
            columns |= dict(zip(names, values.T, strict=True))
        return pd.DataFrame(columns)

    def write_log(self, folder: Path) -> Path:
        """Write the log into a folder; return its path."""
        path = folder / f"{self.name}.csv"
        self.dialect.write(self.table(self.record()), path)
        return path


def random_levels(
    rng: Rng, samples: int, shortest: int, longest: int, low: float = -1.0, high: float = 1.0
) -> Float[np.ndarray, "T"]:
    """Levels uniform in [low, high], each held for `shortest` to `longest - 1` samples."""
    levels: list[float] = []
    while len(levels) < samples:
        level = rng.uniform(low, high)
        levels += [level] * int(rng.integers(shortest, longest))
    return np.array(levels[:samples])


def dead_zone(u: float, width: float) -> float:
    """Part of an input beyond a dead zone of this half width."""
    return float(np.sign(u) * max(abs(u) - width, 0.0))


@dataclass(frozen=True, kw_only=True)
class StirredReactor(StrangerPlant):
    """Exothermic reaction of first order in a stirred tank, cooled by a jacket.

    `a' = q (1 - a) - r`, `T' = q (T_f - T) + H r + c (T_c - T)`, `r = k exp(-E / T) a`; state
    `(a, T)`. Source: Seborg, Edgar, Mellichamp, Process Dynamics and Control, chapter 2.
    """

    name = "reactor"
    describes = "temperature of an exothermic reactor under its coolant"
    step_s = 3.0
    inputs = ("Tc_K",)
    outputs = ("T_K",)
    noise = (0.1,)
    lower = 294.0
    upper = 306.0

    seed: int = 100
    flow_per_min: float = 1.0
    feed_k: float = 350.0
    reaction_per_min: float = 7.2e10
    activation_k: float = 8750.0
    heat_k: float = 209.2
    cooling_per_min: float = 2.092
    substeps: int = 10

    def first_state(self) -> State:
        return np.array([0.88, 324.5])

    def clock(self) -> dict[str, object]:
        return {"t_min": np.arange(self.samples) * 0.05}

    def excite(self, rng: Rng) -> Signals:
        return 300.0 + random_levels(rng, self.samples, 10, 60, -6.0, 6.0)[:, None]

    def output(self, x: State) -> Vector:
        return x[1:]

    def advance(self, x: State, u: Vector) -> State:
        share, kelvin = x
        h = self.step_s / 60.0 / self.substeps
        for _ in range(self.substeps):
            rate = self.reaction_per_min * np.exp(-self.activation_k / kelvin) * share
            share += h * (self.flow_per_min * (1 - share) - rate)
            warming = self.flow_per_min * (self.feed_k - kelvin) + self.heat_k * rate
            kelvin += h * (warming + self.cooling_per_min * (u[0] - kelvin))
        return np.array([share, kelvin])


@dataclass(frozen=True, kw_only=True)
class Vehicle(StrangerPlant):
    """Speed of a car on a flat road under its throttle: an engine's lag, rolling resistance, and
    drag that grows with the square of the speed; state (speed in m/s, engine in percent)."""

    name = "vehicle"
    describes = "speed of a vehicle with quadratic drag under its throttle"
    step_s = 0.2
    inputs = ("throttle",)
    outputs = ("speed",)
    noise = (0.1,)
    resolution = 0.1
    lower = 0.0
    upper = 100.0

    seed: int = 101
    engine: float = 0.3  # share of the way to the throttle in a sample
    strongest_m_per_s2: float = 3.0
    rolling_m_per_s2: float = 0.15
    drag_per_m: float = 0.0025

    def first_state(self) -> State:
        return np.array([10.0, 0.0])

    def clock(self) -> dict[str, object]:
        return {"time": np.arange(self.samples) * self.step_s}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 20, 120, 0.0, 100.0)[:, None]

    def output(self, x: State) -> Vector:
        return 3.6 * x[:1]

    def advance(self, x: State, u: Vector) -> State:
        speed, engine = x
        engine = engine + self.engine * (u[0] - engine)
        push = self.strongest_m_per_s2 * engine / 100
        slowing = self.rolling_m_per_s2 + self.drag_per_m * speed * speed
        return np.array([max(speed + self.step_s * (push - slowing), 0.0), engine])


@dataclass(frozen=True, kw_only=True)
class HydraulicCylinder(StrangerPlant):
    """Position of a cylinder under a valve with a dead zone; the load makes it faster inwards than
    outwards. State (position in mm, flow as a share of the full one)."""

    name = "cylinder"
    describes = "position of a hydraulic cylinder under a valve with dead zone"
    step_s = 0.01
    inputs = ("valve",)
    outputs = ("pos_mm",)
    noise = (0.05,)
    lower = -1.0
    upper = 1.0
    set_points = (30.0, 100.0, -200.0)  # after the first, steps of 70 and 300 mm

    seed: int = 102
    dead_zone: float = 0.05
    load: float = 0.15  # of the supply pressure
    spool: float = 0.4  # share of the way to the valve's command in a sample
    full_speed_mm_per_s: float = 200.0

    def first_state(self) -> State:
        return np.zeros(2)

    def clock(self) -> dict[str, object]:
        return {"t": np.arange(self.samples) * self.step_s}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 10, 50)[:, None]

    def output(self, x: State) -> Vector:
        return x[:1]

    def advance(self, x: State, u: Vector) -> State:
        position, flow = x
        opening = dead_zone(u[0], self.dead_zone)
        pressure = 1 - self.load * np.sign(opening)
        flow = flow + self.spool * (opening * np.sqrt(pressure) - flow)
        return np.array([position + self.step_s * self.full_speed_mm_per_s * flow, flow])


@dataclass(frozen=True, kw_only=True)
class CoupledTanks(StrangerPlant):
    """Two lower tanks that are measured below two upper ones that are not; each pump fills one of
    the lower and, across, one of the upper. State: four levels in dm, lower ones first."""

    name = "tanks"
    describes = "two of four coupled tanks under two pumps"
    step_s = 1.0
    inputs = ("pump1", "pump2")
    outputs = ("level1", "level2")
    noise = (0.01, 0.01)
    lower = -1.0
    upper = 1.0

    seed: int = 103
    substep_s: float = 0.5

    def first_state(self) -> State:
        return np.array([1.0, 1.0, 0.5, 0.5])

    def clock(self) -> dict[str, object]:
        return {"t": np.arange(self.samples) * self.step_s}

    def excite(self, rng: Rng) -> Signals:
        first = random_levels(rng, self.samples, 15, 60)
        second = random_levels(rng, self.samples, 15, 60)
        return np.stack([first, second], axis=1)

    def output(self, x: State) -> Vector:
        return x[:2]

    def advance(self, x: State, u: Vector) -> State:
        p, q = 1 + 0.5 * u
        for _ in range(2):
            a, b, c, e = np.sqrt(np.maximum(x, 1e-3))
            change = np.array(
                [
                    0.1 * (0.7 * p + 0.5 * c - 1.2 * a),
                    0.1 * (0.6 * q + 0.5 * e - 1.1 * b),
                    0.08 * (0.4 * q - 0.6 * c),
                    0.08 * (0.3 * p - 0.5 * e),
                ]
            )
            x = np.maximum(x + self.substep_s * change, 0.0)
        return x


@dataclass(frozen=True, kw_only=True)
class FanArm(StrangerPlant):
    """Angle of an arm that a fan lifts, after a dead time of five samples: thrust with the square
    of the speed, weight, linear and quadratic damping. State (angle in rad, speed in rad/s, five
    inputs under way)."""

    name = "arm"
    describes = "angle of an arm lifted by a fan, with dead time"
    step_s = 0.08
    inputs = ("fan",)
    outputs = ("angle_deg",)
    noise = (0.2,)
    lower = 0.0
    upper = 1.0

    seed: int = 104
    dead_samples: int = 5
    thrust_per_s2: float = 2.5
    weight_per_s2: float = 4.0
    damping_per_s: float = 0.5
    drag: float = 0.8
    substeps: int = 4

    def first_state(self) -> State:
        return np.zeros(2 + self.dead_samples)

    def clock(self) -> dict[str, object]:
        return {"t": np.arange(self.samples) * self.step_s}

    def excite(self, rng: Rng) -> Signals:
        return random_levels(rng, self.samples, 8, 40, 0.0, 1.0)[:, None]

    def output(self, x: State) -> Vector:
        return np.degrees(x[:1])

    def advance(self, x: State, u: Vector) -> State:
        angle, speed, late, *under_way = x
        h = self.step_s / self.substeps
        lift = self.thrust_per_s2 * late * late
        for _ in range(self.substeps):
            braking = self.damping_per_s * speed + self.drag * speed * abs(speed)
            speed += h * (lift - self.weight_per_s2 * np.sin(angle) - braking)
            angle += h * speed
        return np.array([angle, speed, *under_way, u[0]])


PLANTS: tuple[type[StrangerPlant], ...] = (
    StirredReactor,
    Vehicle,
    HydraulicCylinder,
    CoupledTanks,
    FanArm,
)


def main() -> None:
    """Write every plant's log into a folder."""
    from stranger_plants_aside import PLANTS_ASIDE

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--to", type=Path, required=True, metavar="FOLDER")
    options = parser.parse_args()
    options.to.mkdir(parents=True, exist_ok=True)
    for plant in (*PLANTS, *PLANTS_ASIDE):
        print(plant().write_log(options.to))  # type: ignore[call-arg]


if __name__ == "__main__":
    main()
