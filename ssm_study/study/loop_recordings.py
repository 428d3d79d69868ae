"""Recordings of closed loops in a run folder, and how they are written and read."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.loop.regulation import LoopRuns
from ssm_study.loop.rollout import STAYED, Rollouts
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.signals import Channel
from ssm_study.study.recordings import RecordedCases, signal_groups

ON_PLANT = "closed_loop.mcap"
ON_MODEL = "closed_loop_model.mcap"
# In runs where measurement noise alone crosses the settling band.
NOISE_FREE = "closed_loop_noise_free.mcap"
# Recorded signals of each closed loop: topic by field of `Rollouts`.
TOPICS = {
    "u": "input",
    "y": "output",
    "measured": "measured",
    "estimate": "estimate",
    "states": "states",
}


def write_rollouts(
    path: Path,
    controlled: Rollouts,
    uncontrolled: Rollouts | None,
    plant: Plant,
    metadata: dict[str, str],
) -> None:
    """Write closed-loop simulations, and the simulations without control, into a recording file.

    Topics `/case_<i>/` reference, input, output (true), measured, estimate (scaled), states and
    uncontrolled.
    """
    numbers = range(1, controlled.estimate.shape[2] + 1)
    estimates = tuple(Channel(name=f"x{i}", unit="1") for i in numbers)
    channels = {"u": plant.inputs, "estimate": estimates, "states": plant.states}
    written: list[SignalGroup] = []
    for case in range(len(controlled.y)):
        signals = {"reference": (plant.outputs, controlled.reference)}
        for field, topic in TOPICS.items():
            values = getattr(controlled, field)[case]
            signals[topic] = (channels.get(field, plant.outputs), values)
        if uncontrolled is not None:
            signals["uncontrolled"] = (plant.outputs, uncontrolled.y[case])
        written += signal_groups(f"/case_{case}", controlled.time_s, signals)
    input_equilibrium = json.dumps(plant.equilibrium().u.tolist())
    left_at_sample = json.dumps(controlled.left_at_sample.tolist())
    bound = json.dumps(controlled.bound.tolist())
    facts = {
        "step_s": repr(controlled.step_s),
        "settling_band": repr(plant.settling_band),
        "input_equilibrium": input_equilibrium,
        "left_at_sample": left_at_sample,
        "bound": bound,
    }
    write_mcap(path, tuple(written), metadata | facts)


def read_rollouts(path: Path) -> tuple[Rollouts, RecordedCases]:
    """Read the simulations of a closed loop from a recording file.

    Raises `BadRequest` if the file lacks a topic or a simulation, or if its cases do not share one
    reference.
    """
    recording = RecordedCases.from_file(path)
    about = recording.about
    references = recording["reference"]
    problem = "the cases follow different references"
    is_shared = bool((references == references[:1]).all())
    require(is_shared, "recording", path.name, problem, "run the study again")
    signals: dict[str, Any] = {field: recording[topic] for field, topic in TOPICS.items()}
    bound = np.array(json.loads(about["bound"]), dtype=float)
    left_at_sample = np.array(json.loads(about["left_at_sample"]), dtype=int)
    cases = len(references)
    is_complete = len(left_at_sample) == cases
    problem = f"holds {cases} of {len(left_at_sample)} simulations"
    require(is_complete, "recording", path.name, problem, "run the study again")
    run = Rollouts(
        step_s=float(about["step_s"]),
        reference=references[0],
        bound=bound,
        left_at_sample=left_at_sample,
        **signals,
    )
    return run, recording


def loop_place_label(plant: Plant | None) -> str:
    """Text that says, in a recording, whether the loop was closed on a plant or on the identified
    model."""
    if plant is None:
        return "identified model"
    return "device" if plant.is_physical else "plant"


def write_loop_recordings(
    folder: Path, runs: LoopRuns, plant: Plant, identified_plant: Plant, metadata: dict[str, str]
) -> None:
    """Write all closed-loop simulations of a run into its folder as recordings.

    `plant` is the plant, `identified_plant` the identified model.
    """
    metadata = metadata | {"plant": type(plant).__name__}
    write_rollouts(folder / ON_PLANT, runs.controlled, runs.uncontrolled, plant, metadata)
    if runs.noise_free is not None:
        write_rollouts(folder / NOISE_FREE, runs.noise_free, None, plant, metadata)
    if runs.on_model is not None:
        write_rollouts(folder / ON_MODEL, runs.on_model, None, identified_plant, metadata)


def read_loop_recordings(folder: Path) -> tuple[LoopRuns, str]:
    """Read all closed-loop simulations of a run, and whether a plant or the identified model was
    simulated.

    Raises `BadRequest` if a file lacks a topic.
    """
    run, recording = read_rollouts(folder / ON_PLANT)
    outputs = recording["uncontrolled"]
    never_stopped = np.full(len(outputs), STAYED)
    input_equilibrium = json.loads(recording.about["input_equilibrium"])
    uncontrolled = replace(run, y=outputs, left_at_sample=never_stopped)
    equilibrium_input = np.array(input_equilibrium, dtype=float)
    closed = LoopRuns(
        controlled=run,
        uncontrolled=uncontrolled,
        on_model=_read_existing_rollouts(folder / ON_MODEL),
        settling_band=recording.settling_band,
        input_equilibrium=equilibrium_input,
        noise_free=_read_existing_rollouts(folder / NOISE_FREE),
    )
    return closed, recording.about["loop_on"]


def _read_existing_rollouts(path: Path) -> Rollouts | None:
    """Read the closed-loop simulations of a recording file; None if there is no such file."""
    return read_rollouts(path)[0] if path.is_file() else None


def loop_signal_pairs(
    stored: Rollouts | None, recomputed: Rollouts | None
) -> dict[str, tuple[Any, Any]]:
    """Signals of stored closed-loop simulations, each paired with its new simulation.

    Those that left their bound count up to there.
    """
    if stored is None or recomputed is None:
        return {"recording": (stored is not None, recomputed is not None)}
    return {name: (values, getattr(recomputed, name)) for name, values in vars(stored).items()}
