"""Simulation of a design's closed loop with a given plant or, without one, with the identified
model."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ssm_study.api.arguments import Values
from ssm_study.api.parts import StudyParts
from ssm_study.data.arrays import disturbance_array, signal_array_and_names
from ssm_study.loop.controller import Controller, ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment
from ssm_study.loop.rollout import Rollouts
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require

if TYPE_CHECKING:
    from ssm_study.api.design import Design

LOOP = {"loop": "regulation"}


def make_identified_plant(design: "Design") -> IdentifiedPlant:
    """Make a simulated plant from the identified model of a design, with the channel names of the
    records."""
    if design.origin is None:
        return IdentifiedPlant.from_model(design.model)
    data = design.origin.data
    return IdentifiedPlant.from_model(design.model, data.inputs, data.outputs)


def choose_plant(design: "Design", plant: Any) -> Plant | IdentifiedPlant:
    """Plant on which a loop is closed: the given plant, or the identified model if none is given.
    Raises `BadRequest` for an object that is no plant."""
    if plant is None:
        return make_identified_plant(design)
    remedy = "give one of ssm_study.plants, or your own (docs/howto_plant.md)"
    is_plant = isinstance(plant, Plant | IdentifiedPlant)
    kind = type(plant).__name__
    require(is_plant, "plant", kind, "is no plant", remedy)
    chosen: Plant | IdentifiedPlant = plant
    return chosen


def simulate_loop(
    design: "Design",
    y0: Values,
    plant: Plant | IdentifiedPlant,
    overrides: tuple[str, ...] = (),
    controller: Controller | None = None,
    disturbance: Values | None = None,
) -> Rollouts:
    """Simulate the closed loop of a design without noise from initial outputs `(N, p)` or `(N,)`.

    With a measured disturbance it lasts as long as that.
    """
    names = [channel.name for channel in plant.outputs]
    output_count = len(names)
    _, starts = signal_array_and_names(y0, "y0", output_count, names)
    parts = StudyParts(LOOP, overrides)
    configured_loop = parts.build("loop")
    loop: LoopExperiment = configured_loop.with_default_horizon(design.model)
    controller = controller or ObserverFeedback.from_design(design.model, design.certificate)
    measured = disturbance_array(disturbance, _disturbance_names(design))
    if measured is not None:
        horizon_s = len(measured) * plant.step_s
        loop = replace(loop, horizon_s=horizon_s)
    start_count = len(starts)
    samples = loop.horizon_samples(plant.step_s)
    noise_shape = (start_count, samples, starts.shape[1])
    noise = np.zeros(noise_shape)
    return loop.simulate(plant, controller, starts, noise, measured)


def _disturbance_names(design: "Design") -> list[str]:
    """Names of the measured disturbances of a design, or numbers where its records are not
    known."""
    if design.origin is None:
        disturbances = design.model.scale.disturbances
        return [f"d_{k + 1}" for k in range(disturbances)]
    channels = design.origin.data.disturbances
    return [channel.name for channel in channels]


def tabulate_rollouts(rollouts: Rollouts, plant: Plant | IdentifiedPlant) -> pd.DataFrame:
    """Table of simulated closed loops with one row for each initial condition and sample. Its
    columns are `case`, `time_s`, and the inputs and outputs by name."""
    channels = (*plant.inputs, *plant.outputs)
    names = [channel.name for channel in channels]
    tables = []
    cases = zip(rollouts.u, rollouts.y, strict=True)
    for i, (u, y) in enumerate(cases):
        signals = np.hstack([u, y])
        table = pd.DataFrame(signals, columns=names)
        table.insert(0, "case", i)
        table.insert(1, "time_s", rollouts.time_s)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
