"""Judgement of how far the records support predictions by a model, and its table columns. The level
is the gravest of all findings; it decides whether a prediction is stated."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, get_args

from ssm_study.columns import Column
from ssm_study.data.calendar_numbers import MAYBE_DAYS
from ssm_study.data.clock_column import MAYBE_SMALLER
from ssm_study.data.log_checks import ANGLE, ANGLE_REMEDY
from ssm_study.data.missing_codes import CODES
from ssm_study.data.recording import ASSUMED_SECOND
from ssm_study.evidence import autonomous_motion as own_motion
from ssm_study.evidence import feedback, fit, records, response
from ssm_study.evidence.finding import (
    CANNOT_JUDGE,
    DOUBT,
    SOUND,
    EvidenceCase,
    Finding,
    Level,
    make_doubt,
    make_note,
)
from ssm_study.models.metrics import NOT_KEPT, Simulation
from ssm_study.models.structured import Model
from ssm_study.refusal import require, require_one_of
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet

NO_JUDGEMENT = "the evidence allows no judgement"

COLUMNS = (
    Column("evidence", "string", word="Evidence", unchecked=NOT_KEPT),
    Column("evidence_reasons", "string", word="What the evidence lacks", unchecked=NOT_KEPT),
)


@dataclass(frozen=True, kw_only=True, repr=False)
class Judgement:
    """All findings on how far the records support predictions by a model. Its level is that of the
    gravest finding: `sound` (notes at most), `doubt` or `cannot judge`."""

    findings: tuple[Finding, ...]

    @property
    def level(self) -> str:
        """Gravest level of severity among the findings: sound, doubt or cannot judge."""
        levels = {finding.level for finding in self.findings}
        if CANNOT_JUDGE in levels:
            return CANNOT_JUDGE
        return DOUBT if DOUBT in levels else SOUND

    @property
    def reasons(self) -> str | None:
        """Text of all findings, the gravest first; None without findings."""
        gravest_first = (CANNOT_JUDGE, DOUBT, "note")
        ordered = sorted(self.findings, key=lambda finding: gravest_first.index(finding.level))
        sentences = [f"{finding.level}: {finding.sentence}" for finding in ordered]
        return " ".join(sentences) or None

    def __repr__(self) -> str:
        lines = [f"  {finding.level}: {finding.sentence}" for finding in self.findings]
        return "\n".join([f"Evidence: {self.level}", *lines])

    def to_json(self) -> list[dict[str, str]]:
        """Findings of a judgement as a list for JSON."""
        return [asdict(finding) for finding in self.findings]

    @classmethod
    def from_json(cls, content: list[Mapping[str, Any]]) -> "Judgement":
        """Read the findings on a run's records from JSON. Raises `BadRequest` for anything but a
        list of findings."""
        for k, entry in enumerate(content if isinstance(content, list) else [content]):
            sound = isinstance(entry, dict) and entry.keys() == {"level", "sentence"}
            require(
                sound,
                f"evidence.json [{k}]",
                entry,
                "is no finding (level and sentence)",
                "run the study again",
            )
            require_one_of(get_args(Level), f"evidence.json [{k}].level", entry["level"])
        return cls(findings=tuple(Finding(**entry) for entry in content))


def collect_findings(
    data: DataSet, model: Model, validation: Simulation, test: Simulation, mismatch: Mismatch
) -> Judgement:
    """Collect all findings on the records, the model and the measured model error."""
    case = EvidenceCase(data=data, model=model, validation=validation, test=test)
    findings = [
        *fit.judge_fit(case),
        *records.judge_records(case, mismatch),
        *response.judge_response(case),
        *feedback.judge_feedback(case),
    ]
    findings += own_motion.judge_autonomous_motion(case) + fit.judge_whiteness(case)
    if data.disturbances:
        names = ", ".join(channel.name for channel in data.disturbances)
        findings.append(
            make_note(
                f"Measured disturbances ({names}) drive model and observer; the controller does "
                "not compensate them, and the loop on the model runs with them at equilibrium."
            )
        )
    if "split" in data.metadata:
        findings.append(make_note(f"The log was cut {data.metadata['split']}."))
    findings += judge_log_reading(data.metadata.get("reading", ""))
    if data.metadata.get("reading"):
        findings.append(make_note(f"The log was read so: {data.metadata['reading']}."))
    return Judgement(findings=tuple(findings))


def judge_log_reading(reading_remarks: str) -> list[Finding]:
    """Findings on how a log was read: a clock of unknown unit, values that may mark missing data,
    an output that jumps like an angle."""
    doubts = []
    if ASSUMED_SECOND in reading_remarks:
        doubts.append(
            make_doubt(
                "How long a row lasts is unknown: the first column counts the rows, "
                f"{ASSUMED_SECOND}. Give data.step_s."
            )
        )
    remarks = reading_remarks.split("; ")
    codes = [remark for remark in remarks if remark.endswith(CODES)]
    doubts += [make_doubt(f"{remark}. If so, leave those cells empty.") for remark in codes]
    turns = [remark for remark in remarks if remark.endswith(ANGLE)]
    doubts += [make_doubt(f"{turn[0].upper()}{turn[1:]}: {ANGLE_REMEDY}.") for turn in turns]
    for unit in (MAYBE_SMALLER, MAYBE_DAYS):
        if unit in reading_remarks:
            doubts.append(
                make_doubt(
                    f"The unit of the clock is unknown ({unit}). Give data.step_s, or write the "
                    "unit into the column's name."
                )
            )
    return doubts


def evidence_columns(judgement: Judgement, *_: Any) -> dict[str, Any]:
    """Table columns with the level of the evidence (sound, doubt or cannot judge) and its reasons.
    `evidence` is sound, doubt or cannot judge; notes leave it sound."""
    return {"evidence": judgement.level, "evidence_reasons": judgement.reasons}


def withhold_predictions(columns: dict[str, Any], evidence_level: str | None) -> dict[str, Any]:
    """Remove the predictions about the plant from the table columns of a design if the records do
    not support them.

    The coverage certificate stays in the design, but records that cannot be judged do not show
    which model error it covers.
    """
    if evidence_level != CANNOT_JUDGE:
        return columns
    about_the_plant = ("predicted_stable", "predicted_faster", "coverage_needed", "sine_coverage")
    withheld: dict[str, Any] = {name: None for name in about_the_plant if name in columns}
    if columns.get("coverage") is not None:
        withheld |= {"coverage": None, "coverage_reason": NO_JUDGEMENT, "coverage_reference": None}
    return columns | withheld
