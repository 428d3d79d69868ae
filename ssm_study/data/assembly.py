"""Assembly of a data set from records, with its scaling about the equilibrium and the checks that
every record must pass.

Also the conversion of a data set to named arrays and one dictionary for JSON, and back, bit for
bit, as the store needs it.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Scale, Trajectory

SAME_STEP = 1e-9  # relative: sampling times written by different programs
Parts = tuple[Sequence[Trajectory], Sequence[Trajectory], Sequence[Trajectory]]
Rest = tuple[Float[np.ndarray, "_"], ...]  # of inputs, of outputs, and of measured disturbances
Channels = tuple[Channel, ...]
SIDES = (("input", "u"), ("output", "y"), ("disturbance", "d"))
# Field of a data set: what stored files call it.
PARTS = {
    "training": "training",
    "validation": "validation",
    "test": "test",
    "mismatch_records": "trials",
}
TOLD = ("name", "step_s", "closed_loop", "log", "first")  # of a record, beside its signals


def assemble_dataset(
    parts: Parts,
    equilibrium: Rest,
    channels: tuple[Channels, ...],
    start_up_samples: int,
    **fields: Any,
) -> DataSet:
    """Assemble a data set from training, validation and test records, and compute the scale of each
    channel. `scale = rms(training - rest)` per channel, a gain about the equilibrium `equilibrium =
    (u, y)`, or `(u, y, d)` with measured disturbances; `channels` likewise.

    `parts` are training, validation and test, `fields` the other fields of the data set. Raises
    `BadRequest` for a part without records, differing sampling times, a record no longer than the
    start-up window, or a channel that is constant over the training records.
    """
    named_parts = _name_records(parts)
    training = named_parts["training"]
    for records in named_parts.values():
        for record in records:
            step_s = training[0].step_s
            _check_record(record, step_s, start_up_samples)
    scales: dict[str, Any] = {}
    for (name, side), at, own in zip(SIDES, equilibrium, channels, strict=False):
        signals = [getattr(record, side) for record in training]
        values = np.concatenate(signals)
        _refuse_constant_channels(values, own)
        squares = (values - at) ** 2
        mean_squares = np.mean(squares, axis=0)
        scales[f"{name}_scale"] = np.sqrt(mean_squares)
        scales[f"{name}_equilibrium"] = at
    fields["inputs"] = channels[0]
    fields["outputs"] = channels[1]
    fields["start_up_samples"] = start_up_samples
    if len(channels) > 2:
        fields["disturbances"] = channels[2]
    scale = Scale(**scales)
    return DataSet(**named_parts, **fields, scale=scale)


def _name_records(parts: Parts) -> dict[str, Any]:
    """Name the records for training, validation and test by their purpose and a number, such as
    `training_1`. Raises `BadRequest` for a part without records."""
    named: dict[str, Any] = {}
    names = ("training", "validation", "test")
    for part, records in zip(names, parts, strict=True):
        problem = "a data set needs at least one record here"
        remedy = "add one"
        record_count = len(records)
        require(record_count > 0, f"data.{part}", "none", problem, remedy)
        numbered = enumerate(records, start=1)
        named_records = (replace(record, name=f"{part}_{k}") for k, record in numbered)
        named[part] = tuple(named_records)
    return named


def _check_record(record: Trajectory, step_s: float, start_up_samples: int) -> None:
    """Raise `BadRequest` for a record that is too short, or whose sampling period differs from that
    of the first record."""
    field = f"{record.name} (samples)"
    is_long = len(record) > start_up_samples + 1
    problem = f"no longer than the start-up window of {start_up_samples} samples"
    remedy = "use a longer record or a smaller data.start_up_samples"
    require(is_long, field, len(record), problem, remedy)
    difference_s = record.step_s - step_s
    is_same = abs(difference_s) <= SAME_STEP * step_s
    problem = f"differs from the {step_s:g} s of the first training record"
    remedy = "resample the records to one sampling time"
    require(is_same, f"{record.name}.step_s", record.step_s, problem, remedy)


def _refuse_constant_channels(
    values: Float[np.ndarray, "T c"], channels: Sequence[Channel]
) -> None:
    """Raise `BadRequest` for a channel that is constant over all training records."""
    problem = "constant over the training records, so nothing can be identified from it"
    remedy = "excite it, or leave the channel out"
    for column, channel in zip(values.T, channels, strict=True):
        moves = np.ptp(column) > 0
        require(moves, channel.name, column[0], problem, remedy)


def dataset_to_arrays(data: DataSet) -> tuple[dict[str, Float[np.ndarray, "..."]], dict[str, Any]]:
    """Convert a data set to the form in which it is stored: named numeric arrays, and a dictionary
    of names, units and periods. Arrays `part/i/u`, `part/i/y` (and `d`) and the vectors of the
    scale; names, units and periods in the dictionary."""
    scales = vars(data.scale)
    arrays = {name: values for name, values in scales.items() if values.size}
    about: dict[str, Any] = {}
    about["start_up_samples"] = data.start_up_samples
    about["metadata"] = dict(data.metadata)
    for name in ("inputs", "outputs", "disturbances"):
        channels_of_side = getattr(data, name)
        channels = [asdict(channel) for channel in channels_of_side]
        if channels:
            about[name] = channels
    for part, stored in PARTS.items():
        records: tuple[Trajectory, ...] = getattr(data, part)
        about[stored] = [_record_metadata(record) for record in records]
        for i, record in enumerate(records):
            arrays[f"{stored}/{i}/u"] = record.u
            arrays[f"{stored}/{i}/y"] = record.y
            if record.d is not None:
                arrays[f"{stored}/{i}/d"] = record.d
    contiguous = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    return contiguous, about


def _record_metadata(record: Trajectory) -> dict[str, Any]:
    """Name, sampling period and other facts on a record, without its signals, for storage."""
    return {name: getattr(record, name) for name in TOLD}


def dataset_from_arrays(
    arrays: dict[str, Float[np.ndarray, "..."]], metadata: dict[str, Any]
) -> DataSet:
    """Rebuild a data set from the arrays and the dictionary that `dataset_to_arrays` returns."""
    parts: dict[str, Any] = {}
    parts["start_up_samples"] = metadata["start_up_samples"]
    parts["metadata"] = metadata["metadata"]
    for part, stored in PARTS.items():
        records = []
        for i, facts in enumerate(metadata[stored]):
            u = arrays[f"{stored}/{i}/u"]
            y = arrays[f"{stored}/{i}/y"]
            d = arrays.get(f"{stored}/{i}/d")
            trajectory = Trajectory(u=u, y=y, d=d, **facts)
            records.append(trajectory)
        parts[part] = tuple(records)
    for name in ("inputs", "outputs", "disturbances"):
        stored_channels = metadata.get(name, ())
        channels = (Channel(**channel) for channel in stored_channels)
        parts[name] = tuple(channels)
    scales = {name: values for name, values in arrays.items() if "/" not in name}
    scale = Scale(**scales)
    return DataSet(**parts, scale=scale)
