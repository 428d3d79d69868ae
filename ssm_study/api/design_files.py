"""Reading of a saved design, and writing of the recorded signals that its export needs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.durable import read_json_with_digest
from ssm_study.export import targets
from ssm_study.refusal import require
from ssm_study.signals import Channel, DataSet, Trajectory

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
    inputs = signal_groups_of_records(data.training, "u", "input", data.inputs)
    disturbances = signal_groups_of_records(data.training, "d", "disturbance", data.disturbances)
    write_mcap(folder / "excitation.mcap", (*inputs, *disturbances), metadata)
    outputs = signal_groups_of_records(data.validation, "y", "measured", data.outputs)
    write_mcap(folder / "validation.mcap", tuple(outputs), metadata)


def signal_groups_of_records(
    records: Sequence[Trajectory], signal: str, signal_name: str, channels: Sequence[Channel]
) -> Iterator[SignalGroup]:
    """Signal groups of an MCAP file, one for each record that has the given signal."""
    for i, record in enumerate(records):
        values = getattr(record, signal)
        if values is not None:
            topic = f"/record_{i}/{signal_name}"
            yield SignalGroup(
                topic=topic, time_s=record.time_s, channels=tuple(channels), values=values
            )
