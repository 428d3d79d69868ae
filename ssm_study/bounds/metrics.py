"""Columns of a record that describe the certified model: its linear part, slopes and local
Gramians."""

from typing import Any

from ssm_study.bounds.gramians import bound_local_controllability, hankel_singular_values
from ssm_study.bounds.slopes import jacobian_ball, spectral_norm_bound
from ssm_study.columns import ITERATED, Column
from ssm_study.systems import StructuredSystem

NOT_KEPT = "the model before its reduction is not kept in the run's folder"

COLUMNS = (
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
    Column("hankel_largest", "Float64", word="Largest Hankel singular value", tolerance=ITERATED),
    Column("hankel_smallest", "Float64", word="Smallest Hankel singular value", tolerance=ITERATED),
    Column(
        "spectral_radius",
        "Float64",
        "low",
        word="Spectral radius of A",
        unit="–",
        tolerance=ITERATED,
    ),
    Column("input_slope_lower", "Float64", "high", word="Smallest slope of S_u", unit="–"),
    Column("input_slope_upper", "Float64", "low", word="Largest slope of S_u", unit="–"),
    Column("output_slope_lower", "Float64", "high", word="Smallest slope of S_y", unit="–"),
    Column("output_slope_upper", "Float64", "low", word="Largest slope of S_y", unit="–"),
    Column("bound_method", "string", word="Slope bound"),
    Column(
        "input_slope_lower_spectral", "Float64", word="Smallest slope of S_u from norms (unsound)"
    ),
    Column("input_slope_upper_spectral", "Float64", word="Largest slope of S_u from norms"),
    Column("local_controllability", "boolean", "high", word="Locally controllable"),
    Column(
        "controllability_gramian_lower",
        "Float64",
        word="Controllability Gramian, least",
        tolerance=ITERATED,
    ),
    Column(
        "controllability_gramian_upper",
        "Float64",
        word="Controllability Gramian, largest",
        tolerance=ITERATED,
    ),
    Column("local_observability", "boolean", "high", word="Locally observable"),
    Column(
        "observability_gramian_lower",
        "Float64",
        word="Observability Gramian, least",
        tolerance=ITERATED,
    ),
    Column(
        "observability_gramian_upper",
        "Float64",
        word="Observability Gramian, largest",
        tolerance=ITERATED,
    ),
)


def model_bound_columns(model: Any) -> dict[str, Any]:
    """Columns with the properties of the model without a controller: slopes, spectral radius,
    Hankel singular values, local Gramians. The paper's slopes, which are not a sound lower bound,
    stand beside them.

    Local controllability and observability, [Z26] Propositions 1 and 2, are of a recurrence without
    neurons. One that integrates has no Hankel values.
    """
    facts = dict[str, Any]()
    bounds = {
        "input": jacobian_ball(model.scaffold_in),
        "output": jacobian_ball(model.scaffold_out),
    }
    for side, bound in bounds.items():
        facts |= {f"{side}_slope_lower": bound.lower, f"{side}_slope_upper": bound.upper}
    sound = bounds["input"].lower, bounds["input"].upper
    lower, upper = (
        spectral_norm_bound(model.scaffold_in.network) if model.scaffold_in.kind == "mlp" else sound
    )
    facts |= {"input_slope_lower_spectral": lower, "input_slope_upper_spectral": upper}
    facts |= {"bound_method": bounds["input"].method, "states": model.linear.order}
    facts |= {"spectral_radius": model.linear.spectral_radius}
    if model.linear.spectral_radius < 1:
        hankel = hankel_singular_values(model.linear)
        facts |= {"hankel_largest": float(hankel[0]), "hankel_smallest": float(hankel[-1])}
    if isinstance(getattr(model, "system", None), StructuredSystem):
        return facts
    linear = model.linear
    input_ball = bounds["input"].ball
    output_ball = bounds["output"].ball
    properties = {
        "controllability": bound_local_controllability(linear.a, linear.b, input_ball),
        "observability": bound_local_controllability(linear.a.T, linear.c.T, output_ball),
    }
    for name, local in properties.items():
        facts[f"local_{name}"] = local.holds
        facts[f"{name}_gramian_lower"] = local.lower
        facts[f"{name}_gramian_upper"] = local.upper
    return facts
