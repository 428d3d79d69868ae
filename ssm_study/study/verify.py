"""`verify`: derive every claim of a run again from its files, and say of every column what was
found.

A column of the record is derived and compared, or listed as not checked with its reason; one that
nothing gives is a claim that does not hold. What is derived from what: `study.claims`.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ssm_study.columns import ADDED, ADDED_COLUMNS, Column
from ssm_study.engine.records import CORRUPT, FAILED, INFEASIBLE, OK, RECORD, read_record, storable
from ssm_study.refusal import printable, require
from ssm_study.renamed import WITHDRAWN_COLUMNS
from ssm_study.study.claims import OF_A_BASELINE, SECTIONS
from ssm_study.study.findings import Checked, Derived, NotChecked
from ssm_study.study.form import form
from ssm_study.study.run_files import RunFiles, one_line
from ssm_study.table.columns import declared

UNGIVEN = "nothing in the run's files gives it"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """The verdict on every claim; iterating gives the findings."""

    findings: tuple[Checked, ...]
    unchecked: Mapping[str, str]

    def __iter__(self) -> Iterator[Checked]:
        return iter(self.findings)

    def __len__(self) -> int:
        return len(self.findings)

    @property
    def holds(self) -> bool:
        return all(finding.holds for finding in self.findings)

    def demand(self, field: str, value: Any) -> None:
        """Raise `BadRequest` that names the claims which do not hold."""
        wrong = [finding for finding in self.findings if not finding.holds]
        causes = "; ".join(finding_lines(wrong))[:300]
        problem = f"{len(wrong)} of {len(self.findings)} claims do not hold: {causes}"
        require(
            not wrong,
            field,
            value,
            problem,
            "run the study again; `ssm-study verify` names every claim",
        )

    def summary(self) -> str:
        """`54 of 54 claims hold; 3 not checked: ...`."""
        reasons = Counter(self.unchecked.values())
        told = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
        held = sum(finding.holds for finding in self.findings)
        left_out = f"{len(self.unchecked)} not checked" + (f": {told}" if told else "")
        return f"{held} of {len(self.findings)} claims hold; {left_out}"

    def lines(self) -> list[str]:
        """One line per claim, one per cause of a failure, one per reason for not checking.

        The summary comes last.
        """
        reasons: dict[str, list[str]] = {}
        for name, reason in self.unchecked.items():
            reasons.setdefault(reason, []).append(name)
        skipped = [
            f"not checked  {', '.join(names)}: {reason}" for reason, names in reasons.items()
        ]
        return [*finding_lines(self.findings), *skipped, self.summary()]

    def to_json(self) -> str:
        claims = [asdict(finding) for finding in self.findings]
        return json.dumps(
            {"holds": self.holds, "claims": claims, "not_checked": dict(self.unchecked)}, indent=1
        )


def finding_lines(findings: Sequence[Checked]) -> list[str]:
    """One line per claim that holds, and one per cause for those that do not."""
    failing: dict[str, list[str]] = {}
    for finding in findings:
        if not finding.holds:
            failing.setdefault(_cause(finding), []).append(finding.claim)
    lines = []
    for finding in findings:
        if finding.holds or len(claims := failing.pop(_cause(finding), [])) == 1:
            lines.append(str(finding))
        elif claims:
            lines.append(str(replace(finding, claim=", ".join(claims), found=_cause(finding))))
    return lines


def _cause(finding: Checked) -> str:
    """Text of a finding, without the stored value where nothing gives the column."""
    return UNGIVEN if finding.found.endswith(UNGIVEN) else finding.found


def verify(run: Path) -> Verification:
    """Every claim of the run, derived again.

    Raises `BadRequest` if `run` is no finished run folder, or is made of parts that are not trusted
    here.
    """
    record = read_record(run) or {}
    require(bool(record), "run", run, f"there is no {RECORD}", "give the folder of one run")
    state = record.get("status")
    require(
        state != FAILED,
        "run",
        run,
        "the run failed and claims nothing",
        f"see {run / 'traceback.txt'}",
    )
    if state == CORRUPT:
        damaged = Checked(claim=RECORD, holds=False, found="is not as it was written")
        return Verification(findings=(damaged,), unchecked={})
    remedy = "give a run that is ok or infeasible"
    require(
        state in (OK, INFEASIBLE),
        "run",
        run,
        f"its status is {state}, so it claims nothing yet",
        remedy,
    )
    return _judged(RunFiles(path=run.absolute(), record=record))


def _judged(run: RunFiles) -> Verification:
    findings: list[Checked] = []
    derived: dict[str, Any] = {}
    unchecked: dict[str, str] = {}
    for found in _found(run):
        if isinstance(found, Checked):
            findings.append(found)
        elif isinstance(found, Derived):
            derived |= found.columns
        else:
            unchecked |= found.reasons
    for name in dict.fromkeys(
        (*derived, *run.record)
    ):  # also what the record lacks although its files give it
        judged = judge(name, run.record, derived, unchecked)
        if isinstance(judged, Checked):
            findings.append(judged)
        elif judged:
            unchecked[name] = judged
    return Verification(findings=tuple(findings), unchecked=unchecked)


def _found(run: RunFiles) -> Iterator[Checked | Derived | NotChecked]:
    """Results of all sections; whatever a damaged file makes a reader raise is a claim that does
    not hold."""
    try:
        sections = SECTIONS if run.claims_certificate else OF_A_BASELINE
    except (
        Exception
    ) as error:  # a configuration that cannot be read: the section that needs it says so
        if str(getattr(error, "field", "")).endswith("_target_"):
            raise  # without `--with` nothing can be derived, which is no lie of the run
        sections = SECTIONS
    for section in (form, *sections):
        try:
            yield from section(run)
        except Exception as error:
            yield Checked(
                claim=section.__name__, holds=False, found=f"cannot be derived: {one_line(error)}"
            )


def judge(
    name: str, record: Mapping[str, Any], derived: Mapping[str, Any], unchecked: Mapping[str, str]
) -> Checked | str:
    """The finding on a column of the record, or why it is not checked; empty where the record
    claims nothing."""
    column = declared(name)
    if name in ADDED_COLUMNS and name not in record and record.get("record_version") == 1:
        return ADDED
    if name in derived and name not in unchecked:
        return compared(name, record.get(name), derived[name])
    if withdrawn := WITHDRAWN_COLUMNS.get(name):
        return "" if record.get(name) is None else withdrawn.sentence
    if record.get(name) is None and column:
        return ""
    if reason := unchecked.get(name) or (column.unchecked if column else ""):
        return reason
    problem = UNGIVEN if column else "no such column is declared"
    return Checked(claim=name, holds=False, found=f"stored {_short(record[name])}, yet {problem}")


def compared(name: str, stored: Any, value: Any) -> Checked:
    """The stored column beside the derived one."""
    column = declared(name) or Column(name, "Float64")
    value = storable(name, value)  # as a record holds it: an infinite margin is the text `inf`
    holds = _agrees(stored, value, column)
    return Checked(
        claim=name,
        holds=holds,
        found=f"{value}" if holds else f"derived {value}, stored {_short(stored)}",
    )


def _agrees(stored: Any, value: Any, column: Column) -> bool:
    """Equal, or finite numbers as near as two machines' roundings."""
    if isinstance(value, float) and type(stored) in (int, float):
        try:
            return bool(
                abs(float(stored) - value) <= column.tolerance * abs(value) + column.resolution
            )
        except OverflowError:  # an integer of hundreds of digits
            return False
    return type(stored) is type(value) and bool(stored == value)  # True is not 1


def _short(value: Any) -> str:
    text = printable(" ".join(str(value).split()))
    return text if len(text) <= 80 else f"{text[:77]}..."
