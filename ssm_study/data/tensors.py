"""A data set as named arrays and one json-able dictionary, and back, bit for bit: how the store keeps it."""

from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.signals import Channel, DataSet, Scale, Trajectory

PARTS = ("training", "validation", "test", "trials")
TOLD = ("name", "step_s", "closed_loop", "log", "first")  # of a record, beside its signals


def dataset_to_tensors(data: DataSet) -> tuple[dict[str, Float[np.ndarray, "..."]], dict[str, Any]]:
    """Arrays `part/i/u`, `part/i/y` and the four vectors of the scale; names, units and periods in the dictionary."""
    arrays = dict(vars(data.scale))
    about: dict[str, Any] = {"start_up_samples": data.start_up_samples, "metadata": dict(data.metadata)}
    about |= {name: [asdict(channel) for channel in getattr(data, name)] for name in ("inputs", "outputs")}
    for part in PARTS:
        records: tuple[Trajectory, ...] = getattr(data, part)
        about[part] = [{k: getattr(record, k) for k in TOLD} for record in records]
        for i, record in enumerate(records):
            arrays |= {f"{part}/{i}/u": record.u, f"{part}/{i}/y": record.y}
    return {name: np.ascontiguousarray(values) for name, values in arrays.items()}, about


def dataset_from_tensors(arrays: dict[str, Float[np.ndarray, "..."]], about: dict[str, Any]) -> DataSet:
    """The inverse of `dataset_to_tensors`."""
    parts: dict[str, Any] = {name: about[name] for name in ("start_up_samples", "metadata")}
    for part in PARTS:
        told = enumerate(about[part])
        parts[part] = tuple(Trajectory(u=arrays[f"{part}/{i}/u"], y=arrays[f"{part}/{i}/y"], **one) for i, one in told)
    for name in ("inputs", "outputs"):
        parts[name] = tuple(Channel(**channel) for channel in about[name])
    return DataSet(**parts, scale=Scale(**{name: values for name, values in arrays.items() if "/" not in name}))
