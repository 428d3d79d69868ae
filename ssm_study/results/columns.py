"""The columns of `runs.parquet`: their order, their types, and which way is better."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["string", "Int64", "Float64", "boolean"]


@dataclass(frozen=True)
class Column:
    """A typed column; `better` is `high`, `low`, or empty where no direction is better."""

    name: str
    kind: Kind
    better: Literal["high", "low", ""] = ""
    head: str = ""  # a short heading for narrow tables


COLUMNS = (
    Column("study", "string"),
    Column("run", "string"),
    Column("status", "string"),
    Column("seed", "Int64"),
    Column("order", "Int64"),
    Column("hidden_width", "Int64", head="width"),
    Column("slope_lower", "Float64", head="mu"),
    Column("slope_upper", "Float64", head="nu"),
    Column("scaffold_in", "string"),
    Column("excitation", "string"),
    Column("rate_controller", "Float64", head="r ctl"),
    Column("rate_observer", "Float64", head="r obs"),
    Column("synthesis_method", "string", head="method"),
    Column("fit_train_percent", "Float64", "high", "fit train"),
    Column("fit_validation_percent", "Float64", "high", "fit val"),
    Column("fit_test_percent", "Float64", "high", "fit %"),
    Column("rmse_test", "Float64", "low", "rmse"),
    Column("input_coverage", "Float64", "high", "coverage"),
    Column("training_seconds", "Float64", "low", "train s"),
    Column("input_slope_lower", "Float64", "high"),
    Column("input_slope_upper", "Float64", "low"),
    Column("output_slope_lower", "Float64", "high"),
    Column("output_slope_upper", "Float64", "low"),
    Column("bound_method", "string"),
    Column("hankel_largest", "Float64"),
    Column("hankel_smallest", "Float64"),
    Column("spectral_radius", "Float64", "low"),
    Column("controller_feasible", "boolean", "high"),
    Column("controller_certified", "boolean", "high", "ctl cert"),
    Column("controller_margin", "Float64", "high"),
    Column("controller_rate_limit", "Float64", "low"),
    Column("controller_gain_norm", "Float64", "low"),
    Column("observer_feasible", "boolean", "high"),
    Column("observer_certified", "boolean", "high", "obs cert"),
    Column("observer_margin", "Float64", "high"),
    Column("observer_rate_limit", "Float64", "low"),
    Column("observer_gain_norm", "Float64", "low"),
    Column("synthesis_seconds", "Float64", "low"),
    Column("initial_conditions", "Int64"),
    Column("stable_count", "Int64", "high", "stable"),
    Column("stable_fraction", "Float64", "high", "stable"),
    Column("settling_time_mean_s", "Float64", "low", "settle s"),
    Column("settling_time_worst_s", "Float64", "low", "worst s"),
    Column("settling_time_open_loop_s", "Float64", "", "open s"),
    Column("overshoot_worst", "Float64", "low"),
    Column("input_peak_v", "Float64", "low", "peak V"),
    Column("control_energy", "Float64", "low", "energy"),
    Column("empirical_rate", "Float64", "high"),
    Column("certified_bound_violations", "Int64", "low"),
    Column("mismatch_gain", "Float64", "low"),
    Column("mismatch_margin", "Float64", "high", "in total"),
    Column("resolved_margin", "Float64", "high", "margin"),
    Column("controller_radius", "Float64", "low", "ctl radius"),
    Column("predicted_stable", "boolean", "high", "predicted"),
)
BY_NAME = {column.name: column for column in COLUMNS}
# Best first, unless asked otherwise: settles everywhere, then faster, then the better model.
RANKING = ("stable_fraction", "settling_time_mean_s", "fit_test_percent")
