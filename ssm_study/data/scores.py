"""How the benchmarks score a free-run simulation of their test records."""

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory, rmse

SCORES = ("rmse", "position_mm")


def benchmark_rmse(data: DataSet, y_hat: tuple[Float[np.ndarray, "_ p"], ...]) -> tuple[float, ...]:
    """One RMSE per test record, after the start-up samples: in the output's unit, or of the position in mm."""
    require(len(y_hat) == len(data.test), "y_hat", len(y_hat), f"there are {len(data.test)} test records", "score all")
    if data.metadata.get("score", "rmse") == "rmse":
        return tuple(rmse(r.y, y, data.start_up_samples) for r, y in zip(data.test, y_hat, strict=True))
    return tuple(position_rmse_mm(r, y, data.start_up_samples) for r, y in zip(data.test, y_hat, strict=True))


def position_rmse_mm(record: Trajectory, velocity_hat: Float[np.ndarray, "T 1"], start_up_samples: int) -> float:
    """`1000 rms(q - q_hat)` with `q[k] = q[s] + step_s sum(y[s+1..k])`, started at the measured position `q[s]`.

    The recorded velocity is the position's backward difference, so its running sum is the measured position exactly;
    `s` is the last start-up sample. Velocities in m/s.
    """
    kept = slice(start_up_samples, None)
    drift = np.cumsum(velocity_hat[kept] - record.y[kept]) * record.step_s
    return float(1000.0 * np.sqrt(np.mean(drift**2)))
