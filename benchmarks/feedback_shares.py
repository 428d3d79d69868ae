"""How much of what is new in the input is found in the output, in open-loop logs and in logs of a
loop.

    python -m benchmarks.feedback_shares --to results/reference/evidence        (half a minute on
    one core)

The two shares of `ssm_study/evidence/feedback.py`, without and with the present output, and how
many of the logs the check takes for closed-loop logs: measured records, simulated plants, and drawn
logs of 300 to 1,500 samples each. Drawn are plants of one to four real poles, inputs of held levels
or of filtered noise, sensor noise of up to all that the input moves; in the loops a PI, levels as
its set point, and noise from a tenth on. Writes feedback_shares.csv.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from benchmarks.common import study_of
from ssm_study.evidence.feedback import feedback_error_reduction, shows_closed_loop
from ssm_study.signals import DataSet, Scale, Trajectory

MEASURED = ("ced", "cascaded_tanks", "silverbox", "emps")
SIMULATED = ("dc_motor", "stribeck_drive", "cascaded_tanks")
OPEN = 4000
CLOSED = 1000
SHOWN = ("least", "5th", "median", "95th", "largest")
Samples = np.ndarray


def plant(rng: np.random.Generator) -> Samples:
    """Poles of a plant of gain one."""
    return rng.uniform(0.3, 0.98, rng.integers(1, 5))


def levels(rng: np.random.Generator, samples: int) -> Samples:
    held = int(rng.integers(1, 30))
    return rng.uniform(-1, 1, samples // held + 1).repeat(held)[:samples]


def opened(rng: np.random.Generator) -> tuple[Samples, Samples]:
    """Input and output of one log without a loop."""
    samples = int(rng.integers(300, 1501))
    poles = plant(rng)
    slow = rng.uniform(0, 0.95)
    u = (
        levels(rng, samples)
        if rng.random() < 0.5
        else lfilter([1], [1, -slow], rng.standard_normal(samples))
    )
    y = u
    for pole in poles:
        y = lfilter([0, 1 - pole], [1, -pole], y)
    return u, y + rng.uniform(0, 1) * np.std(y) * rng.standard_normal(samples)


def closed(rng: np.random.Generator) -> tuple[Samples, Samples]:
    """Input and output of one log of a PI loop that settles; the noise is a share of what the set
    point moves."""
    while True:
        samples = int(rng.integers(300, 1501))
        poles = plant(rng)
        gain = rng.uniform(0.3, 3)
        integral = rng.uniform(0.01, 0.2)
        noise = rng.uniform(0.1, 1) * 0.5
        r = levels(rng, samples)
        states = np.zeros(len(poles))
        summed = 0.0
        u = np.zeros(samples)
        y = np.zeros(samples)
        for k in range(samples):
            y[k] = states[-1] + noise * rng.standard_normal()
            u[k], summed = gain * (r[k] - y[k] + summed), summed + integral * (r[k] - y[k])
            states = poles * states + (1 - poles) * np.append(u[k], states[:-1])
        if np.abs(y).max() < 10:
            return u, y


def drawn(log: Callable, count: int) -> Iterator[DataSet]:
    for seed in range(count):
        u, y = (side[:, None] for side in log(np.random.default_rng(seed)))
        record = Trajectory(u=u, y=y, step_s=0.1)
        once = (record,)
        yield DataSet(
            training=once,
            validation=once,
            test=once,
            inputs=(),
            outputs=(),
            scale=Scale.identity(1, 1),
        )


def measured() -> Iterator[tuple[str, DataSet]]:
    for name in MEASURED:
        yield f"{name}, measured", study_of(f"data={name}").data.build(0)


def simulated() -> Iterator[tuple[str, DataSet]]:
    for name in SIMULATED:
        asked = study_of(f"plant={name}")
        yield name, asked.data.build(asked.plant, asked.excitation, 0)


def row(name: str, logs: Iterable[DataSet]) -> dict[str, object]:
    shares = []
    alarms = 0
    for data in logs:
        shares.append((feedback_error_reduction(data, 1), feedback_error_reduction(data, 0)))
        alarms += shows_closed_loop(data, *shares[-1])
    ends = np.percentile(100 * np.array(shares), [0, 5, 50, 95, 100], axis=0)
    told: dict[str, object] = {"logs": name, "count": len(shares), "taken_for_closed": alarms}
    for side, values in zip(("earlier", "present"), ends.T, strict=True):
        told |= {f"{side}_{word}_percent": value for word, value in zip(SHOWN, values, strict=True)}
    return told


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, required=True)
    to = parser.parse_args().to
    to.mkdir(parents=True, exist_ok=True)
    rows = [row(name, [data]) for name, data in (*measured(), *simulated())]
    rows += [
        row("drawn, open loop", drawn(opened, OPEN)),
        row("drawn, PI loop", drawn(closed, CLOSED)),
    ]
    pd.DataFrame(rows).to_csv(
        to / "feedback_shares.csv", index=False, lineterminator="\n", float_format="%.3g"
    )
