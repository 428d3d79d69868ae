"""Simulation of an identified model, or of a closed loop that starts from given outputs."""

import numpy as np
import pandas as pd

from ssm_study.api.arguments import Values
from ssm_study.api.design import Design
from ssm_study.api.known_maps import warn_of_unknown_maps
from ssm_study.api.loops import choose_plant, simulate_loop, tabulate_rollouts
from ssm_study.api.model import Model
from ssm_study.api.rest_design import RestDesign
from ssm_study.data.arrays import require_consistent_time_indexes, signal_array_and_names
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require


def simulate(
    subject: Model | Design | RestDesign,
    values: Values,
    *overrides: str,
    plant: Plant | None = None,
    disturbance: Values | None = None,
) -> pd.DataFrame:
    """Simulate a model for given inputs, or the closed loop of a design from given initial outputs.

    A model runs from rest for the inputs `values (T, m)`. A loop runs on the identified model, or
    on `plant`, from each row of `values (N, p)` or number of `values (N,)`, without noise, as the
    settings of `loop` say (`"loop.horizon_s=3"`, `"reference@loop.reference=step"`). One row per
    case and sample: `case, time_s`, inputs and outputs by name. A measured `disturbance (T, k)`
    drives model and observer; a loop then lasts as long as it, on the identified model. Without it
    disturbances are at their mean. No limit clamps the input. Where only a range of slopes is given
    for a map, the gain in its middle is taken, with a warning.

    Raises `BadRequest` for other channels, and for what the command refuses of the loop.
    """
    if isinstance(subject, Model):
        step_s = subject.data.step_s
        require_consistent_time_indexes(values, None, step_s)
        _, inputs = signal_array_and_names(values, "u", columns=subject.input_names)
        table = pd.DataFrame(inputs)
        outputs = subject.predict(table, disturbance)
        predicted = pd.DataFrame(outputs)
        samples = len(predicted)
        time_s = np.arange(samples) * subject.data.step_s
        return predicted.assign(time_s=time_s)
    if isinstance(subject, RestDesign):
        problem = "are for other designs; its loop is set by horizon_s of design.simulate"
        unused = overrides or disturbance
        require(unused is None or not len(unused), "overrides", unused, problem, "leave them out")
        return subject.simulate(values, plant=plant)
    is_design = isinstance(subject, Design)
    remedy = "give what st.fit or st.control returned"
    kind = type(subject).__name__
    require(is_design, "subject", kind, "is no model and no design", remedy)
    warn_of_unknown_maps(subject.unknown_maps)
    on = choose_plant(subject, plant)
    rollouts = simulate_loop(subject, values, on, overrides, disturbance=disturbance)
    return tabulate_rollouts(rollouts, on)
