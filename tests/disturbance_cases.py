"""A motor whose load torque is measured, as a log."""

from pathlib import Path

import numpy as np
import pandas as pd

from ssm_study.data.recorded import RecordedData

STEP_S = 0.05
SAMPLES = 900


def motor_log(folder: Path) -> Path:
    """A motor with a dead zone under a voltage and a load torque that change on their own."""
    rng = np.random.default_rng(0)
    voltage = rng.uniform(-3, 3, SAMPLES // 10).repeat(10)
    torque = rng.uniform(0, 2, SAMPLES // 25).repeat(25)
    speed = np.zeros(SAMPLES + 1)
    for k in range(SAMPLES):
        largest = max(abs(voltage[k]) - 0.4, 0.0)
        inside = np.sign(voltage[k]) * largest
        speed[k + 1] = 0.85 * speed[k] + 0.4 * inside - 0.5 * torque[k]
    noise = 0.01 * rng.standard_normal(SAMPLES)
    columns = {"voltage": voltage, "torque": torque, "speed": speed[:-1] + noise}
    path = folder / "motor.csv"
    table = pd.DataFrame(columns)
    table.to_csv(path, index=False)
    return path


def recorded(folder: Path, **fields: object) -> RecordedData:
    """The log as the command reads it."""
    told = {"input": "voltage", "output": "speed", "step_s": STEP_S, "start_up_samples": 10}
    path = str(motor_log(folder))
    return RecordedData(path=path, **told | fields)  # type: ignore[arg-type]
