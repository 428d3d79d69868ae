"""Schema-true tables and run folders with made-up numbers, for testing what draws and reads them.
Never a result."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ssm_study.engine.records import write_record

SCHEMA = """
study run status seed order hidden_width slope_lower slope_upper scaffold_in excitation
rate_controller rate_observer synthesis_method fit_train_percent fit_validation_percent
fit_test_percent rmse_test input_coverage training_seconds input_slope_lower input_slope_upper
output_slope_lower output_slope_upper bound_method hankel_largest hankel_smallest spectral_radius
controller_feasible controller_certified controller_margin controller_rate_limit
controller_gain_norm observer_feasible observer_certified observer_margin observer_rate_limit
observer_gain_norm synthesis_seconds initial_conditions stable_count stable_fraction
settling_time_mean_s settling_time_worst_s settling_time_open_loop_s overshoot_worst input_peak_v
control_energy empirical_rate certified_bound_violations mismatch_gain mismatch_margin
resolved_margin controller_radius predicted_stable
"""
COLUMNS = SCHEMA.split()


def table(runs: int = 60, seed: int = 0) -> pd.DataFrame:
    """Runs of every kind: settled, lost, infeasible, failed; missing is null."""
    rng = np.random.default_rng(seed)
    rows = [_row(k, rng) for k in range(runs)]
    frame = pd.DataFrame(rows, columns=COLUMNS)
    frame["controller_feasible"] = frame["controller_feasible"].astype("boolean")
    return frame


def failures(runs: int = 4) -> pd.DataFrame:
    """A study in which nothing worked."""
    rows = [
        {"study": "sweep", "run": f"f{k}", "status": "failed", "seed": k, "order": 8}
        for k in range(runs)
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def empty() -> pd.DataFrame:
    return pd.DataFrame(columns=COLUMNS)


def _row(k: int, rng: np.random.Generator) -> dict[str, Any]:
    """One run: every seventeenth failed, infeasible where the rate lies beyond the limit."""
    slopes = [0.01, 0.05, 0.2, 0.5]
    slope = float(rng.choice(slopes))
    rates = [0.02, 0.05, 0.1, 0.2, 0.3, 0.4]
    rate = float(rng.choice(rates))
    smallest_ratio = 0.97 * (1 - slope) / (1 + slope)
    largest_rate = 1 - smallest_ratio**2
    limit = float(largest_rate) * rng.uniform(0.9, 1.1)
    growth = 4 * (k % 3)
    order = 4 + growth
    widths = [8, 16, 32]
    hidden_width = int(rng.choice(widths))
    methods = ["lmi", "riccati", "closed_form"]
    synthesis_method = str(rng.choice(methods))
    row: dict[str, Any] = {"study": "sweep", "seed": k % 5}
    row["run"] = f"order{4 + 4 * (k % 3)}_{k:04d}"
    row["order"] = order
    row["hidden_width"] = hidden_width
    row["slope_lower"] = slope
    row["slope_upper"] = 1.0
    row["scaffold_in"] = "mlp"
    row["excitation"] = "aprbs"
    row["rate_controller"] = rate
    row["rate_observer"] = 0.2
    row["synthesis_method"] = synthesis_method
    if k % 17 == 11:
        return {**row, "status": "failed"}
    fit = float(rng.uniform(70, 92))
    model = _model_columns(fit, slope, rate, limit)
    if rate >= limit:
        return {**row, **model, "status": "infeasible"}
    loop_columns = _loop_columns(fit, rate, rng)
    return {**row, **model, **loop_columns, "status": "ok"}


def _model_columns(fit: float, slope: float, rate: float, limit: float) -> dict[str, Any]:
    return {
        "fit_train_percent": fit + 1, "fit_validation_percent": fit + 0.5, "fit_test_percent": fit,
        "rmse_test": 0.4,
        "input_coverage": 0.8, "training_seconds": 4.0, "input_slope_lower": slope * 1.1,
        "input_slope_upper": 0.97,
        "output_slope_lower": 1.0, "output_slope_upper": 1.0, "bound_method": "exact",
        "hankel_largest": 17.6,
        "hankel_smallest": 0.01, "spectral_radius": 0.97, "controller_feasible": rate < limit,
        "controller_certified": rate < limit, "controller_margin": 1e-3,
        "controller_rate_limit": limit,
    }  # fmt: skip


def _loop_columns(fit: float, rate: float, rng: np.random.Generator) -> dict[str, Any]:
    undisturbed = 14 - 20 * rate
    penalty = (92 - fit) / 5
    difference = undisturbed - penalty
    drawn_count = rng.normal(difference, 1.5)
    clipped = np.clip(drawn_count, 0, 10)
    stable = int(clipped)
    drawn_time = rng.uniform()
    time_s = 0.19 * (1 - rate) + 0.01 * drawn_time
    controller_gain_norm = 10 ** (3 * rate)
    settling_time_mean_s = time_s if stable else None
    settling_time_worst_s = 1.4 * time_s if stable else None
    input_peak_v = 3.0 + 9 * rate
    mismatch_margin = 0.2 + stable / 6
    resolved_margin = 0.2 + stable / 6
    return {
        "controller_gain_norm": controller_gain_norm, "observer_feasible": True,
        "observer_certified": True,
        "observer_margin": 1e-3, "observer_rate_limit": 1.0, "observer_gain_norm": 1.2,
        "synthesis_seconds": 0.01,
        "initial_conditions": 10, "stable_count": stable, "stable_fraction": stable / 10,
        "settling_time_mean_s": settling_time_mean_s,
        "settling_time_worst_s": settling_time_worst_s,
        "settling_time_open_loop_s": 0.185, "overshoot_worst": 0.3, "input_peak_v": input_peak_v,
        "control_energy": 1.5, "empirical_rate": 0.8, "certified_bound_violations": 0,
        "mismatch_gain": 0.3,
        "mismatch_margin": mismatch_margin, "resolved_margin": resolved_margin,
        "controller_radius": 0.9,
        "predicted_stable": stable >= 5,
    }  # fmt: skip


def write_study(folder: Path, frame: pd.DataFrame) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    frame.to_parquet(folder / "runs.parquet")
    objects = frame.astype(object)
    is_present = frame.notna()
    filled = objects.where(is_present, None)
    rows = filled.to_dict("records")
    for row in rows:
        run_name = str(row["run"])
        run = folder / run_name
        run.mkdir(exist_ok=True)
        record = {str(name): value for name, value in row.items()}
        write_record(run, record, durable=False)
    return folder
