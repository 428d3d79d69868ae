"""Simulate a model, or a loop from initial outputs."""

import numpy as np
import pandas as pd

from ssm_study.api.design import Design
from ssm_study.api.model import Model, Values
from ssm_study.api.parts import Parts
from ssm_study.data.arrays import signal
from ssm_study.loop.controller import Controller, ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant, Loop
from ssm_study.loop.rollout import Rollouts
from ssm_study.plants.plant import Plant

LOOP = {"loop": "regulation"}


def simulate(
    subject: Model | Design, given: Values, *overrides: str, plant: Plant | None = None
) -> pd.DataFrame:
    """Simulate a model for given inputs, or a designed loop from given initial outputs.

    A model runs from rest for the inputs `given (T, m)`. A loop runs on the identified model, or
    on `plant`, from each row of `given (N, p)` or number of `given (N,)`, without noise, as the
    settings of `loop` say (`"loop.horizon_s=3"`, `"reference@loop.reference=step"`). One row per
    case and sample: `case, time_s`, inputs and outputs by name.

    Raises `BadRequest` for other channels, and for what the command refuses of the loop.
    """
    if isinstance(subject, Model):
        predicted = pd.DataFrame(subject.predict(pd.DataFrame(signal(given, "u")[1])))
        return predicted.assign(time_s=np.arange(len(predicted)) * subject.data.step_s)
    on = plant or identified_plant(subject)
    rollouts = close_loop(subject, given, on, overrides)
    return rollout_table(rollouts, on)


def identified_plant(design: Design) -> IdentifiedPlant:
    """The identified model in the place of the plant, with the channels of its records."""
    if design.origin is None:
        return IdentifiedPlant.of(design.model)
    data = design.origin.data
    return IdentifiedPlant.of(design.model, data.inputs, data.outputs)


def close_loop(
    design: Design,
    y0: Values,
    plant: Plant | IdentifiedPlant,
    overrides: tuple[str, ...] = (),
    controller: Controller | None = None,
) -> Rollouts:
    """Run the loop without noise from initial outputs `(N, p)` or `(N,)`."""
    starts = signal(y0, "y0", len(plant.outputs))[1]
    loop: Loop = Parts(LOOP, overrides).build("loop").fitted(design.model)
    controller = controller or ObserverFeedback.of(design.model, design.certificate)
    noise = np.zeros((len(starts), loop.samples(plant.step_s), starts.shape[1]))
    return loop.simulate(plant, controller, starts, noise)


def rollout_table(rollouts: Rollouts, plant: Plant | IdentifiedPlant) -> pd.DataFrame:
    """One row per case and sample: `case, time_s`, inputs and outputs by name."""
    names = [channel.name for channel in (*plant.inputs, *plant.outputs)]
    tables = []
    for i, (u, y) in enumerate(zip(rollouts.u, rollouts.y, strict=True)):
        table = pd.DataFrame(np.hstack([u, y]), columns=names)
        table.insert(0, "case", i)
        table.insert(1, "time_s", rollouts.time_s)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
