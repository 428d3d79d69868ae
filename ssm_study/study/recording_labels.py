"""Labels in a recording that say what its numbers are: names of channels, units, times and
descriptions."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssm_study.data.mcap_contents import list_unread_contents
from ssm_study.loop.regulation import IdentifiedPlant
from ssm_study.plants.plant import Plant
from ssm_study.signals import Channel, DataSet
from ssm_study.study.loop_recordings import NOISE_FREE, ON_MODEL, ON_PLANT, TOPICS, loop_place_label
from ssm_study.study.recordings import LOOPS, TRIALS, RecordedCases
from ssm_study.study.run_files import RunFiles

# Words of a recording that are numbers: compared as numbers, by claims of their own.
NUMBERS = frozenset(
    {
        "step_s",
        "start_up_samples",
        "start_states",
        "settling_band",
        "input_equilibrium",
        "left_at_sample",
        "bound",
    }
)
NANOSECOND = 1e-9  # to which a recording keeps its times

RECORDED = ("input", "disturbance", "measured")
CLOSED_LOOP = ("reference", *TOPICS.values())
# Signals of each case of a recording.
TOPICS_BY_FILE = {
    "excitation.mcap": ("input", "disturbance"),
    "validation.mcap": (*RECORDED, "simulated"),
    "test.mcap": (*RECORDED, "simulated"),
    TRIALS: RECORDED,
    LOOPS: RECORDED,
    ON_PLANT: (*CLOSED_LOOP, "uncontrolled"),
    NOISE_FREE: CLOSED_LOOP,
    ON_MODEL: CLOSED_LOOP,
}

Channels = Mapping[str, tuple[Channel, ...]]


@dataclass(frozen=True, kw_only=True)
class RecordingLabels:
    """Channel names, units and descriptions that one recording of a run should have."""

    file: str
    channels: Channels
    words: Mapping[str, str]


def expected_labels(run: RunFiles, data: DataSet) -> Iterator[RecordingLabels]:
    """Channel names, units and descriptions that the recordings of a run should have, from its data
    and plants."""
    expected = record_labels(data)
    if run.can_close_loop:
        expected += loop_labels(run, data)
    for labels in expected:
        if (run.path / labels.file).is_file():
            yield labels


def record_labels(data: DataSet) -> list[RecordingLabels]:
    """Channel names and units that recordings of measurements and of model simulations should
    have."""
    files = ("excitation.mcap", "validation.mcap", "test.mcap", TRIALS, LOOPS)
    channels = {"input": data.inputs, "measured": data.outputs, "simulated": data.outputs}
    channels["disturbance"] = data.disturbances
    return [RecordingLabels(file=file, channels=channels, words=data.metadata) for file in files]


def loop_labels(run: RunFiles, data: DataSet) -> list[RecordingLabels]:
    """Channel names and units that the recordings of closed loops should have."""
    spec = run.specification
    twin = IdentifiedPlant.from_model(run.model, data.inputs, data.outputs)
    plant = spec.plant or twin
    words = {
        "loop_on": loop_place_label(spec.plant),
        "loop_seed": str(spec.loop_seed),
        "plant": type(plant).__name__,
    }
    plants = {ON_PLANT: plant, NOISE_FREE: plant, ON_MODEL: twin}
    return [
        RecordingLabels(file=file, channels=loop_channels(on), words=words)
        for file, on in plants.items()
    ]


def loop_channels(plant: Plant) -> Channels:
    """Channels, with names and units, of the signals of a closed loop."""
    channels = {"input": plant.inputs, "states": plant.states}
    for signal in ("reference", "output", "measured", "uncontrolled"):
        channels[signal] = plant.outputs
    return channels


def find_wrong_labels(run: RunFiles, data: DataSet) -> Iterator[tuple[str, list[str]]]:
    """Find recordings whose channel names or units contradict the run's data and plants, each with
    its wrong labels."""
    for labels in expected_labels(run, data):
        recording = RecordedCases.from_file(run.path / labels.file)
        about = recording.about
        words = {*about, *labels.words} - NUMBERS
        wrong = {word for word in words if about.get(word) != labels.words.get(word)}
        step_s = float(about["step_s"])
        for case in recording.cases.values():
            for name, group in case.items():
                clock = step_s * np.arange(len(group.time_s))
                deviation_s = np.abs(group.time_s - clock).max(initial=0.0)
                if not deviation_s <= NANOSECOND:
                    wrong.add(f"times of {name}")
                if group.channels != labels.channels.get(name, group.channels):
                    wrong.add(f"channels of {name}")
        yield labels.file, sorted(wrong)


def find_foreign_contents(path: Path) -> list[str]:
    """Names of topics, attachments and metadata records in a recording that a run does not write
    there."""
    topics = TOPICS_BY_FILE[path.name]
    cases = RecordedCases.from_file(path).cases
    kind = "case" if path.name in (ON_PLANT, ON_MODEL, NOISE_FREE) else "record"
    expected = [f"/{kind}_{number}" for number in range(len(cases))]
    foreign = list_unread_contents(path)
    for prefix, case in cases.items():
        names = [name for name in case if prefix not in expected or name not in topics]
        foreign += [f"topic {prefix}/{name}" for name in names]
    return foreign
