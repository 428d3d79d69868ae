"""Labels beside the numbers of a recording: times, names, units and words that a reader of it alone
goes by."""

from collections.abc import Iterator, Mapping

import numpy as np

from ssm_study.loop.regulation import IdentifiedPlant
from ssm_study.plants.plant import Plant
from ssm_study.signals import Channel, DataSet
from ssm_study.study.loop_recordings import NOISE_FREE, closed_on
from ssm_study.study.recordings import LOOPS, TRIALS, RecordedCases
from ssm_study.study.run_files import RunFiles

# Of the words of a recording those that are numbers: the signals are compared with them.
NUMBERS = frozenset(
    {"step_s", "start_up_samples", "settling_band", "input_equilibrium", "left_at_sample", "bound"}
)
NANOSECOND = 1e-9  # to which a recording keeps its times

Channels = Mapping[str, tuple[Channel, ...]]


def recordings_of(
    run: RunFiles, data: DataSet
) -> Iterator[tuple[str, Channels, Mapping[str, str]]]:
    """Each recording of the run's folder, its channels by signal, and its words."""
    measured = {"input": data.inputs} | dict.fromkeys(("measured", "simulated"), data.outputs)
    files = ("excitation.mcap", "validation.mcap", "test.mcap", TRIALS, LOOPS)
    expected: list[tuple[str, Channels, Mapping[str, str]]] = [
        (file, measured, data.metadata) for file in files
    ]
    if run.closes_loop:
        twin = IdentifiedPlant.of(run.model, data.inputs, data.outputs)
        on = run.specification.plant or twin
        spec = run.specification
        words = {
            "loop_on": closed_on(spec.plant),
            "loop_seed": str(spec.loop_seed),
            "plant": type(on).__name__,
        }
        loops = (("closed_loop.mcap", on), (NOISE_FREE, on), ("closed_loop_model.mcap", twin))
        expected += [(file, in_loop(plant), words) for file, plant in loops]
    yield from (one for one in expected if (run.path / one[0]).is_file())


def in_loop(plant: Plant) -> Channels:
    """The channels of a loop's signals; those of the estimate are numbered."""
    outputs = ("reference", "output", "measured", "uncontrolled")
    return {"input": plant.inputs, "states": plant.states} | dict.fromkeys(outputs, plant.outputs)


def mislabelled(run: RunFiles, data: DataSet) -> Iterator[tuple[str, list[str]]]:
    """Each recording, and what of it is called otherwise than the run's `data` and plants call
    it."""
    for file, channels, words in recordings_of(run, data):
        kept = RecordedCases.of(run.path / file)
        said = kept.about
        wrong = {word for word in {*said, *words} - NUMBERS if said.get(word) != words.get(word)}
        for name, group in (
            (name, group) for case in kept.cases.values() for name, group in case.items()
        ):
            clock = float(said["step_s"]) * np.arange(len(group.time_s))
            on_time = np.abs(group.time_s - clock).max(initial=0.0) <= NANOSECOND
            wrong |= set() if on_time else {f"times of {name}"}
            wrong |= (
                {f"channels of {name}"}
                if group.channels != channels.get(name, group.channels)
                else set()
            )
        yield file, sorted(wrong)
