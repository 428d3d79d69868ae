"""Result-table columns that describe the certified model: its linear part, slopes and local
Gramians."""

from typing import Any

from ssm_study.bounds.gramians import bound_local_controllability, hankel_singular_values
from ssm_study.bounds.slopes import SlopeBound, jacobian_ball, spectral_norm_bound
from ssm_study.columns import Column, iterative_result_column
from ssm_study.systems import StructuredSystem

NOT_KEPT = "the model before its reduction is not kept in the run's folder"

LINEAR_COLUMNS = (
    Column(
        "fit_test_before_reduction_percent",
        "Float64",
        "high",
        "",
        "Fit before reduction",
        "%",
        unchecked=NOT_KEPT,
    ),
    Column("states", "Int64", word="States of the certified model"),
    iterative_result_column("hankel_largest", "", "Largest Hankel singular value"),
    iterative_result_column("hankel_smallest", "", "Smallest Hankel singular value"),
    iterative_result_column("spectral_radius", "low", "Spectral radius of A", "–"),
)

SLOPE_COLUMNS = (
    Column("input_slope_lower", "Float64", "high", word="Smallest slope of S_u", unit="–"),
    Column("input_slope_upper", "Float64", "low", word="Largest slope of S_u", unit="–"),
    Column("output_slope_lower", "Float64", "high", word="Smallest slope of S_y", unit="–"),
    Column("output_slope_upper", "Float64", "low", word="Largest slope of S_y", unit="–"),
    Column("bound_method", "string", word="Slope bound"),
    Column(
        "input_slope_lower_spectral", "Float64", word="Smallest slope of S_u from norms (unsound)"
    ),
    Column("input_slope_upper_spectral", "Float64", word="Largest slope of S_u from norms"),
)

CONTROLLABILITY_COLUMNS = (
    Column("local_controllability", "boolean", "high", word="Locally controllable"),
    iterative_result_column("controllability_gramian_lower", "", "Controllability Gramian, least"),
    iterative_result_column(
        "controllability_gramian_upper", "", "Controllability Gramian, largest"
    ),
)

OBSERVABILITY_COLUMNS = (
    Column("local_observability", "boolean", "high", word="Locally observable"),
    iterative_result_column("observability_gramian_lower", "", "Observability Gramian, least"),
    iterative_result_column("observability_gramian_upper", "", "Observability Gramian, largest"),
)

COLUMNS = (*LINEAR_COLUMNS, *SLOPE_COLUMNS, *CONTROLLABILITY_COLUMNS, *OBSERVABILITY_COLUMNS)


def model_bound_columns(model: Any) -> dict[str, Any]:
    """Table columns with properties of a model without controller: slope bounds, spectral radius,
    Hankel singular values, Gramians. The paper's slopes, which are not a sound lower bound, stand
    beside them.

    Local controllability and observability, [Z26] Propositions 1 and 2, are of a recurrence without
    neurons. One that integrates has no Hankel values.
    """
    linear = model.linear
    input_bound = jacobian_ball(model.scaffold_in)
    output_bound = jacobian_ball(model.scaffold_out)
    facts = _slope_columns(model, input_bound, output_bound)
    facts["states"] = linear.order
    facts["spectral_radius"] = linear.spectral_radius
    if linear.spectral_radius < 1:
        hankel = hankel_singular_values(linear)
        facts["hankel_largest"] = float(hankel[0])
        facts["hankel_smallest"] = float(hankel[-1])
    if isinstance(getattr(model, "system", None), StructuredSystem):
        return facts
    controllability = bound_local_controllability(linear.a, linear.b, input_bound.ball)
    observability = bound_local_controllability(linear.a.T, linear.c.T, output_bound.ball)
    properties = {"controllability": controllability, "observability": observability}
    for name, local in properties.items():
        facts[f"local_{name}"] = local.holds
        facts[f"{name}_gramian_lower"] = local.lower
        facts[f"{name}_gramian_upper"] = local.upper
    return facts


def _slope_columns(model: Any, input_bound: SlopeBound, output_bound: SlopeBound) -> dict[str, Any]:
    """Table columns with proved slope bounds of a model's static maps, and with the bounds by the
    method of Zakwan et al."""
    facts = dict[str, Any]()
    for side, bound in {"input": input_bound, "output": output_bound}.items():
        facts[f"{side}_slope_lower"] = bound.lower
        facts[f"{side}_slope_upper"] = bound.upper
    lower = input_bound.lower
    upper = input_bound.upper
    if model.scaffold_in.kind == "mlp":
        lower, upper = spectral_norm_bound(model.scaffold_in.network)
    facts["input_slope_lower_spectral"] = lower
    facts["input_slope_upper_spectral"] = upper
    facts["bound_method"] = input_bound.method
    return facts
