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


def model_without_input_map(model: Model) -> Model:
    """Model without its static input map, whose input is `v = S_u(u)`, the output of the map.
    Raises `BadRequest` unless `S_u` can be inverted channel by channel."""
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


def records_with_mapped_input(model: Model, records: Trajectories) -> Trajectories:
    """Records in which the input u is replaced by `v = S_u(u)`, the output of the static input
    map."""
    return tuple(replace(record, u=model.map_input(record.u)) for record in records)


def mismatch_of_mapped_input(
    model: Model, records: Trajectories, start_up_samples: int, mismatch_records: Trajectories
) -> Mismatch:
    """Model error measured relative to `v = S_u(u)`, the output of the static input map, in place
    of the input u."""
    linear_model = model_without_input_map(model)
    mapped_records = records_with_mapped_input(model, records)
    mapped_mismatch_records = records_with_mapped_input(model, mismatch_records)
    return measure_mismatch(linear_model, mapped_records, start_up_samples, mapped_mismatch_records)


def mismatch_for_control_law(
    control_law: Any, model: Model, data: DataSet, mismatch: Mismatch
) -> Mismatch:
    """Model error relative to the input that a control law commands: u or, if the law inverts the
    input map, the map's output. This is u, or v where the law inverts the input map; `mismatch` is
    relative to u."""
    inverts = (
        control_law.inverts_input_map
        if isinstance(control_law, Design)
        else control_law.invert_input
    )
    if not inverts:
        return mismatch
    records = data.validation, data.start_up_samples, data.mismatch_records
    return mismatch_of_mapped_input(model, *records)


def mark_as_input_inverting(design: Design) -> Design:
    """Copy of a design with the same gains whose control law inverts the static input map."""
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


def certified_model_and_balls(design: Design, model: Model, balls: Balls) -> tuple[Model, Balls]:
    """Model and balls of Jacobians for which a design is certified, without the input map if the
    control law inverts it. They are the model itself, or the model with input v.
    """
    if not design.inverts_input_map:
        return model, balls
    inner_model = model_without_input_map(model)
    return inner_model, certified_balls(inner_model)


def design_with_inverted_input(
    synthesis: Any, model: Model, validation: Trajectories, mismatch: Mismatch | None
) -> Design:
    """Design for a model without its static input map, whose control law then inverts the map."""
    inner_model = model_without_input_map(model)
    limits = getattr(synthesis, "limits", None)
    if limits is not None:
        ends = [model.scaffold_in(end) for end in limits]
        sorted_ends = np.sort(ends, axis=0)
        synthesis = replace(synthesis, limits=tuple(sorted_ends))  # a falling S_u exchanges them
    balls = certified_balls(inner_model)
    records = records_with_mapped_input(model, validation)
    design = synthesis.design(inner_model, balls, records, mismatch)
    return mark_as_input_inverting(design)
