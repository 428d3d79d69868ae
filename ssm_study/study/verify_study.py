"""Check of every claim of all runs of a study, and of the table that was gathered from them."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ssm_study.engine.records import read_record
from ssm_study.refusal import BadRequest, require
from ssm_study.study.findings import CheckedClaim
from ssm_study.study.verify import CLAIMS_NOTHING, Verification, verify
from ssm_study.table.folders import abbreviate_names
from ssm_study.table.gather import CSV, PARQUET, table_file_defects


@dataclass(frozen=True, kw_only=True)
class RunVerdict:
    """Verdict on one run of a study: the verification of its claims, or the reason why there is
    none."""

    run: str
    verification: Verification | None = None
    reason: str = ""
    claims_something: bool = True

    @property
    def holds(self) -> bool:
        """Whether all claims of the run were checked and hold."""
        return self.verification is not None and self.verification.holds

    def lines(self, *, every_claim: bool) -> list[str]:
        """Text lines about the run: its verdict, and below it the claims that do not hold. With
        `every_claim` all claims are listed."""
        if self.verification is None:
            word = "unknown" if self.claims_something else "nothing"
            return [f"{word:7}  {self.run}: {self.reason}"]
        word = "holds" if self.holds else "FAILS"
        *claims, summary = self.verification.lines(every_claim=every_claim)
        counts = summary if every_claim else summary.partition(": ")[0]
        return [f"{word:7}  {self.run}: {counts}", *(f"  {claim}" for claim in claims)]


def verify_each_run(study: Path, runs: Sequence[str]) -> Iterator[RunVerdict]:
    """Check every claim of each of the named runs of a study again. A run that failed or has not
    ended claims nothing; one that cannot be read here comes with the reason."""
    for run in runs:
        try:
            yield RunVerdict(run=run, verification=verify(study / run))
        except BadRequest as refusal:
            status = (read_record(study / run) or {}).get("status")
            yield RunVerdict(
                run=run,
                reason=f"{refusal.problem}; {refusal.remedy}",
                claims_something=status not in CLAIMS_NOTHING,
            )


def check_tables(study: Path) -> CheckedClaim | None:
    """Check that the gathered tables of a study say what the records of its runs say. None if no
    table was gathered."""
    if not (study / PARQUET).is_file():
        return None
    defects = table_file_defects(study)
    remedy = f"`ssm-study gather {study}` writes both tables again"
    problems = "; ".join(defects)
    observation = f"{problems}; {remedy}" if defects else "as the records of the runs say"
    return CheckedClaim(claim=f"{PARQUET}, {CSV}", holds=not defects, found=observation)


@dataclass(frozen=True, kw_only=True)
class StudyVerdict:
    """Verdict on a study: on each of its runs, and on the tables gathered from them, if there are
    any."""

    runs: tuple[RunVerdict, ...]
    tables: CheckedClaim | None

    @property
    def holds(self) -> bool:
        """Whether every claim of every run that claims something holds, and the tables agree with
        the records."""
        runs_hold = all(verdict.holds or not verdict.claims_something for verdict in self.runs)
        return runs_hold and (self.tables is None or self.tables.holds)

    def require_claims(self, study: Path) -> None:
        """Raise `BadRequest` if no run of the study claims anything."""
        claims_something = any(verdict.claims_something for verdict in self.runs)
        problem = f"none of its {len(self.runs)} runs has results, so nothing is claimed"
        remedy = f"`ssm-study show {study}` says why; run the study again"
        require(claims_something, "study", study, problem, remedy)

    def summary(self) -> str:
        """Verdict on a study in one line: `4 runs: 2 hold, 1 does not (...), 1 claims nothing`."""
        holding = [verdict.run for verdict in self.runs if verdict.holds]
        silent = [verdict.run for verdict in self.runs if not verdict.claims_something]
        unknown = [
            verdict.run
            for verdict in self.runs
            if verdict.claims_something and verdict.verification is None
        ]
        failing = [
            verdict.run for verdict in self.runs if verdict.verification and not verdict.holds
        ]
        parts = [f"{len(holding)} {'holds' if len(holding) == 1 else 'hold'}"]
        if failing:
            verb = "does" if len(failing) == 1 else "do"
            parts.append(f"{len(failing)} {verb} not ({abbreviate_names(failing)})")
        if unknown:
            parts.append(f"{len(unknown)} cannot be checked here ({abbreviate_names(unknown)})")
        if silent:
            verb = "claims" if len(silent) == 1 else "claim"
            parts.append(f"{len(silent)} {verb} nothing ({abbreviate_names(silent)})")
        return f"{len(self.runs)} runs: {', '.join(parts)}"

    def to_json(self) -> str:
        """Verdict on a study as a text of JSON: `holds`, `runs` with the verdict on each, and
        `tables`."""
        runs = {}
        for verdict in self.runs:
            if verdict.verification is None:
                runs[verdict.run] = {"holds": None, "reason": verdict.reason}
            else:
                runs[verdict.run] = verdict.verification.as_dict()
        tables = None if self.tables is None else vars(self.tables)
        return json.dumps({"holds": self.holds, "runs": runs, "tables": tables}, indent=1)
