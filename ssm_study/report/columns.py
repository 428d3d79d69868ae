"""What each column of the gathered table is called in print, with its unit; others keep their own name."""

import pandas as pd

WORDS: dict[str, str] = {
    "run": "Run",
    "status": "Status",
    "verdict": "Outcome",
    "seed": "Seed",
    "order": "Model order",
    "hidden_width": "Hidden width",
    "slope_lower": "Slope floor asked (–)",
    "slope_upper": "Slope ceiling asked (–)",
    "scaffold_in": "Input scaffolding",
    "excitation": "Excitation",
    "rate_controller": "Controller rate asked, ρ (1/sample)",
    "rate_observer": "Observer rate asked, ρ (1/sample)",
    "synthesis_method": "Synthesis",
    "fit_train_percent": "Fit on training records (%)",
    "fit_validation_percent": "Fit on validation record (%)",
    "fit_test_percent": "Fit on test record (%)",
    "rmse_test": "RMSE on test record (output unit)",
    "input_coverage": "Input amplitude coverage (–)",
    "training_seconds": "Training time (s)",
    "input_slope_lower": "Smallest slope of S_u (–)",
    "input_slope_upper": "Largest slope of S_u (–)",
    "output_slope_lower": "Smallest slope of S_y (–)",
    "output_slope_upper": "Largest slope of S_y (–)",
    "slope_ratio": "Certified slope ratio of S_u, smallest / largest (–)",
    "bound_method": "Slope bound",
    "hankel_largest": "Largest Hankel singular value",
    "hankel_smallest": "Smallest Hankel singular value",
    "spectral_radius": "Spectral radius of A (–)",
    "controller_rate_limit": "Controller rate limit, ρ (1/sample)",
    "observer_rate_limit": "Observer rate limit, ρ (1/sample)",
    "controller_margin": "Controller LMI margin",
    "observer_margin": "Observer LMI margin",
    "controller_gain_norm": "Controller gain ‖K‖ (scaled)",
    "observer_gain_norm": "Observer gain ‖L‖ (scaled)",
    "synthesis_seconds": "Synthesis time (s)",
    "initial_conditions": "Starts tried",
    "stable_count": "Starts settled",
    "stable_fraction": "Starts settled (share)",
    "settling_time_mean_s": "Mean settling time (s)",
    "settling_time_worst_s": "Worst settling time (s)",
    "settling_time_open_loop_s": "Mean settling time, uncontrolled (s)",
    "overshoot_worst": "Worst overshoot (share of the start)",
    "input_peak_v": "Input peak (V)",
    "control_energy": "Control energy (V² s)",
    "empirical_rate": "Measured contraction, r (1/sample)",
    "certified_bound_violations": "Violations of the certified bound",
    "estimate_decay_rate": "Measured decay of the estimate's error (1/sample)",
    "certified_bound_excess_plant": "Beyond the certified bound on the plant (share of its start)",
    "mismatch_gain": "Model mismatch gain",
    "mismatch_margin": "Mismatch margin (–)",
    "resolved_margin": "Mismatch margin by frequency (–)",
    "controller_radius": "Controller's own spectral radius (–)",
    "predicted_stable": "Plant predicted stable",
    "infeasible_reason": "Why it is infeasible",
    "uncertified_reason": "Why it is not certified",
    "error_message": "Error",
}


CHOICES: dict[str, str] = {
    "pi": "PI",
    "lqg": "LQG",
    "mpc": "MPC",
    "lmi": "LMI",
    "paper_lmi": "paper's LMI",
    "modal_lmi": "modal LMI",
    "auto_integral": "auto, integral",
    "load_periodic": "load sine",
    "noise_free": "no noise",
    "noise_4x": "noise × 4",
    "spread": "off-nominal",
    "dc_motor": "DC motor",
    "dc_motor_limited": "DC motor, limited",
    "stribeck_drive": "Stribeck drive",
    "DCMotor": "DC motor",
    "StribeckDrive": "Stribeck drive",
    "CascadedTanks": "cascaded tanks",
    "QuadrupleTank": "quadruple tank",
}


def spoken(choice: object) -> str:
    """The printed name of a controller, situation or plant, e.g. `paper_lmi` -> `paper's LMI`."""
    return CHOICES.get(str(choice), str(choice).replace("_", " "))


def words(column: str) -> str:
    """The printed name of a column, e.g. `settling_time_mean_s` -> `Mean settling time (s)`."""
    return WORDS.get(column, column.replace("_", " "))


def column(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as numbers, NaN where the table has none: a figure must also draw on a table of failures."""
    if name not in table:
        return pd.Series(float("nan"), index=table.index, name=name, dtype=float)
    return pd.to_numeric(table[name], errors="coerce").astype(float)


def flag(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as truth values; missing counts as false (nothing is certified by silence)."""
    return column(table, name).fillna(0.0) > 0


def text(table: pd.DataFrame, name: str) -> pd.Series:
    """The column as words, empty where missing."""
    if name not in table:
        return pd.Series("", index=table.index, name=name, dtype=str)
    return table[name].astype("string").fillna("").astype(str)
