"""Files of a saved model: the model itself, its records, and a description of its
identification."""

import hashlib
import json
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ssm_study.api.scratch import copy_temporary_logs
from ssm_study.durable import sha256_of_file
from ssm_study.models.stored import model_from_json
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training.metrics import Identification

MODEL_FILE = "model.json"
HISTORY_FILE = "identification.json"
RECORDS_FILE = "records.npz"
LOGS = "logs"  # folder of the log files that a saved model takes along
SAVED_FOLDER = "{folder of the model}"  # stands for it in stored overrides: it may be moved
PARTS = ("training", "validation", "test", "mismatch_records")
SIGNALS = ("u", "y", "d")
CHANNELS = ("inputs", "outputs", "disturbances")
NUMBERS = ("fit_validation_percent", "seconds", "curve", "ended", "choice", "chosen", "refitted")


def holds_saved_model(folder: Path) -> bool:
    """Whether a folder holds a saved model."""
    return (folder / HISTORY_FILE).is_file() and (folder / RECORDS_FILE).is_file()


def write_json(path: Path, content: object) -> None:
    """Write a value into a file as JSON, with all digits of its numbers.

    A training curve may hold NaN, where an epoch had no fit.
    """
    text = json.dumps(content, indent=1, default=np.generic.item)
    path.write_text(text + "\n", encoding="utf-8")


def write_model_files(model: Any, folder: Path) -> None:
    """Write an identified model with its records into a folder, as JSON and NumPy files. The files
    are `model.json`, `identification.json` and `records.npz`."""
    identification: Identification = model.identification
    facts = {name: getattr(identification, name) for name in NUMBERS}
    members = [member.to_json() for member in identification.members]
    overrides = [copy_temporary_logs(override, folder / LOGS) for override in model.overrides]
    place = str(folder.resolve())
    data_content = describe_data(model.data)
    portable_overrides = [override.replace(place, SAVED_FOLDER) for override in overrides]
    content = {
        "identification": facts,
        "members": members,
        "data": data_content,
        "seed": model.seed,
        "overrides": portable_overrides,
        "later_words": model.later_words,
    }
    model_content = model.simulator.to_json()
    write_json(folder / MODEL_FILE, model_content)
    samples = signal_arrays(model.data)
    np.savez_compressed(folder / RECORDS_FILE, **samples)
    content["files"] = file_digests(folder)
    write_json(folder / HISTORY_FILE, content | {"sha256": content_digest(content)})


def file_digests(folder: Path) -> dict[str, str]:
    """SHA-256 digest of each file of a saved model, by file name. `identification.json`, which
    holds the digests, is left out."""
    paths = [folder / MODEL_FILE, folder / RECORDS_FILE, *sorted((folder / LOGS).rglob("*"))]
    files = [path for path in paths if path.is_file()]
    return {path.relative_to(folder).as_posix(): sha256_of_file(path) for path in files}


def content_digest(content: dict[str, Any]) -> str:
    """SHA-256 digest of the description of a saved model, without the stored digest itself.

    A training curve may hold NaN, so the text is not that of a run's record.
    """
    body = {name: value for name, value in content.items() if name != "sha256"}
    text = json.dumps(body, sort_keys=True, default=np.generic.item)
    return hashlib.sha256(text.encode()).hexdigest()


def require_unmodified_files(folder: Path, content: dict[str, Any]) -> None:
    """Raise `BadRequest` if a file of a saved model was changed since it was written.

    A model without check sums, saved by an earlier version, is read with a warning.
    """
    if "sha256" not in content and "files" not in content:
        message = f"{folder} has no seal (saved by an earlier version), so nobody would notice "
        warnings.warn(f"{message}an altered file; save the model again.", UserWarning, 5)
        return
    changed = [] if content.get("sha256") == content_digest(content) else [HISTORY_FILE]
    stored = content.get("files")
    sealed = stored if isinstance(stored, dict) else {}
    present = file_digests(folder)
    names = sorted({*sealed, *present})
    changed += [name for name in names if sealed.get(name) != present.get(name)]
    problem = f"changed since it was saved: {', '.join(changed)}"
    require(not changed, "folder", folder, problem, "fit and save the model again")


def read_model_fields(folder: Path) -> dict[str, Any]:
    """Read the arguments from which a saved model is built again, from the folder of the model.
    `write_model_files` wrote it.

    Raises `BadRequest` for a damaged file.
    """
    try:
        model_text = (folder / MODEL_FILE).read_text(encoding="utf-8")
        simulator = model_from_json(json.loads(model_text))
        history_text = (folder / HISTORY_FILE).read_text(encoding="utf-8")
        content = json.loads(history_text)
        require_unmodified_files(folder, content)
        with np.load(folder / RECORDS_FILE, allow_pickle=False) as arrays:
            signals = dict(arrays)
            data = rebuild_data_set(content["data"], signals)
        facts = content["identification"]
        facts["choice"] = tuple(facts["choice"])
        member_models = (model_from_json(member) for member in content["members"])
        members = tuple(member_models)
        place = str(folder.resolve())
        overrides = [override.replace(SAVED_FOLDER, place) for override in content["overrides"]]
        identification = Identification(model=simulator, members=members, **facts)
        later_words = tuple(content["later_words"])
        return {
            "simulator": simulator,
            "data": data,
            "identification": identification,
            "seed": int(content["seed"]),
            "overrides": tuple(overrides),
            "later_words": later_words,
        }
    except BadRequest:
        raise
    except (OSError, KeyError, TypeError, ValueError) as error:
        problem = f"holds a saved model that cannot be read ({error})"
        raise BadRequest("folder", folder, problem, "save the model again") from error


def describe_data(data: DataSet) -> dict[str, Any]:
    """Description of a data set without its samples: channels, scale and names of the records."""
    scale_fields = asdict(data.scale)
    scale = {name: list(values) for name, values in scale_fields.items()}
    records = {part: list(map(describe_record, getattr(data, part))) for part in PARTS}
    channels = {side: list(map(asdict, getattr(data, side))) for side in CHANNELS}
    return {
        "scale": scale,
        "records": records,
        "channels": channels,
        "start_up_samples": data.start_up_samples,
        "metadata": data.metadata,
    }


def describe_record(record: Trajectory) -> dict[str, Any]:
    """Description of one record without its samples, such as its sampling time."""
    closed_loop = bool(record.closed_loop)
    return {
        "step_s": record.step_s,
        "name": record.name,
        "closed_loop": closed_loop,
        "log": int(record.log),
        "first": int(record.first),
    }


def signal_arrays(data: DataSet) -> dict[str, Any]:
    """Arrays with the samples of all records of a data set, by name. The name is `<part of the data
    set>/<record number>/<signal>`."""
    arrays = {}
    for part in PARTS:
        records = getattr(data, part)
        for number, record in enumerate(records):
            for signal in SIGNALS:
                values = getattr(record, signal)
                if values is not None:
                    arrays[f"{part}/{number}/{signal}"] = values
    return arrays


def rebuild_data_set(content: dict[str, Any], arrays: dict[str, Any]) -> DataSet:
    """Rebuild a data set from its stored description and its arrays of samples."""
    scale_fields = content["scale"]
    scale = {name: np.asarray(values, dtype=float) for name, values in scale_fields.items()}
    fields: dict[str, Any] = {}
    for part in PARTS:
        descriptions = content["records"][part]
        fields[part] = rebuild_records(part, descriptions, arrays)
    for side in CHANNELS:
        channels = content["channels"][side]
        fields[side] = tuple(Channel(**description) for description in channels)
    start_up_samples = int(content["start_up_samples"])
    metadata = dict(content["metadata"])
    return DataSet(
        **fields, scale=Scale(**scale), start_up_samples=start_up_samples, metadata=metadata
    )


def rebuild_records(
    part: str, descriptions: list[dict[str, Any]], arrays: dict[str, Any]
) -> tuple[Trajectory, ...]:
    """Rebuild the training, validation or test records of a data set from descriptions and
    arrays."""
    records = []
    for number, description in enumerate(descriptions):
        values: dict[str, Any] = {
            signal: arrays.get(f"{part}/{number}/{signal}") for signal in SIGNALS
        }
        record = Trajectory(**description, **values)
        records.append(record)
    return tuple(records)
