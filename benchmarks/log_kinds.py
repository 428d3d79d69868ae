"""Twelve kinds of logs in synthetic form, with seeds: `python benchmarks/log_kinds.py --to FOLDER`.

Each kind is one property of logs that strangers bring and that a default choice of model gets
wrong:
an output that answers within the sample, a dead time, a position with a dead zone, and so on. The
generators were written before the choice of models was; the choice is measured on them
(`docs/models.md`). Every log is a table of `time_s`, inputs and outputs; equal seeds give equal
tables. Parameters of the plants are drawn from the seed within the stated ranges, so that five
seeds are five plants.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

SAMPLES = 4000
NOISE = 0.01  # of the output's standard deviation
Rng = np.random.Generator


@dataclass(frozen=True, kw_only=True)
class LogKind:
    """One kind of log: what to call its signals, how it is sampled, and how it is made."""

    name: str
    describes: str
    step_s: float
    make: Callable[[Rng, int], tuple[np.ndarray, np.ndarray]]
    unmeasured: int = 0  # of the last inputs: they act, and the log does not have them

    def log(self, seed: int, samples: int = SAMPLES) -> pd.DataFrame:
        """The log of this seed: `time_s`, `u` (or `u_1`, `u_2`), `y`."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        u, y = self.make(rng, samples)
        logged = u[:, : u.shape[1] - self.unmeasured]
        names = ["u"] if logged.shape[1] == 1 else [f"u_{j + 1}" for j in range(logged.shape[1])]
        table = pd.DataFrame({"time_s": np.round(self.step_s * np.arange(samples), 9)})
        table[names] = logged
        table["y"] = y
        return table


def random_levels(rng: Rng, samples: int, low: int, high: int) -> np.ndarray:
    """Levels uniform in [-1, 1], each held for `low` to `high` samples."""
    holds = rng.integers(low, high + 1, samples)
    levels = rng.uniform(-1.0, 1.0, samples)
    return np.repeat(levels, holds)[:samples]


def with_noise(rng: Rng, y: np.ndarray, share: float = NOISE) -> np.ndarray:
    """The output with white measurement noise of that share of its standard deviation."""
    return y + share * y.std() * rng.standard_normal(len(y))


def column(u: np.ndarray) -> np.ndarray:
    """One input as a table of one column."""
    return u[:, None]


def same_sample(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two lags in a row, logged after the input of the same sample has acted; tanh at the input."""
    u = random_levels(rng, samples, 4, 30)
    fast = rng.uniform(0.5, 0.7)
    slow = rng.uniform(0.9, 0.95)
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        x[0] = fast * x[0] + (1 - fast) * np.tanh(1.5 * u[k])
        x[1] = slow * x[1] + (1 - slow) * x[0]
        y[k] = x[1] + 0.3 * x[0]
    return column(u), with_noise(rng, y)


def dead_time(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two lags behind a dead time of 5 to 12 samples, with a square root at the input."""
    u = random_levels(rng, samples, 8, 60)
    delay = int(rng.integers(5, 13))
    fast = rng.uniform(0.6, 0.8)
    slow = rng.uniform(0.92, 0.97)
    driven = np.sign(u) * np.sqrt(np.abs(u))
    late = np.concatenate([np.zeros(delay), driven])[:samples]
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[1]
        x[1] = slow * x[1] + (1 - slow) * x[0]
        x[0] = fast * x[0] + (1 - fast) * late[k]
    return column(u), with_noise(rng, y)


def position_with_dead_zone(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A motor's angle in encoder counts: dead zone of 0.15 to 0.3, lag, running sum, rounded."""
    u = random_levels(rng, samples, 5, 40)
    zone = rng.uniform(0.15, 0.3)
    lag = rng.uniform(0.7, 0.9)
    moving = np.sign(u) * np.maximum(np.abs(u) - zone, 0.0)
    # An operator brings the motor back now and then, so that the angle stays within a few turns.
    position = np.zeros(samples)
    speed = 0.0
    for k in range(1, samples):
        away = abs(position[k - 1]) > 400.0 and moving[k - 1] * position[k - 1] > 0
        if away:
            u[k - 1 :] *= -1
            moving[k - 1 :] *= -1
        speed = lag * speed + (1 - lag) * 30.0 * moving[k - 1]
        position[k] = position[k - 1] + speed
    return column(u), np.round(position)


def bilinear(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two states whose decay depends on the input: a heater in a flow, a generator's field."""
    u = random_levels(rng, samples, 5, 40)
    slow = rng.uniform(0.88, 0.93)
    change = rng.uniform(0.05, 0.08)
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[1]
        x[1] = 0.7 * x[1] + 0.3 * x[0]
        x[0] = (slow + change * u[k]) * x[0] + 0.1 * u[k] + 0.05
    return column(u), with_noise(rng, y)


def slow_mode_with_coarse_sensor(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A lag of 150 to 400 samples beside a fast one, read in steps of a sixtieth of the range."""
    u = random_levels(rng, samples, 40, 200)
    slow = np.exp(-1.0 / rng.uniform(150.0, 400.0))
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[0] + 0.3 * x[1]
        x[0] = slow * x[0] + (1 - slow) * (u[k] + 0.4 * u[k] ** 2)
        x[1] = 0.8 * x[1] + 0.2 * u[k]
    resolution = np.ptp(y) / 60.0
    return column(u), resolution * np.round(y / resolution)


def many_resonances(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Five lightly damped modes between 1/60 and 1/5 of the sampling frequency: a beam."""
    u = random_levels(rng, samples, 1, 12)
    frequencies = np.sort(rng.uniform(1 / 60, 1 / 5, 5))
    y = np.zeros(samples)
    for frequency in frequencies:
        radius = rng.uniform(0.96, 0.99)
        turn = radius * np.exp(2j * np.pi * frequency)
        gain = rng.uniform(0.3, 1.0) * (1 - radius)
        x = 0j
        for k in range(samples):
            y[k] += 2.0 * x.imag
            x = turn * x + gain * u[k]
    return column(u), with_noise(rng, y)


def hardening_spring(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A mass on a spring that grows stiffer (Duffing), its force held for a few samples."""
    u = random_levels(rng, samples, 3, 20)
    stiffness = rng.uniform(0.03, 0.06)
    cubic = rng.uniform(0.02, 0.05)
    damping = rng.uniform(0.05, 0.1)
    substeps = 5
    h = 1.0 / substeps
    y = np.zeros(samples)
    position = 0.0
    velocity = 0.0
    for k in range(samples):
        y[k] = position
        for _ in range(substeps):
            force = 0.1 * u[k] - damping * velocity - stiffness * position - cubic * position**3
            velocity += h * force
            position += h * velocity
    return column(u), with_noise(rng, y)


def gain_by_direction(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A lag that rises faster than it falls, with 1.5 to 3 times the gain for positive inputs."""
    u = random_levels(rng, samples, 5, 40)
    ratio = rng.uniform(1.5, 3.0)
    rise = rng.uniform(0.2, 0.3)
    fall = rng.uniform(0.06, 0.12)
    y = np.zeros(samples)
    x = 0.0
    for k in range(samples):
        y[k] = x
        target = u[k] * (ratio if u[k] > 0 else 1.0)
        x += (rise if target > x else fall) * (target - x)
    return column(u), with_noise(rng, y)


def unmeasured_input(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two inputs act, one of them is in the log; the other is a slow load of a fifth of the
    power."""
    u, load, to_input, to_load = responses_to_both_inputs(rng, samples)
    return np.stack([u, load], axis=1), with_noise(rng, to_input + to_load)


def responses_to_both_inputs(rng: Rng, samples: int) -> tuple[np.ndarray, ...]:
    """Logged input, load, and the plant's responses to each alone: a saturating first-order lag,
    and a slow one."""
    u = random_levels(rng, samples, 5, 40)
    load = random_levels(rng, samples, 100, 400)
    fast = rng.uniform(0.8, 0.9)
    to_input = np.zeros(samples)
    to_load = np.zeros(samples)
    for k in range(samples - 1):
        to_input[k + 1] = fast * to_input[k] + (1 - fast) * np.tanh(1.5 * u[k])
        to_load[k + 1] = 0.98 * to_load[k] + 0.02 * 0.5 * load[k]
    return u, load, to_input, to_load


def drifting_gain(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two lags whose gain falls by 20 to 40 % over the log: something wears or heats up."""
    u = random_levels(rng, samples, 5, 40)
    loss = rng.uniform(0.2, 0.4)
    fast = rng.uniform(0.5, 0.7)
    slow = rng.uniform(0.88, 0.94)
    gain = 1.0 - loss * np.arange(samples) / samples
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[1]
        x[1] = slow * x[1] + (1 - slow) * x[0]
        x[0] = fast * x[0] + (1 - fast) * gain[k] * (u[k] + 0.3 * u[k] ** 2)
    return column(u), with_noise(rng, y)


def saturating_sensor(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two lags read by a sensor that ends at 50 to 70 % of the range, on one side."""
    u = random_levels(rng, samples, 8, 60)
    slow = rng.uniform(0.9, 0.95)
    y = np.zeros(samples)
    x = np.zeros(2)
    for k in range(samples):
        y[k] = x[1]
        x[1] = slow * x[1] + (1 - slow) * x[0]
        x[0] = 0.7 * x[0] + 0.3 * u[k]
    noisy = with_noise(rng, y)
    end = rng.uniform(0.5, 0.7) * y.max()
    return column(u), np.minimum(noisy, end)


def hysteresis(rng: Rng, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A lag behind a Bouc-Wen hysteresis: the output remembers from where the input came."""
    u = random_levels(rng, samples, 10, 60)
    smooth = np.convolve(np.concatenate([np.zeros(7), u]), np.full(8, 1 / 8), mode="valid")
    share = rng.uniform(0.3, 0.5)
    width = rng.uniform(0.2, 0.35)
    y = np.zeros(samples)
    x = 0.0
    strain = 0.0
    for k in range(samples):
        y[k] = x
        du = smooth[k] - smooth[k - 1] if k else 0.0
        strain += du / width * (1.0 - np.abs(strain) * (0.5 + 0.5 * np.sign(du * strain)))
        x = 0.9 * x + 0.1 * ((1 - share) * smooth[k] + share * strain)
    return column(u), with_noise(rng, y)


KINDS = (
    LogKind(
        name="same_sample", describes="answers within the sample", step_s=0.01, make=same_sample
    ),
    LogKind(name="dead_time", describes="dead time", step_s=0.1, make=dead_time),
    LogKind(
        name="position_dead_zone",
        describes="position with dead zone",
        step_s=0.01,
        make=position_with_dead_zone,
    ),
    LogKind(name="bilinear", describes="product of input and state", step_s=0.1, make=bilinear),
    LogKind(
        name="slow_coarse",
        describes="slow mode with coarse sensor",
        step_s=1.0,
        make=slow_mode_with_coarse_sensor,
    ),
    LogKind(name="resonances", describes="many resonances", step_s=0.002, make=many_resonances),
    LogKind(name="hardening", describes="hardening spring", step_s=0.05, make=hardening_spring),
    LogKind(
        name="direction", describes="direction-dependent gain", step_s=0.05, make=gain_by_direction
    ),
    LogKind(
        name="unmeasured",
        describes="two inputs of which one is measured",
        step_s=1.0,
        make=unmeasured_input,
        unmeasured=1,
    ),
    LogKind(name="drifting", describes="gain that drifts", step_s=0.1, make=drifting_gain),
    LogKind(name="saturating", describes="saturating sensor", step_s=0.1, make=saturating_sensor),
    LogKind(name="hysteresis", describes="hysteresis", step_s=0.02, make=hysteresis),
)


def kind_named(name: str) -> LogKind:
    """The kind of that name; raises `KeyError` for another."""
    return {kind.name: kind for kind in KINDS}[name]


def main() -> None:
    """Write the logs of some seeds as `<kind>_<seed>.csv`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--to", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], metavar="N")
    options = parser.parse_args()
    options.to.mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        for seed in options.seeds:
            path = options.to / f"{kind.name}_{seed}.csv"
            kind.log(seed).to_csv(path, index=False)
            print(path)


if __name__ == "__main__":
    main()
