"""A data set as named arrays and one json-able dictionary, and back, bit for bit: how the store keeps it."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.signals import Channel, DataSet, Trajectory

PARTS = ("training", "validation", "test")
VECTORS = ("input_equilibrium", "output_equilibrium", "input_scale", "output_scale")


def dataset_to_tensors(data: DataSet) -> tuple[dict[str, Float[np.ndarray, "..."]], dict[str, Any]]:
    """Arrays `part/i/u`, `part/i/y` and the four vectors; names, units and sampling times in the dictionary."""
    arrays = {name: np.ascontiguousarray(getattr(data, name)) for name in VECTORS}
    records: dict[str, list[dict[str, Any]]] = {part: [] for part in PARTS}
    for part in PARTS:
        for i, record in enumerate(getattr(data, part)):
            arrays[f"{part}/{i}/u"] = np.ascontiguousarray(record.u)
            arrays[f"{part}/{i}/y"] = np.ascontiguousarray(record.y)
            records[part].append({"name": record.name, "step_s": record.step_s})
    return arrays, {
        "records": records,
        "inputs": [[c.name, c.unit] for c in data.inputs],
        "outputs": [[c.name, c.unit] for c in data.outputs],
        "start_up_samples": data.start_up_samples,
        "metadata": dict(data.metadata),
    }


def dataset_from_tensors(arrays: dict[str, Float[np.ndarray, "..."]], about: dict[str, Any]) -> DataSet:
    """The inverse of `dataset_to_tensors`."""
    parts = {
        part: tuple(
            Trajectory(u=arrays[f"{part}/{i}/u"], y=arrays[f"{part}/{i}/y"], step_s=entry["step_s"], name=entry["name"])
            for i, entry in enumerate(about["records"][part])
        )
        for part in PARTS
    }
    return DataSet(
        training=parts["training"],
        validation=parts["validation"],
        test=parts["test"],
        inputs=tuple(Channel(name=name, unit=unit) for name, unit in about["inputs"]),
        outputs=tuple(Channel(name=name, unit=unit) for name, unit in about["outputs"]),
        start_up_samples=about["start_up_samples"],
        metadata=about["metadata"],
        input_equilibrium=arrays["input_equilibrium"],
        output_equilibrium=arrays["output_equilibrium"],
        input_scale=arrays["input_scale"],
        output_scale=arrays["output_scale"],
    )
