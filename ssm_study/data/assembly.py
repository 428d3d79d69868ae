"""Assembly of a data set from records, with its scaling about the equilibrium and the checks that
every record must pass.

And a data set as named arrays and one json-able dictionary, and back, bit for bit: how the store
keeps it.
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
    parts: Parts, rest: Rest, channels: tuple[Channels, ...], start_up_samples: int, **fields: Any
) -> DataSet:
    """Assemble a data set and its scaling from the records for training, validation and test.
    `scale = rms(training - rest)` per channel, a gain about the equilibrium `rest = (u, y)`, or
    `(u, y, d)` with measured disturbances; `channels` likewise.

    `parts` are training, validation and test, `fields` the other fields of the data set. Raises
    `BadRequest` for a part without records, differing sampling times, a record no longer than the
    start-up window, or a channel that is constant over the training records.
    """
    named_parts: dict[str, Any] = {}
    for part, records in zip(("training", "validation", "test"), parts, strict=True):
        require(
            len(records) > 0,
            f"data.{part}",
            "none",
            "a data set needs at least one record here",
            "add one",
        )
        named_parts[part] = tuple(
            replace(record, name=f"{part}_{k + 1}") for k, record in enumerate(records)
        )
    training = named_parts["training"]
    window = f"no longer than the start-up window of {start_up_samples} samples"
    step_s = training[0].step_s
    for record in (record for records in named_parts.values() for record in records):
        remedy = "use a longer record or a smaller data.start_up_samples"
        require(
            len(record) > start_up_samples + 1,
            f"{record.name} (samples)",
            len(record),
            window,
            remedy,
        )
        same = abs(record.step_s - step_s) <= SAME_STEP * step_s
        problem = f"differs from the {step_s:g} s of the first training record"
        require(
            same,
            f"{record.name}.step_s",
            record.step_s,
            problem,
            "resample the records to one sampling time",
        )
    scales: dict[str, Any] = {}
    for (name, side), at, own in zip(SIDES, rest, channels, strict=False):
        values = np.concatenate([getattr(record, side) for record in training])
        problem = "constant over the training records, so nothing can be identified from it"
        for column, channel in zip(values.T, own, strict=True):
            moves = np.ptp(column) > 0
            remedy = "excite it, or leave the channel out"
            require(moves, channel.name, column[0], problem, remedy)
        scales[f"{name}_scale"] = np.sqrt(np.mean((values - at) ** 2, axis=0))
        scales[f"{name}_equilibrium"] = at
    fields |= {"inputs": channels[0], "outputs": channels[1], "start_up_samples": start_up_samples}
    fields |= {"disturbances": channels[2]} if len(channels) > 2 else {}
    return DataSet(**named_parts, **fields, scale=Scale(**scales))


def dataset_to_tensors(data: DataSet) -> tuple[dict[str, Float[np.ndarray, "..."]], dict[str, Any]]:
    """Convert a data set, for storage, to named arrays and a dictionary with everything else.
    Arrays `part/i/u`, `part/i/y` (and `d`) and the vectors of the scale; names, units and periods
    in the dictionary."""
    arrays = {name: values for name, values in vars(data.scale).items() if values.size}
    about: dict[str, Any] = {
        "start_up_samples": data.start_up_samples,
        "metadata": dict(data.metadata),
    }
    for name in ("inputs", "outputs", "disturbances"):
        channels = [asdict(channel) for channel in getattr(data, name)]
        about |= {name: channels} if channels else {}
    for part, stored in PARTS.items():
        records: tuple[Trajectory, ...] = getattr(data, part)
        about[stored] = [{k: getattr(record, k) for k in TOLD} for record in records]
        for i, record in enumerate(records):
            arrays |= {f"{stored}/{i}/u": record.u, f"{stored}/{i}/y": record.y}
            arrays |= {} if record.d is None else {f"{stored}/{i}/d": record.d}
    return {name: np.ascontiguousarray(values) for name, values in arrays.items()}, about


def dataset_from_tensors(
    arrays: dict[str, Float[np.ndarray, "..."]], about: dict[str, Any]
) -> DataSet:
    """Rebuild a data set from the arrays and the dictionary that `dataset_to_tensors` returns."""
    parts: dict[str, Any] = {name: about[name] for name in ("start_up_samples", "metadata")}
    for part, stored in PARTS.items():
        records = []
        for i, facts in enumerate(about[stored]):
            u = arrays[f"{stored}/{i}/u"]
            y = arrays[f"{stored}/{i}/y"]
            d = arrays.get(f"{stored}/{i}/d")
            records.append(Trajectory(u=u, y=y, d=d, **facts))
        parts[part] = tuple(records)
    for name in ("inputs", "outputs", "disturbances"):
        parts[name] = tuple(Channel(**channel) for channel in about.get(name, ()))
    scales = {name: values for name, values in arrays.items() if "/" not in name}
    return DataSet(**parts, scale=Scale(**scales))
