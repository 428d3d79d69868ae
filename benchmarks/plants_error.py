"""How exact the batched motor is: `python benchmarks/plants_error.py --to
results/reference/benchmarks`, a minute.

Load speeds of five trajectories of 500 samples, APRBS of the plant's amplitude, from rest, against
the event-accurate motor. Writes plants_error.csv, one row per step of the solver: the step that is
taken (a whole number of them fills a sampling period), largest and rms error, and the order of
accuracy from the step before.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from plants_simulation import motor_from_yaml, simulate_exactly

from ssm_study.data.excitations.excitation import APRBS, SignalRequest

CASES = 5
SAMPLES = 500
STEPS_S = (8e-4, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5)


def table() -> pd.DataFrame:
    motor = motor_from_yaml()
    asked = SignalRequest(
        samples=SAMPLES, step_s=motor.step_s, amplitude=(motor.amplitude_v,), clock_s=motor.clock_s
    )
    u = np.stack(
        [APRBS(longest_hold_clocks=5).signal(asked, np.random.default_rng(k)) for k in range(CASES)]
    )
    exact = np.stack([simulate_exactly(motor, one, np.zeros(4)).x[:-1, 2] for one in u])
    rows = []
    for step in STEPS_S:
        error = replace(motor, solver_step_s=step).simulate(u)[0][:, :, 2] - exact
        taken = motor.step_s / np.ceil(motor.step_s / step - 1e-9)
        rows.append(
            (step, taken, np.abs(error).max(), np.sqrt(np.mean(error**2)), np.abs(exact).max())
        )
    columns = [
        "solver_step_s",
        "step_taken_s",
        "largest_error_rad_per_s",
        "rms_error_rad_per_s",
        "largest_speed_rad_per_s",
    ]
    found = pd.DataFrame(rows, columns=columns)
    ratios = (np.log(found[name]).diff() for name in ("largest_error_rad_per_s", "step_taken_s"))
    return found.assign(order=next(ratios) / next(ratios))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, required=True)
    to = parser.parse_args().to
    to.mkdir(parents=True, exist_ok=True)
    table().to_csv(to / "plants_error.csv", index=False, lineterminator="\n", float_format="%.3g")
