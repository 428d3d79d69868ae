"""Stage that judges which statements about the plant the data and the model support."""

from pathlib import Path

from ssm_study.durable import read_json
from ssm_study.engine.stages import Stage
from ssm_study.evidence.metrics import Judgement, collect_findings, evidence_columns
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.free_run import ModelRun


def compute_evidence(folder: Path, data: DataSet, model_run: ModelRun, mismatch: Mismatch) -> None:
    """Judge which statements about the plant the data and the model support, and store the
    judgement."""
    judged = collect_findings(data, model_run.model, model_run.validation, model_run.test, mismatch)
    write_json(folder / "evidence.json", judged.to_json())


def read_judgement(folder: Path) -> Judgement:
    """Read the stored judgement of which statements about the plant the data support."""
    return Judgement.from_json(read_json(folder / "evidence.json"))


EVIDENCE = Stage(
    "evidence",
    compute_evidence,
    read_judgement,
    evidence_columns,
    ("evidence.json",),
    known_by_content=True,
)
