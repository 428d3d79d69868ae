"""The recordings of closed loops in a run folder, written and read back."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import STAYED, Rollouts
from ssm_study.plants.plant import Plant
from ssm_study.signals import Channel
from ssm_study.study.recordings import RecordedCases, groups

# In runs where measurement noise alone crosses the settling band.
NOISE_FREE = "closed_loop_noise_free.mcap"
# What is recorded of each closed loop, topic by field of `Rollouts`.
TOPICS = {
    "u": "input",
    "y": "output",
    "measured": "measured",
    "estimate": "estimate",
    "states": "states",
}


def write_rollouts(
    path: Path, run: Rollouts, alone: Rollouts | None, plant: Plant, about: dict[str, str]
) -> None:
    """`/case_<i>/` reference, input, true and measured output, estimate (scaled), states; the
    output left alone."""
    estimates = tuple(Channel(name=f"x{i + 1}", unit="1") for i in range(run.estimate.shape[2]))
    channels = {"u": plant.inputs, "estimate": estimates, "states": plant.states}
    written: list[SignalGroup] = []
    for case in range(len(run.y)):
        shown = {"reference": (plant.outputs, run.reference)}
        for name, topic in TOPICS.items():
            shown[topic] = channels.get(name, plant.outputs), getattr(run, name)[case]
        if alone is not None:
            shown["uncontrolled"] = (plant.outputs, alone.y[case])
        written += groups(f"/case_{case}", run.time_s, shown)
    facts = {
        "step_s": repr(run.step_s),
        "settling_band": repr(plant.settling_band),
        "input_equilibrium": json.dumps(plant.equilibrium().u.tolist()),
        "left_at_sample": json.dumps(run.left_at_sample.tolist()),
        "bound": json.dumps(run.bound.tolist()),
    }
    write_mcap(path, tuple(written), about | facts)


def read_rollouts(path: Path) -> tuple[Rollouts, RecordedCases]:
    """The loops, and the recording that they were read from. Raises `BadRequest` if the file lacks
    a topic."""
    kept = RecordedCases.of(path)
    signals: dict[str, Any] = {name: kept[topic] for name, topic in TOPICS.items()}
    run = Rollouts(
        step_s=float(kept.about["step_s"]),
        reference=kept["reference"][0],
        bound=np.array(json.loads(kept.about["bound"]), dtype=float),
        left_at_sample=np.array(json.loads(kept.about["left_at_sample"]), dtype=int),
        **signals,
    )
    return run, kept


def closed_on(plant: Plant | None) -> str:
    """The word of a recording for what its loop was closed on; without a plant on the identified
    model."""
    return "identified model" if plant is None else "device" if plant.real else "plant"


def write_experiment(
    folder: Path, closed: LoopRuns, on: Plant, twin: Plant, about: dict[str, str]
) -> None:
    """Every closed loop of a run into its file; `on` is the plant, `twin` the identified model."""
    about = about | {"plant": type(on).__name__}
    write_rollouts(folder / "closed_loop.mcap", closed.controlled, closed.uncontrolled, on, about)
    if closed.noise_free is not None:
        write_rollouts(folder / NOISE_FREE, closed.noise_free, None, on, about)
    if closed.on_model is not None:
        write_rollouts(folder / "closed_loop_model.mcap", closed.on_model, None, twin, about)


def read_experiment(folder: Path) -> tuple[LoopRuns, str]:
    """The recordings that `write_experiment` stored, and the name of what the loop was closed on.
    Raises `BadRequest` if a file lacks a topic."""
    path, on_model, noise_free = (
        folder / name for name in ("closed_loop.mcap", "closed_loop_model.mcap", NOISE_FREE)
    )
    run, kept = read_rollouts(path)
    alone = kept["uncontrolled"]
    closed = LoopRuns(
        controlled=run,
        uncontrolled=replace(
            run, y=alone, left_at_sample=np.full(len(alone), STAYED)
        ),  # left alone, none is stopped
        on_model=read_rollouts(on_model)[0] if on_model.is_file() else None,
        settling_band=kept.settling_band,
        input_equilibrium=np.array(json.loads(kept.about["input_equilibrium"]), dtype=float),
        noise_free=read_rollouts(noise_free)[0] if noise_free.is_file() else None,
    )
    return closed, kept.about["loop_on"]


def of_rollouts(kept: Rollouts | None, made: Rollouts | None) -> dict[str, tuple[Any, Any]]:
    """The signals of two sets of closed loops side by side; those that left their bound count up to
    there."""
    if kept is None or made is None:
        return {"recording": (kept is not None, made is not None)}
    return {name: (stored, getattr(made, name)) for name, stored in vars(kept).items()}
