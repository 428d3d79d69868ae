"""Files of recorded signals in the folder of a saved design, for its export."""

from collections.abc import Iterator
from pathlib import Path

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.signals import DataSet


def write_records(data: DataSet, folder: Path) -> None:
    """Write the training inputs and the validation outputs of a data set, from which an export
    takes signal ranges and names."""
    metadata = {"step_s": repr(data.step_s)}
    inputs = (*group_training_inputs(data), *group_training_disturbances(data))
    write_mcap(folder / "excitation.mcap", inputs, metadata)
    outputs = tuple(group_validation_outputs(data))
    write_mcap(folder / "validation.mcap", outputs, metadata)


def group_training_inputs(data: DataSet) -> Iterator[SignalGroup]:
    """Inputs of the training records as MCAP signal groups, with one topic for each record."""
    channels = tuple(data.inputs)
    for i, record in enumerate(data.training):
        topic = f"/record_{i}/input"
        yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.u)


def group_training_disturbances(data: DataSet) -> Iterator[SignalGroup]:
    """Measured disturbances of the training records as MCAP signal groups, with one topic for each
    record."""
    channels = tuple(data.disturbances)
    for i, record in enumerate(data.training):
        if record.d is not None:
            topic = f"/record_{i}/disturbance"
            yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.d)


def group_validation_outputs(data: DataSet) -> Iterator[SignalGroup]:
    """Measured outputs of the validation records as MCAP signal groups, with one topic for each
    record."""
    channels = tuple(data.outputs)
    for i, record in enumerate(data.validation):
        topic = f"/record_{i}/measured"
        yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.y)
