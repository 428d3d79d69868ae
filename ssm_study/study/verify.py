"""Check of every claim of a finished run, recomputed from its files, with a verdict on each column
of its record.

A column of the record is derived and compared, or listed as not checked with its reason; one that
nothing gives is a claim that does not hold. What is derived from what: `study.claims`.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ssm_study.api.rest_design import holds_rest_design
from ssm_study.columns import ADDED, ADDED_COLUMNS, Column
from ssm_study.engine.records import (
    CORRUPT,
    FAILED,
    INFEASIBLE,
    LOST,
    OK,
    RECORD,
    RUNNING,
    read_record,
    storable_value,
)
from ssm_study.engine.store import MANIFEST
from ssm_study.refusal import escape_control_characters, require
from ssm_study.renamed import withdrawn_setting
from ssm_study.study.claims import OF_A_BASELINE, SECTIONS
from ssm_study.study.findings import (
    CheckedClaim,
    Claims,
    DerivedColumns,
    UncheckedValues,
    UnconfirmableSettings,
)
from ssm_study.study.form import check_form
from ssm_study.study.rest_claims import LABELS, check_rest_design
from ssm_study.study.run_files import RunFiles, error_text
from ssm_study.table.columns import find_declaration
from ssm_study.withdrawn import WITHDRAWN_COLUMNS

CLAIMS_NOTHING = (FAILED, LOST, RUNNING)
SECTION_CLAIMS = {"settings": "requested", "records": "data", "loops": "loop"}
UNGIVEN = "nothing in the run's files gives it"
NOT_DERIVED = "cannot be derived: "
UNREACHED = "rests on what cannot be derived"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of checking every claim (setting, result or certificate) of a run, with one finding
    for each."""

    findings: tuple[CheckedClaim, ...]
    unchecked: Mapping[str, str]

    def __iter__(self) -> Iterator[CheckedClaim]:
        """Iterate over the findings of the verification of a run."""
        return iter(self.findings)

    def __len__(self) -> int:
        """Number of findings of the verification of a run."""
        return len(self.findings)

    @property
    def holds(self) -> bool:
        """Whether every checked claim (setting, result or certificate) of a run holds."""
        return all(finding.holds for finding in self.findings)

    def require_valid(self, field: str, value: Any) -> None:
        """Raise `BadRequest` that lists the failed claims of a run, if there are any."""
        wrong = [finding for finding in self.findings if not finding.holds]
        causes = "; ".join(finding_lines(wrong))[:300]
        problem = f"{len(wrong)} of {len(self.findings)} claims do not hold: {causes}"
        remedy = "run the study again; `ssm-study verify` names every claim"
        require(not wrong, field, value, problem, remedy)

    def summary(self) -> str:
        """Verdict on a run in one line: `54 of 54 claims hold; 3 not checked: ...`."""
        counts = Counter(self.unchecked.values()).most_common()
        reasons = ", ".join(f"{reason} ({count})" for reason, count in counts)
        holding = sum(finding.holds for finding in self.findings)
        unchecked = f"{len(self.unchecked)} not checked"
        if reasons:
            unchecked = f"{unchecked}: {reasons}"
        return f"{holding} of {len(self.findings)} claims hold; {unchecked}"

    def lines(self, *, every_claim: bool = True) -> list[str]:
        """Text lines of the verification of a run: each claim, each cause of a failure, and each
        reason for not checking.

        The summary comes last.
        """
        if not every_claim:
            failed_claims = [finding for finding in self.findings if not finding.holds]
            return [*finding_lines(failed_claims), self.summary()]
        by_reason: dict[str, list[str]] = {}
        for name, reason in self.unchecked.items():
            by_reason.setdefault(reason, []).append(name)
        skipped = []
        for reason, names in by_reason.items():
            skipped.append(f"not checked  {', '.join(names)}: {reason}")
        return [*finding_lines(self.findings), *skipped, self.summary()]

    def to_json(self) -> str:
        """Verdict on a run as a text of JSON with the keys `holds`, `claims` and `not_checked`."""
        return json.dumps(self.as_dict(), indent=1)

    def as_dict(self) -> dict[str, Any]:
        """Verdict on a run as values of JSON, with the keys `holds`, `claims` and
        `not_checked`."""
        claims = [asdict(finding) for finding in self.findings]
        return {"holds": self.holds, "claims": claims, "not_checked": dict(self.unchecked)}


def finding_lines(findings: Sequence[CheckedClaim]) -> list[str]:
    """Text lines of a verification: each claim that holds, and each reason for failed claims."""
    failing: dict[str, list[str]] = {}
    for finding in findings:
        if not finding.holds:
            failing.setdefault(_finding_text(finding), []).append(finding.claim)
    lines = []
    for finding in findings:
        cause = _finding_text(finding)
        claims = [finding.claim] if finding.holds else failing.pop(cause, [])
        if len(claims) == 1:
            lines.append(str(finding))
        elif claims:
            grouped_line = str(replace(finding, claim=", ".join(claims), found=cause))
            lines.append(grouped_line)
    return lines


def _finding_text(finding: CheckedClaim) -> str:
    """Text that says why a check failed; failed checks with the same text are printed in one line.
    If no file determines the column, the stored value is left out."""
    return UNGIVEN if finding.found.endswith(UNGIVEN) else finding.found


def verify(run: Path) -> Verification:
    """Check every claim (setting, result or certificate) of a run again from the files in its
    folder.

    Raises `BadRequest` if `run` is no finished run folder, or is made of parts that are not trusted
    here.
    """
    if holds_rest_design(run):
        return Verification(findings=tuple(check_rest_design(run)), unchecked=dict(LABELS))
    record = read_record(run) or {}
    require(bool(record), "run", run, f"there is no {RECORD}", "give the folder of one run")
    status = record.get("status")
    contradiction = contradicted_status(run, record)
    if contradiction:
        return Verification(findings=(contradiction,), unchecked={})
    problem = "the run failed and claims nothing"
    trace = run / "traceback.txt"
    remedy = f"see {trace}" if trace.is_file() else f"see error_message in {run / RECORD}"
    require(status != FAILED, "run", run, problem, remedy)
    if status == CORRUPT:
        damaged = CheckedClaim(claim=RECORD, holds=False, found="is not as it was written")
        return Verification(findings=(damaged,), unchecked={})
    problem = f"its status is {status}, so it claims nothing yet"
    remedy = "give a run that is ok or infeasible"
    if status == LOST:
        remedy = "the command that began it runs it again"
    require(status in (OK, INFEASIBLE), "run", run, problem, remedy)
    return verify_files(RunFiles(path=run.absolute(), record=record))


def contradicted_status(run: Path, record: Mapping[str, Any]) -> CheckedClaim | None:
    """Failed check for a run that is recorded as failed or unfinished and has the traces of a
    finished one; None for any other run.

    Only a finished run records its duration; a run that fails removes its manifest before it writes
    its record.
    """
    status = record.get("status")
    trace = ""
    if record.get("seconds") is not None:
        trace = f"{RECORD} gives the duration of a finished run"
    elif status == FAILED and (run / MANIFEST).is_file():
        trace = f"{MANIFEST} seals the files of a finished run"
    if not trace or status not in CLAIMS_NOTHING:
        return None
    return CheckedClaim(claim="status", holds=False, found=f"stored {status}, yet {trace}")


def verify_files(run: RunFiles) -> Verification:
    """Check every claim of a finished run, given its opened files."""
    findings: list[CheckedClaim] = []
    derived: dict[str, Any] = {}
    repeated: dict[str, str] = {}
    unchecked: dict[str, str] = {}
    for result in _findings_of_checks(run):
        if isinstance(result, CheckedClaim):
            findings.append(result)
        elif isinstance(result, DerivedColumns):
            derived |= result.columns
        elif isinstance(result, UnconfirmableSettings):
            derived |= result.columns
            repeated |= dict.fromkeys(result.columns, result.reason)
        else:
            unchecked |= result.reasons
    cut_short = any(finding.found.startswith(NOT_DERIVED) for finding in findings)
    # Also what the record lacks although its files give it.
    for name in dict.fromkeys((*derived, *run.record)):
        judgement = judge_column(name, run.record, derived, unchecked)
        if isinstance(judgement, CheckedClaim) and judgement.holds and name in repeated:
            unchecked[name] = repeated[name]
        elif isinstance(judgement, CheckedClaim):
            if cut_short and judgement.found.endswith(UNGIVEN):
                unchecked[name] = UNREACHED
            else:
                findings.append(judgement)
        elif judgement:
            unchecked[name] = judgement
    return Verification(findings=tuple(findings), unchecked=unchecked)


def _findings_of_checks(
    run: RunFiles,
) -> Iterator[CheckedClaim | DerivedColumns | UnconfirmableSettings | UncheckedValues]:
    """Results of all checks that apply to a run; an error in a check becomes a failed claim."""
    for section in (check_form, *_applicable_checks(run)):
        try:
            yield from section(run)
        except Exception as error:
            problem = f"{NOT_DERIVED}{error_text(error)}"
            yield CheckedClaim(claim=claim_of_section(section.__name__), holds=False, found=problem)


def claim_of_section(function: str) -> str:
    """Name of the claim under which an error in a group of checks is reported, from the name of the
    checking function."""
    subject = function.removeprefix("check_")
    return SECTION_CLAIMS.get(subject, subject)


def _applicable_checks(run: RunFiles) -> Sequence[Callable[[RunFiles], Claims]]:
    """Checking functions of the verification that apply to a run."""
    try:
        return SECTIONS if run.has_certifiable_model else OF_A_BASELINE
    except Exception as error:
        field = str(getattr(error, "field", ""))
        if field.endswith("_target_") or withdrawn_setting(field):
            raise  # without `--with`, or the setting, nothing can be derived: no lie of the run
        return SECTIONS


def judge_column(
    name: str, record: Mapping[str, Any], derived: Mapping[str, Any], unchecked: Mapping[str, str]
) -> CheckedClaim | str:
    """Verdict on one value in a run's record, or the reason why the value is not checked. It is
    empty if the record claims nothing."""
    column = find_declaration(name)
    stored = record.get(name)
    if name in ADDED_COLUMNS and name not in record and record.get("record_version") == 1:
        return ADDED
    if name in derived and name not in unchecked:
        return compare_column(name, stored, derived[name])
    if name in WITHDRAWN_COLUMNS:
        return "" if stored is None else WITHDRAWN_COLUMNS[name].sentence
    if stored is None and column:
        return ""
    reason = unchecked.get(name) or (column.unchecked if column else "")
    if reason:
        return reason
    problem = UNGIVEN if column else "no such column is declared"
    return CheckedClaim(
        claim=name, holds=False, found=f"stored {_short_text(stored)}, yet {problem}"
    )


def compare_column(name: str, stored: Any, value: Any) -> CheckedClaim:
    """Verdict on whether a value in a run's record equals the recomputed one."""
    column = find_declaration(name) or Column(name, "Float64")
    value = storable_value(
        name, value
    )  # as a record holds it: an infinite margin is the text `inf`
    if _equals_up_to_rounding(stored, value, column):
        return CheckedClaim(claim=name, holds=True, found=f"{value}")
    observation = f"derived {value}, stored {_short_text(stored)}"
    return CheckedClaim(claim=name, holds=False, found=observation)


def _equals_up_to_rounding(stored: Any, value: Any, column: Column) -> bool:
    """Whether a stored value equals the recomputed one, except for rounding errors of numbers,
    which differ between machines."""
    if isinstance(value, float) and type(stored) in (int, float):
        largest_error = column.tolerance * abs(value) + column.resolution
        try:
            return bool(abs(float(stored) - value) <= largest_error)
        except OverflowError:  # an integer of hundreds of digits
            return False
    return type(stored) is type(value) and bool(stored == value)  # True is not 1


def _short_text(value: Any) -> str:
    """Text of a value in one line of at most 80 characters, for the result of a check."""
    text = escape_control_characters(" ".join(str(value).split()))
    return text if len(text) <= 80 else f"{text[:77]}..."
