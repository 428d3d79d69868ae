"""Stage that makes the records of a run, by simulation or from the user's logs."""

from pathlib import Path
from typing import Any

from ssm_study.data.metrics import data_set_columns
from ssm_study.durable import read_json
from ssm_study.engine.stages import Stage
from ssm_study.plants.plant import Plant
from ssm_study.signals import DataSet
from ssm_study.study.read_once import read_data_set
from ssm_study.study.recordings import TRIALS, write_records
from ssm_study.study.stages.files import write_json


def compute_dataset(
    folder: Path, *, data: Any, seed: int, plant: Plant | None = None, excitation: Any = None
) -> None:
    """Simulate the records of a data set, or read them from logs, and store them as tensors."""
    is_recorded = plant is None
    records = read_data_set(data, seed) if is_recorded else data.build(plant, excitation, seed)
    write_dataset(folder, records)
    write_records(folder / "excitation.mcap", records, records.training, outputs=False)
    if records.mismatch_records:
        write_records(folder / TRIALS, records, records.mismatch_records)


def write_dataset(folder: Path, records: DataSet) -> None:
    """Write a data set of training, validation and test records into a folder."""
    from safetensors.numpy import save_file

    from ssm_study.data.assembly import dataset_to_arrays

    arrays, about = dataset_to_arrays(records)
    save_file(arrays, folder / "records.safetensors")
    write_json(folder / "records.json", about)


def read_dataset(folder: Path) -> DataSet:
    """Read a stored data set: training, validation and test records in physical units."""
    from safetensors.numpy import load_file

    from ssm_study.data.assembly import dataset_from_arrays

    arrays = load_file(folder / "records.safetensors")
    return dataset_from_arrays(arrays, read_json(folder / "records.json"))


DATASET = Stage(
    "dataset", compute_dataset, read_dataset, data_set_columns, ("excitation.mcap", TRIALS)
)
