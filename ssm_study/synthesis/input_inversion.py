"""Control laws that invert the input map, `u = S_u^{-1}(K xh)`, if the map is strictly monotone.

A deviation from `v = S_u(u)`, at a limit of u, is known to the observer. Through a dead zone the
law asks for several times the input. Source: docs/theory.md, "With neurons".
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ssm_study.bounds.network import invert_map
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, Infeasible
from ssm_study.certificates.theorem import find_theorem
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.structured import Model
from ssm_study.refusal import require
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.signals import DataSet, Scale, Trajectories
from ssm_study.systems import Balls

# Theorems of a state feedback, and those of the same gain behind `S_u^{-1}`.
INVERTED = {
    "state_feedback": "inverted_input",
    "structured_state_feedback": "structured_inverted_input",
}


def model_behind_map(model: Model) -> Model:
    """Model without its input map, with input `v = S_u(u)`. Raises `BadRequest` unless `S_u` can be
    inverted channel by channel."""
    problem = "is not strictly monotone in each channel"
    remedy = "use scaffold@model.scaffold_in=monotone"
    kind = model.scaffold_in.kind
    portable = model.scaffold_in.as_portable()
    is_invertible = invert_map(portable) is not None
    require(is_invertible, "synthesis.invert_input", kind, problem, remedy)
    channels = model.scaffold_in.outputs
    input_scale = np.ones(channels)
    input_equilibrium = np.zeros(channels)
    scale = {"input_scale": input_scale, "input_equilibrium": input_equilibrium}
    scaled: Scale = replace(model.scale, **scale)
    scaffold_in = LinearScaffold.identity(channels)
    return replace(model, scaffold_in=scaffold_in, scale=scaled)


def records_behind_map(model: Model, records: Trajectories) -> Trajectories:
    """Records with `v = S_u(u)`, the input after the input map, in place of the input."""
    return tuple(replace(record, u=model.map_input(record.u)) for record in records)


def mismatch_behind_map(
    model: Model, records: Trajectories, start_up_samples: int, mismatch_records: Trajectories
) -> Mismatch:
    """Model error of the records with `v = S_u(u)`, the input after the input map, as the input."""
    linear_model = model_behind_map(model)
    mapped_records = records_behind_map(model, records)
    mapped_mismatch_records = records_behind_map(model, mismatch_records)
    return measure_mismatch(linear_model, mapped_records, start_up_samples, mapped_mismatch_records)


def mismatch_for_law(law: Any, model: Model, data: DataSet, mismatch: Mismatch) -> Mismatch:
    """Model error in the variables of a control law that inverts the input map. This is u, or v
    where the law inverts the input map; `mismatch` is relative to u."""
    inverts = law.inverts_input_map if isinstance(law, Design) else law.invert_input
    if not inverts:
        return mismatch
    records = data.validation, data.start_up_samples, data.mismatch_records
    return mismatch_behind_map(model, *records)


def mark_as_inverting(design: Design) -> Design:
    """Copy of a design whose control law inverts the input map, with the same gains."""
    part = design.state_feedback
    name = part.theorem if isinstance(part, Infeasible) else part.name()
    require(
        name in INVERTED,
        "synthesis.invert_input",
        name,
        "does not support undoing the input map",
        "use riccati",
    )
    if isinstance(part, Infeasible):
        state_feedback = replace(part, theorem=INVERTED[name])
        return replace(design, state_feedback=state_feedback)
    kind: Any = find_theorem(INVERTED[name])
    feedback_fields = vars(part)
    return replace(design, state_feedback=kind(**feedback_fields))


def commanded_model_and_balls(design: Design, model: Model, balls: Balls) -> tuple[Model, Balls]:
    """Model and balls of Jacobians as a control law that inverts the input map sees them. They are
    the model itself, or the model with input v."""
    if not design.inverts_input_map:
        return model, balls
    inner_model = model_behind_map(model)
    return inner_model, certified_balls(inner_model)


def design_with_inverted_input(
    plain: Any, model: Model, validation: Trajectories, shown: Mismatch | None
) -> Design:
    """Design for the model without its input map, with a control law that inverts the map."""
    inner_model = model_behind_map(model)
    limits = getattr(plain, "limits", None)
    if limits is not None:
        ends = [model.scaffold_in(end) for end in limits]
        sorted_ends = np.sort(ends, axis=0)
        plain = replace(plain, limits=tuple(sorted_ends))  # a falling S_u exchanges them
    balls = certified_balls(inner_model)
    records = records_behind_map(model, validation)
    design = plain.design(inner_model, balls, records, shown)
    return mark_as_inverting(design)
