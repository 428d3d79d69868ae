"""How the benchmarks score a free-run simulation of their test records."""

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory, rmse

SCORES = ("rmse", "rmse_mm", "position_mm")  # rmse_mm: of an output in m


def benchmark_rmse(data: DataSet, y_hat: tuple[Float[np.ndarray, "_ p"], ...]) -> tuple[float, ...]:
    """One RMSE per test record, after the start-up samples: in the unit of `data.metadata["score"]`."""
    require(len(y_hat) == len(data.test), "y_hat", len(y_hat), f"there are {len(data.test)} test records", "score all")
    pairs, score = list(zip(data.test, y_hat, strict=True)), data.metadata.get("score", "rmse")
    if score == "position_mm":
        return tuple(position_rmse_mm(r, y, data.start_up_samples) for r, y in pairs)
    factor = 1000.0 if score == "rmse_mm" else 1.0
    return tuple(factor * rmse(r.y, y, data.start_up_samples) for r, y in pairs)


def position_rmse_mm(record: Trajectory, velocity_hat: Float[np.ndarray, "T 1"], start_up_samples: int) -> float:
    """`1000 rms(q - q_hat)` with `q[k] = q[s] + step_s sum(y[s+1..k])`, started at the measured position `q[s]`.

    The recorded velocity is the position's backward difference, so its running sum is the measured position exactly;
    `s` is the last start-up sample. Velocities in m/s.
    """
    kept = slice(start_up_samples, None)
    drift = np.cumsum(velocity_hat[kept] - record.y[kept]) * record.step_s
    return float(1000.0 * np.sqrt(np.mean(drift**2)))
