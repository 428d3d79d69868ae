"""Files of a saved design: recorded signals that its export needs, and reading a design back."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.durable import read_json_with_digest
from ssm_study.export import targets
from ssm_study.refusal import require
from ssm_study.signals import DataSet

RECORD = "record.json"
NAMES_EVERY_CLAIM = "`ssm-study verify` names every claim that does not hold"


def read_stored_design(folder: Path) -> dict[str, Any]:
    """Read certificates, model and record from the folder of a run or of a saved design. They are
    keyword arguments of `Design`.

    Every certificate is decided again for the model, in exact arithmetic. Raises `BadRequest` where
    a claim does not hold, or where the record is not as it was written.
    """
    targets.load_controller(folder)  # refuses a folder without one
    model = targets.load_model(folder)
    certificate = Certificates.load(folder / "certificate.json")
    failed = targets.failed_certificate_claims(folder, model, certificate)
    require(not failed, "design", folder, "; ".join(failed), NAMES_EVERY_CLAIM)
    record: dict[str, Any] | None = {}
    if (folder / RECORD).is_file():
        record = read_json_with_digest((folder / RECORD).read_bytes())
        problem = f"{RECORD} is not as it was written"
        require(record is not None, "design", folder, problem, NAMES_EVERY_CLAIM)
    return {"certificate": certificate, "model": model, "stored_record": record}


def write_export_records(data: DataSet, folder: Path) -> None:
    """Write the training inputs and the validation outputs of a data set, from which an export
    takes signal ranges and names."""
    metadata = {"step_s": repr(data.step_s)}
    inputs = (*training_input_groups(data), *training_disturbance_groups(data))
    write_mcap(folder / "excitation.mcap", inputs, metadata)
    outputs = tuple(validation_output_groups(data))
    write_mcap(folder / "validation.mcap", outputs, metadata)


def training_input_groups(data: DataSet) -> Iterator[SignalGroup]:
    """Inputs of the training records as signal groups of an MCAP file, with one topic for each
    record."""
    channels = tuple(data.inputs)
    for i, record in enumerate(data.training):
        topic = f"/record_{i}/input"
        yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.u)


def training_disturbance_groups(data: DataSet) -> Iterator[SignalGroup]:
    """Measured disturbances of the training records as signal groups of an MCAP file, with one
    topic for each record."""
    channels = tuple(data.disturbances)
    for i, record in enumerate(data.training):
        if record.d is not None:
            topic = f"/record_{i}/disturbance"
            yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.d)


def validation_output_groups(data: DataSet) -> Iterator[SignalGroup]:
    """Measured outputs of the validation records as signal groups of an MCAP file, with one topic
    for each record."""
    channels = tuple(data.outputs)
    for i, record in enumerate(data.validation):
        topic = f"/record_{i}/measured"
        yield SignalGroup(topic=topic, time_s=record.time_s, channels=channels, values=record.y)
